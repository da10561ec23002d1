"""A sensor, and the photo that it takes through a simulated lens: blur by exact kernels, noise, a raw file.

Independent of `lensmodel.correction` on purpose: what is tested against it must not come from it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.interpolate import CubicSpline

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS, Channel, Frame, LensSettings, NoiseModel, Planes
from lensmodel.photo.values import PhotoMetadata
from lensmodel.photo.writing import BAYER_PATTERNS, XYZ_TO_SRGB, write_bayer_dng
from lensmodel.simulate.lens import DEFAULT_PITCH_UM, DEFAULT_SIZE, CameraLens

DEFAULT_STEP: Final = 0.1  # half diagonals from one node with an exact kernel to the next


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """A sensor with a Bayer mosaic."""

    height: int = 1000  # pixels; even
    width: int = 1500
    pitch_um: float = 4.5  # pixel pitch in micrometres
    full_well_electrons: float = 20000.0  # electrons at the white level; a higher ISO means fewer
    read_noise: float = 4.0  # standard deviation in electrons
    black: int = 512  # black and white level
    white: int = 15872
    pattern: str = "RGGB"  # colours of the 2 x 2 pattern, row by row
    # multipliers for r, g, b that make a grey scene grey: the sensor sees scene / multiplier
    white_balance: tuple[float, float, float] = (2.0, 1.0, 1.6)
    maker: str = "Simulated Camera"  # as written into the metadata of its photos
    model: str = "SC-1"
    serial: str = "SC1-0001"

    def __post_init__(self) -> None:
        for name, right, wanted in (
            ("height", self.height >= 16 and self.height % 2 == 0, "even and at least 16"),
            ("width", self.width >= 16 and self.width % 2 == 0, "even and at least 16"),
            ("pattern", self.pattern in BAYER_PATTERNS, f"one of {', '.join(BAYER_PATTERNS)}"),
            ("black", 0 <= self.black < self.white < 2**16, "below white, and both within 16 bits"),
            ("full_well_electrons", self.full_well_electrons > 0, "positive"),
            ("read_noise", self.read_noise >= 0, "at least 0"),
            ("pitch_um", 0.5 <= self.pitch_um <= 50.0, "in 0.5..50"),
            ("white_balance", min(self.white_balance) >= 1.0, "at least 1 in each colour"),
        ):
            if not right:
                raise InvalidInputError(f"{name} must be {wanted}, got {getattr(self, name)!r}")

    @property
    def frame(self) -> Frame:
        """The sensor frame."""
        return Frame(self.height, self.width)

    @property
    def noise(self) -> NoiseModel:
        """Noise of one raw pixel where saturation is 1, quantisation included."""
        read = (self.read_noise / self.full_well_electrons) ** 2
        return NoiseModel(
            shot=1.0 / self.full_well_electrons, read=read + 1.0 / (12.0 * (self.white - self.black) ** 2)
        )

    def balanced(self, planes: Planes) -> Planes:
        """What the sensor sees of a scene: each channel over its white balance multiplier."""
        gains = np.asarray(self.white_balance, dtype=np.float32)[:, None, None]
        return np.ascontiguousarray(planes / gains)

    def mosaic(self, planes: Planes, rng: np.random.Generator | None) -> NDArray[np.uint16]:
        """Raw numbers of the light `planes` (sensor values, saturation 1); no noise without `rng`."""
        expected = (len(CHANNELS), self.height, self.width)
        if planes.shape != expected:
            raise InvalidInputError(f"planes must have the camera's shape {expected}, got {planes.shape}")
        pattern = np.array(["RGB".index(letter) for letter in self.pattern]).reshape(2, 2)
        filters = np.tile(pattern, (self.height // 2, self.width // 2))
        level: NDArray[np.floating] = np.take_along_axis(planes, filters[None], axis=0)[0]
        if rng is not None:
            electrons = rng.poisson(np.maximum(level, 0.0) * self.full_well_electrons).astype(np.float64)
            electrons += rng.normal(0.0, self.read_noise, level.shape)
            level = electrons / self.full_well_electrons
        # a full well clips at the white level; read noise may fall below the black level
        numbers = np.rint(self.black + level * (self.white - self.black))
        return np.clip(numbers, 0, self.white).astype(np.uint16)


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPhoto:
    """A simulated photo, and what it was taken with."""

    mosaic: NDArray[np.uint16]  # (height, width), raw numbers
    clean: Planes  # (3, height, width), the light on the sensor: before noise, quantisation and clipping
    # (3, height, width), the same without blur, lateral colour and vignetting: what a correction should reach
    sharp: Planes
    lens: CameraLens
    camera: SimulatedCamera
    settings: LensSettings


def photograph(
    scene: Planes,
    lens: CameraLens,
    settings: LensSettings,
    camera: SimulatedCamera,
    rng: np.random.Generator | None,
    *,
    exposure: float = 1.0,
    size: int = DEFAULT_SIZE,
    step: float = DEFAULT_STEP,
) -> SimulatedPhoto:
    """Take a photo: blur (`blurred`), exposure, colour response, noise, clipping, mosaic."""
    if not (math.isfinite(exposure) and exposure > 0.0):
        raise InvalidInputError(f"exposure must be positive, got {exposure}")
    frame = camera.frame
    clean = blurred(scene, lens, settings, frame, pitch_um=camera.pitch_um, size=size, step=step)
    clean = camera.balanced(clean * np.float32(exposure))
    return SimulatedPhoto(
        mosaic=camera.mosaic(clean, rng),
        clean=clean,
        sharp=camera.balanced(_with_margin(scene, frame, 0) * np.float32(exposure)),
        lens=lens,
        camera=camera,
        settings=settings,
    )


_REFINED: Final = 2  # nodes of the windows per exact node


def blurred(
    scene: Planes,
    lens: CameraLens,
    settings: LensSettings,
    frame: Frame,
    *,
    pitch_um: float = DEFAULT_PITCH_UM,
    size: int = DEFAULT_SIZE,
    step: float = DEFAULT_STEP,
) -> Planes:
    """Blur a scene `(3, H + 2 m, W + 2 m)` as the lens does: every point becomes the kernel of its place.

    Kernels k_i sit on a grid of nodes, among which windows divide the scene x::

        y = sum_i  k_i * (w_i x)          sum_i w_i = 1,  w_i a triangle in row and column

    They are exact on every second node, `step` half diagonals apart; those between are cubic splines through
    them (of a relative L2 error of 0.5 to 1.5 percent). Kernels have the odd side `size`; where m is narrower
    than half of it, the scene is mirrored. Source: M. Hirsch et al., "Efficient filter flow for space-variant
    multiframe blind deconvolution", CVPR 2010, eq. 2.
    """
    if not 0.01 <= step <= 0.5:
        raise InvalidInputError(f"step must lie in 0.01..0.5 half diagonals, got {step}")
    half = size // 2
    padded = _with_margin(scene, frame, half)
    spacing = max(round(step * frame.half_diagonal / _REFINED), 4)
    rows, cols = (_nodes(length, spacing) for length in padded.shape[1:])
    middle = (padded.shape[1] - 1) / 2.0, (padded.shape[2] - 1) / 2.0
    hats = [
        [_hat(node, spacing, n) for node in nodes]
        for nodes, n in zip((rows, cols), padded.shape[1:], strict=True)
    ]
    out = np.zeros((3, padded.shape[1] + 2 * half, padded.shape[2] + 2 * half), dtype=np.float32)
    for index, channel in enumerate(CHANNELS):
        own = settings.with_channel(channel)
        # field vectors (right, up) of nodes; beyond the frame they are longer than 1
        right, up = (cols - middle[1]) / frame.half_diagonal, (middle[0] - rows) / frame.half_diagonal
        exact = [
            [_kernel(lens, own, (float(x), float(y)), frame, pitch_um, size) for x in right[::_REFINED]]
            for y in up[::_REFINED]
        ]
        kernels = _between(np.asarray(exact, dtype=np.float32), len(rows), len(cols))
        for i, (down, row_weights) in enumerate(hats[0]):
            for j, (along, col_weights) in enumerate(hats[1]):
                light = padded[index, down, along] * np.outer(row_weights, col_weights).astype(np.float32)
                if light.size:
                    image = signal.fftconvolve(light, kernels[i, j])
                    rest = out[index, down.start :, along.start :]
                    rest[: image.shape[0], : image.shape[1]] += image
    inner = out[:, 2 * half : 2 * half + frame.height, 2 * half : 2 * half + frame.width]
    return np.ascontiguousarray(np.maximum(inner, 0.0))


def _with_margin(scene: Planes, frame: Frame, margin: int) -> Planes:
    """Cut or mirror a scene to the frame plus `margin`."""
    if scene.ndim != 3 or scene.shape[0] != len(CHANNELS):
        raise InvalidInputError(f"a scene has the shape (3, H, W), got {scene.shape}")
    spare = (scene.shape[1] - frame.height, scene.shape[2] - frame.width)
    if min(spare) < 0 or spare[0] % 2 or spare[1] % 2:
        raise InvalidInputError(
            f"the scene {scene.shape[1:]} must exceed the frame ({frame.height}, {frame.width}) by an even "
            "number of rows and columns, or equal it; crop or enlarge it first"
        )
    if not np.isfinite(scene).all() or float(scene.min()) < 0.0:
        raise InvalidInputError("scene values must be finite and not negative linear light")
    cut = [max(s // 2 - margin, 0) for s in spare]
    inner = scene[:, cut[0] : scene.shape[1] - cut[0], cut[1] : scene.shape[2] - cut[1]]
    missing = [max(margin - s // 2, 0) for s in spare]
    padded = np.pad(inner, ((0, 0), (missing[0],) * 2, (missing[1],) * 2), mode="symmetric")
    return np.ascontiguousarray(padded, dtype=np.float32)


def _nodes(length: int, spacing: int) -> NDArray[np.intp]:
    """Nodes symmetric about the middle, the outer ones on or beyond the edges, exact ones outermost."""
    middle = (length - 1) // 2
    unit = spacing * _REFINED
    before, after = -(-middle // unit), -(-(length - 1 - middle) // unit)
    return middle + spacing * np.arange(-before * _REFINED, after * _REFINED + 1)


def _hat(node: int, spacing: int, length: int) -> tuple[slice, NDArray[np.float64]]:
    """Pixels that belong to a node, and its window there; none where it lies beyond the edge."""
    pixels = np.arange(max(node - spacing + 1, 0), max(min(node + spacing, length), 0))
    start = max(node - spacing + 1, 0)
    return slice(start, start + pixels.size), 1.0 - np.abs(pixels - node) / spacing


def _between(exact: NDArray[np.float32], rows: int, cols: int) -> NDArray[np.float32]:
    """Kernels of all nodes, `(rows, cols, k, k)`, by cubic splines through the exact ones."""
    down, across = (
        CubicSpline(np.arange(known), np.eye(known))(np.linspace(0.0, known - 1.0, wanted)).astype(np.float32)
        for known, wanted in zip(exact.shape[:2], (rows, cols), strict=True)
    )
    fine = np.tensordot(across, np.tensordot(down, exact, axes=(1, 0)), axes=(1, 1)).swapaxes(0, 1)
    fine = np.maximum(fine, 0.0)
    return np.asarray(fine / fine.sum(axis=(2, 3), keepdims=True), dtype=np.float32)


@lru_cache(maxsize=2048)  # photos of one lens and frame share all their kernels, 50 MB at most
def _kernel(
    lens: CameraLens, settings: LensSettings, h: tuple[float, float], frame: Frame, pitch_um: float, size: int
) -> NDArray[np.float64]:
    channel: Channel = settings.channel
    offset, r = (0.0, 0.0), math.hypot(*h)
    if channel != "g" and r > 0:
        outwards = lens.lateral_shift(r, channel, settings.focal_mm) * frame.half_diagonal
        offset = (-outwards * h[1] / r, outwards * h[0] / r)
    return lens.kernel_at_field(h, settings, size, pitch_um=pitch_um, offset=offset)


_BASE_ISO_ELECTRONS = 40000.0  # full well at ISO 100


def write_photo(path: str | Path, photo: SimulatedPhoto) -> None:
    """Write the mosaic of a simulated photo as DNG."""
    camera, lens, settings = photo.camera, photo.lens, photo.settings
    metadata = PhotoMetadata(
        camera_maker=camera.maker,
        camera_model=camera.model,
        body_serial=camera.serial,
        lens=lens.identity,
        aperture=round(lens.f_number(settings), 2),
        focal_mm=settings.focal_mm if settings.focal_mm is not None else lens.focal_mm[0],
        focus_m=settings.focus_m,
        iso=max(round(100.0 * _BASE_ISO_ELECTRONS / camera.full_well_electrons), 1),
        exposure_s=1.0 / 125.0,
        pixel_pitch_um=camera.pitch_um,
    )
    write_bayer_dng(
        path,
        photo.mosaic,
        black=camera.black,
        white=camera.white,
        pattern=camera.pattern,
        # scenes are linear sRGB, the sensor sees them unbalanced
        color_matrix=np.asarray(XYZ_TO_SRGB) / np.asarray(camera.white_balance)[:, None],
        as_shot_neutral=[1.0 / multiplier for multiplier in camera.white_balance],
        metadata=metadata,
    )
