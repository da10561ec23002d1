"""Corrections that are sound and corrections that are not, to try the audit on.

Photographs of known scenes through simulated lenses, as in `bench.correct_quality`, on a window of the
frame each. Sound ones are corrected with the true PSF; the faults are made by what knows nothing of the
audit: dots, hue flips, combs, erased texture, kernels that are too wide or turned. Nothing is clipped, since
light beyond saturation is a matter of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from skimage import restoration

from lab.correction.quality import (
    CORNERS,
    EXPOSURES,
    FRAME,
    WINDOW,
    FrameWindow,
    composed,
    exposed,
    view,
)
from lensmodel.core.files import atomic
from lensmodel.core.psf import PsfField, as_kernel
from lensmodel.core.types import (
    CHANNELS,
    ZONES,
    BayerPattern,
    Channel,
    FieldPosition,
    Kernel,
    LensSettings,
    NoiseModel,
    Planes,
)
from lensmodel.correction import correct_planes
from lensmodel.simulate import draw_lens

SOUND: Final = ("true PSF", "true PSF, fast")
"""Names of the corrections of a trial that are sound, if they gain."""
WRONG: Final = ("kernel 1.6 times too wide", "kernel turned")
"""Names of those that were made with other kernels; the audit is given these kernels too."""

BLOCK: Final = 128
"""Side of the blocks that are judged, in pixels."""

KINDS: Final = ("soft-fast", "coma", "astigmatism", "decentred", "nearly-perfect")
HALVES: Final[dict[str, int]] = {"development": 1, "held out": 2}
"""Number of the first photograph of each half; the others follow two by two."""

RGGB: Final[BayerPattern] = ((0, 1), (1, 2))  # colour by row and column of the mosaic: red first
_SCENES: Final = 24  # photographs of docs/lab/data.md
_EXPOSURE: Final = 0.9  # of the photograph's own: what is white there stays below saturation
_KERNEL: Final = 55  # pixels: the largest side that estimators give
_NODES: Final = 3  # kernels along a side of the window; between them they fade into each other
_RIM: Final = 8  # pixels that corrections know less of: no block lies there (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class WindowField:
    """A lens within one window of the frame: kernels of 3 x 3 places, faded into each other."""

    rows: NDArray[np.float64]
    cols: NDArray[np.float64]
    kernels: NDArray[np.float64]

    @classmethod
    def of(cls, field: PsfField, zone: str) -> WindowField:
        """Ask a lens in the window of a zone; the nodes lie on its border and in its middle."""
        (top, left), (height, width) = CORNERS[zone], WINDOW
        rows, cols = np.linspace(top, top + height - 1, _NODES), np.linspace(left, left + width - 1, _NODES)
        kernels = [
            [[field.kernel_at(FRAME.position(row, col), c, _KERNEL) for col in cols] for row in rows]
            for c in CHANNELS
        ]
        return cls(rows, cols, np.asarray(kernels))

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel of a place."""
        row, col = FRAME.pixel(position)
        across = self.kernels[CHANNELS.index(channel)]
        for at, nodes in ((row, self.rows), (col, self.cols)):
            t = float(np.clip((at - nodes[0]) / (nodes[1] - nodes[0]), 0.0, _NODES - 1 - 1e-9))
            low = int(t)
            across = (low + 1 - t) * across[low] + (t - low) * across[low + 1]
        cut = (_KERNEL - size) // 2
        return as_kernel(across[cut : _KERNEL - cut, cut : _KERNEL - cut] if cut > 0 else across)

    def changed(self, change: Callable[[Kernel], NDArray[np.float64]]) -> WindowField:
        """Return the lens with another kernel in place of each."""
        flat = [as_kernel(np.maximum(change(k), 0.0)) for k in self.kernels.reshape(-1, _KERNEL, _KERNEL)]
        return WindowField(self.rows, self.cols, np.reshape(flat, self.kernels.shape))


def widened(factor: float) -> Callable[[Kernel], NDArray[np.float64]]:
    """Return what makes a kernel wider by a factor."""

    def change(kernel: Kernel) -> NDArray[np.float64]:
        middle = (np.asarray(kernel.shape) - 1) / 2.0
        matrix = np.eye(2) / factor
        return np.asarray(ndimage.affine_transform(kernel, matrix, middle - matrix @ middle, order=1))

    return change


def turned(kernel: Kernel) -> NDArray[np.float64]:
    """Turn a kernel by a quarter."""
    return np.rot90(kernel)


CHANGES: Final = dict(zip(WRONG, (widened(1.6), turned), strict=True))
"""What is done to the kernels of each of the wrong corrections."""


@dataclass(frozen=True, slots=True)
class AuditCase:
    """One window of one lens's photo of one pair of photographs.

    Parameters
    ----------
    half : str
        Which half of the photographs.
    pair : tuple of int
        Numbers of the photographs.
    kind, seed
        The lens, as `draw_lens` takes them.
    zone, exposure : str
        Where in the frame, and with how much light.
    mosaic : bool
        Whether each pixel measured one colour only.
    """

    half: str
    pair: tuple[int, int]
    kind: str
    seed: int
    zone: str
    exposure: str
    mosaic: bool

    @property
    def name(self) -> str:
        """Name of the file that keeps what was made of it."""
        made = "mosaic" if self.mosaic else "planes"
        return "-".join(
            (f"s{self.pair[0]:02d}", self.kind, str(self.seed), self.zone, self.exposure.split()[0], made)
        )


def cases(half: str) -> tuple[AuditCase, ...]:
    """List the cases of one half: every pair of photographs behind every kind of lens."""
    first = HALVES[half]
    pairs = [(n, n + 2) for n in range(first, _SCENES + 1, 4)]
    found = []
    for p, pair in enumerate(pairs):
        for k, kind in enumerate(KINDS):
            seed = 1000 + len(KINDS) * (first - 1) + k
            exposure = list(EXPOSURES)[(p + k // 2) % 2]
            found.append(AuditCase(half, pair, kind, seed, ZONES[(p + k) % 3], exposure, (p + k) % 2 == 1))
    return tuple(found)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """A photo of a known scene and what was made of it.

    Parameters
    ----------
    case : AuditCase
        What it is of.
    scene, photo : Planes
        Sharp light, and the photo of it, on the window less a rim.
    made : dict of Planes
        Corrections by name; "true PSF" and "true PSF, fast" are sound.
    kernels : ndarray, shape (3, rows, cols, k, k)
        True kernels in the middles of the blocks.
    """

    case: AuditCase
    scene: Planes
    photo: Planes
    made: dict[str, Planes]
    kernels: NDArray[np.float64]

    @property
    def noise(self) -> NoiseModel:
        """Noise of the photo's sensor."""
        return EXPOSURES[self.case.exposure]

    def measured(self, channel: int, window: tuple[slice, ...]) -> NDArray[np.bool_] | None:
        """Where the sensor measured a channel in a window; None for everywhere."""
        if not self.case.mosaic:
            return None
        rows, cols = (np.arange(part.start, part.stop) % 2 for part in window)
        return np.asarray(np.asarray(RGGB)[rows[:, None], cols[None, :]] == channel)

    def blocks(self) -> Iterator[tuple[int, int, NDArray[np.float64]]]:
        """First row and column of each block, and its three true kernels."""
        for (top, left), index in zip(
            _blocks(self.scene.shape), np.ndindex(self.kernels.shape[1:3]), strict=True
        ):
            yield top, left, self.kernels[:, *index]


def _blocks(shape: tuple[int, ...]) -> list[tuple[int, int]]:
    """First pixels of the blocks, as many as fit, in the middle."""
    starts = [
        [(extent % BLOCK) // 2 // 2 * 2 + BLOCK * i for i in range(extent // BLOCK)] for extent in shape[1:]
    ]
    return [(row, col) for row in starts[0] for col in starts[1]]


def trial(case: AuditCase, folder: Path, cache: Path) -> Trial:
    """Photograph and correct a case, or read what was made of it before."""
    path = cache / f"{case.name}.npz"
    if not path.exists():
        made = _made(case, folder)
        cache.mkdir(parents=True, exist_ok=True)
        kept: dict[str, Any] = {
            "kernels": made.kernels,
            "scene": made.scene,
            "photo": made.photo,
            **made.made,
        }
        with atomic(path) as file:
            np.savez(file, **kept)
    with np.load(path) as file:
        arrays: dict[str, Any] = dict(file)
    return Trial(case, arrays.pop("scene"), arrays.pop("photo"), kernels=arrays.pop("kernels"), made=arrays)


@dataclass(frozen=True, slots=True, eq=False)
class Exposure:
    """What a case's camera saw, and the lens: all that a correction needs.

    Parameters
    ----------
    lens : WindowField
        The true PSFs.
    window : FrameWindow
        Part of the frame that the lens was asked for.
    light : Planes
        The photo there, demosaiced.
    whole : Planes
        The same in its place in a frame that is black elsewhere.
    noise : NoiseModel
        Of the sensor.
    cfa : tuple of tuple of int or None
        Mosaic of the sensor.
    """

    lens: WindowField
    window: FrameWindow
    light: Planes
    whole: Planes
    noise: NoiseModel
    cfa: BayerPattern | None

    @classmethod
    def of(cls, case: AuditCase, folder: Path) -> Exposure:
        """Photograph the scene of a case."""
        lens = WindowField.of(draw_lens(case.seed, case.kind).field(LensSettings()), case.zone)
        files = [next(folder.glob(f"s{number:02d}_*")) for number in case.pair]
        at = view(case.zone, composed(files, _EXPOSURE), lens)
        noise = EXPOSURES[case.exposure]
        light = exposed(at.light, noise, np.random.default_rng([case.seed, *case.pair]))
        if case.mosaic:  # windows begin on even pixels
            light = demosaiced(light, RGGB)
        whole = np.zeros((len(CHANNELS), FRAME.height, FRAME.width), dtype=np.float32)
        whole[:, at.top : at.top + light.shape[1], at.left : at.left + light.shape[2]] = light
        return cls(lens, at, light, whole, noise, RGGB if case.mosaic else None)

    def corrected(self, field: PsfField, method: str = "standard", *, audited: bool = False) -> Planes:
        """Correct the window; not audited unless asked: what it held back would not be seen a second time."""
        result = correct_planes(
            self.whole,
            field,
            FRAME,
            noise=[self.noise] * 3,
            method=method,
            cfa=self.cfa,
            audited=audited,
            roi=self.window.roi,
        )
        return np.ascontiguousarray(result.planes[:, _RIM:-_RIM, _RIM:-_RIM])


def _made(case: AuditCase, folder: Path) -> Trial:
    exposure = Exposure.of(case, folder)
    lens, at = exposure.lens, exposure.window
    made = {SOUND[0]: exposure.corrected(lens), SOUND[1]: exposure.corrected(lens, "fast")}
    made |= {name: exposure.corrected(lens.changed(change)) for name, change in CHANGES.items()}
    scene = np.ascontiguousarray(at.inner(at.scene))
    middles = [
        FRAME.position(at.roi[0] + _RIM + row + BLOCK / 2, at.roi[1] + _RIM + col + BLOCK / 2)
        for row, col in _blocks(scene.shape)
    ]
    shape = (3, scene.shape[1] // BLOCK, scene.shape[2] // BLOCK, _KERNEL, _KERNEL)
    kernels = np.reshape([[lens.kernel_at(m, c, _KERNEL) for m in middles] for c in CHANNELS], shape)
    return Trial(case, scene, np.ascontiguousarray(at.inner(exposure.light)), made, kernels)


def demosaiced(light: Planes, pattern: BayerPattern) -> Planes:
    """Keep of each pixel the colour that the mosaic measures, and fill in the others from the neighbours."""
    rows, cols = np.indices(light.shape[1:])
    measured = np.asarray(pattern)[rows % 2, cols % 2]
    near = np.outer([0.5, 1.0, 0.5], [0.5, 1.0, 0.5])
    filled = []
    for c, plane in enumerate(light):
        known = (measured == c).astype(np.float64)
        total = ndimage.convolve(plane * known, near) / ndimage.convolve(known, near)
        filled.append(np.where(known > 0, plane, total))
    return np.asarray(filled, dtype=np.float32)


# --- faults --------------------------------------------------------------------------------------


def dots(sound: Planes, rng: np.random.Generator) -> Planes:
    """Set one pixel in two hundred, in one or all colours, far off its neighbours."""
    found = sound.copy()
    count = sound[0].size // 200
    rows, cols = (rng.integers(0, extent, count) for extent in sound.shape[1:])
    for row, col in zip(rows, cols, strict=True):
        colours = slice(None) if rng.random() < 0.5 else int(rng.integers(3))
        step = rng.uniform(0.3, 1.0)
        up = found[colours, row, col].mean() < 0.5
        found[colours, row, col] += step if up else -step
    return found


def hue_flips(sound: Planes, rng: np.random.Generator) -> Planes:
    """Exchange two colours in spots of 3 to 9 pixels that make up a twentieth of the picture."""
    found = sound.copy()
    field = ndimage.gaussian_filter(rng.standard_normal(sound.shape[1:]), rng.uniform(1.0, 2.5))
    spots = field > np.quantile(field, 0.95)
    light = sound[:, spots]
    # Where all colours are alike, an exchange changes nothing: one of them is taken away.
    flipped = np.roll(light, 1, axis=0)
    flipped[int(rng.integers(3))] *= 0.3
    found[:, spots] = flipped
    return found


def comb(sound: Planes, rng: np.random.Generator) -> Planes:
    """Add lines of a period of 2 to 3 pixels, of a fifth to a half of the light, on half the picture."""
    frequency = 1.0 / rng.uniform(2.0, 3.0)
    angle = rng.choice([0.0, np.pi / 2.0]) + rng.uniform(-0.1, 0.1)
    rows, cols = np.indices(sound.shape[1:])
    wave = np.cos(2 * np.pi * frequency * (np.cos(angle) * cols + np.sin(angle) * rows) + rng.uniform(0, 6))
    field = ndimage.gaussian_filter(rng.standard_normal(sound.shape[1:]), 20.0)
    where = ndimage.gaussian_filter((field > 0).astype(np.float64), 2.0)
    return (sound * (1.0 + rng.uniform(0.2, 0.5) * where * wave)).astype(np.float32)


def erased(sound: Planes, rng: np.random.Generator) -> Planes:
    """Paint all but the strongest edges flat: total variation, of a strength in the texture's own size."""
    detail = sound - ndimage.gaussian_filter(sound, (0, 2, 2))
    weight = float(rng.uniform(3.0, 8.0) * detail.std())
    flat = restoration.denoise_tv_chambolle(sound, weight, max_num_iter=40, channel_axis=0)  # type: ignore[no-untyped-call]
    return np.asarray(flat, dtype=np.float32)


def rings(sound: Planes, rng: np.random.Generator) -> Planes:
    """Echo every edge: waves of a period of 4 to 7 pixels that die away over some 8 pixels."""
    reach = 15
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    r = np.hypot(y, x)
    echo = np.cos(2 * np.pi * r / rng.uniform(4.0, 7.0)) * np.exp(-r / 4.0)
    echo -= echo.mean()
    echo *= rng.uniform(1.0, 2.5) / np.abs(echo).sum()
    detail = sound - ndimage.gaussian_filter(sound, (0, 1, 1))
    echoes = [ndimage.convolve(plane, 8.0 * echo) for plane in detail]
    return (sound + np.asarray(echoes)).astype(np.float32)


FAULTS: Final[dict[str, Callable[[Planes, np.random.Generator], Planes]]] = {
    "dots": dots,
    "hue flips": hue_flips,
    "comb": comb,
    "erased texture": erased,
    "rings": rings,
}
"""What is done to a sound correction, by name."""
