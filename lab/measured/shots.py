"""Simulated photos for measuring a lens: DNG files of a Bayer sensor, with noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.measured import scenes
from lab.scenes import dead_leaves
from lab.traced import GridLens
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField
from lensmodel.core.types import LensSettings, Planes
from lensmodel.estimation.measure import TargetPage
from lensmodel.simulate import (
    BlurOptions,
    CameraLens,
    SimulatedCamera,
    SimulatedField,
    SimulatedLens,
    SimulatedPhoto,
    draw_lens,
    photograph,
    write_photo,
)

BASE_ISO_ELECTRONS: Final = 40000.0  # full well of a pixel (chosen)
KERNEL: Final = 41
"""Side of the kernels that photos are blurred with: the grids hold 55, of which this much has light."""

STEP: Final = 0.05
"""Half diagonals between exact kernels; cubic splines between them. In the corner of a decentred lens the
photo of a point was up to 22 percent off the kernel that it is compared with at 0.1, and below 3 percent at
0.05 at the places that were looked at."""

CLOSED_F_NUMBER: Final = 8.0  # about f/8, as docs/topics/measuring.md asks


@dataclass(frozen=True, slots=True)
class Bench:
    """One lens on the bench.

    Parameters
    ----------
    name : str
        For the table.
    family : {"third-order", "traced"}
        How its PSFs are made.
    lens : CameraLens
    settings : LensSettings
        Wide open.
    closed : LensSettings or None
        For the second photo of a pair; None where its PSFs are not known.
    camera : SimulatedCamera
    seed : int
        Of noise and scenes.
    """

    name: str
    family: str
    lens: CameraLens
    settings: LensSettings
    closed: LensSettings | None
    camera: SimulatedCamera
    seed: int

    def truth(self) -> PsfField:
        """Return the PSFs that the measurements should find."""
        if isinstance(self.lens, GridLens):
            return self.lens.field(self.settings)
        if isinstance(self.lens, SimulatedLens):
            return SimulatedField(self.lens, self.settings, self.camera.pitch_um)
        raise InvalidInputError(f"the PSFs of {type(self.lens).__name__} are not known")


def camera_of(height: int, width: int) -> SimulatedCamera:
    """Return a sensor at base ISO."""
    return SimulatedCamera(height=height, width=width, full_well_electrons=BASE_ISO_ELECTRONS)


def third_order(seed: int, camera: SimulatedCamera) -> Bench:
    """Return a lens of `simulate.draw_lens`, wide open."""
    lens = draw_lens(seed)
    focal = lens.focal_mm[0]
    settings = LensSettings(aperture=lens.widest(focal), focal_mm=focal)
    closed = replace(settings, aperture=CLOSED_F_NUMBER)
    return Bench(lens.model.removeprefix("Simulated "), "third-order", lens, settings, closed, camera, seed)


def traced(path: Path, closed: Path | None, camera: SimulatedCamera) -> Bench:
    """Return a ray-traced lens from its grid, and from that of the same copy closed."""
    lens = GridLens.read(*(path, *(() if closed is None else (closed,))))
    focal = lens.focal_mm[0]
    apertures = [grid.f_number for grid in lens.grids]
    small = None if closed is None else LensSettings(aperture=apertures[-1], focal_mm=focal)
    settings = LensSettings(aperture=apertures[0], focal_mm=focal)
    return Bench(lens.model.removeprefix("Traced "), "traced", lens, settings, small, camera, 1)


def take(bench: Bench, kind: str, folder: Path, detail: int) -> list[Path]:
    """Take the photos of one measurement, unless they are there; name them."""
    names = ("open", "closed") if kind == "pair" else (kind,)
    paths = [folder / f"{name}.dng" for name in names]
    if all(path.exists() for path in paths):
        return paths
    folder.mkdir(parents=True, exist_ok=True)
    shape = bench.camera.height, bench.camera.width
    rng = np.random.default_rng([bench.seed, len(kind)])
    if kind == "target":
        scene = 0.8 * scenes.target_scene(TargetPage(detail), shape, scenes.Setup(fill=0.97))
    elif kind == "edges":
        scene = scenes.board_scene(shape[0] / 4.0, shape, scenes.Setup())
    elif kind == "points":
        scene = scenes.light_scene(64, shape, rng)
    else:
        scene = _leaves(shape, rng)
    settings = [bench.settings, bench.closed] if kind == "pair" else [bench.settings]
    for number, (path, setting) in enumerate(zip(paths, settings, strict=True)):
        if setting is None:
            raise InvalidInputError(f"the PSFs of {bench.name} closed down are not known")
        # the tripod gives way a little, and the lens is handled between the two
        seen = scenes.moved_scene(scene, (0.37, -0.81), 0.05) if number else scene
        write_photo(path, _photo(bench, setting, seen, rng, lift=scenes.LIFT if kind == "points" else 0.0))
    return paths


def _photo(
    bench: Bench, setting: LensSettings, scene: Planes, rng: np.random.Generator, *, lift: float
) -> SimulatedPhoto:
    """Photograph a scene; one that is negative somewhere is lifted before the blur, and lowered after it."""

    def shot(light: Planes, noise: np.random.Generator | None) -> SimulatedPhoto:
        light = np.ascontiguousarray(light, dtype=np.float32)
        options = BlurOptions(size=KERNEL, step=STEP)
        return photograph(light, bench.lens, setting, bench.camera, noise, options=options)

    if not lift:
        return shot(scene, rng)
    lifted = shot(scene + lift, None)
    clean = np.maximum(lifted.clean - shot(np.full_like(scene, lift), None).clean, 0.0)
    return replace(
        lifted, clean=clean, mosaic=bench.camera.mosaic(clean, rng), planes=bench.camera.develop(clean, rng)
    )


def _leaves(shape: tuple[int, int], rng: np.random.Generator) -> Planes:
    """A scene with detail of all sizes, not too bright to clip, without frequencies beyond the pixels'."""
    height, width = (n + 2 * scenes.MARGIN for n in shape)
    leaves = dead_leaves(height, width, rng, smallest=1.0)
    texture: NDArray[np.float64] = rng.standard_normal((height, width))
    grain = 1.0 + 0.15 * ndimage.gaussian_filter(texture, 0.7) / 0.4
    return np.ascontiguousarray(np.clip(0.05 + 0.7 * leaves * grain, 0.0, 0.9), dtype=np.float32)
