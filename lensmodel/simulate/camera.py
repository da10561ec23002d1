"""A sensor, and the photo that it takes through a simulated lens.

The blur here is independent of `lensmodel.blur` and `lensmodel.deconv` on purpose: what those are
tested against must not come from them.
"""

from __future__ import annotations

import hashlib
import logging
import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.errors import InvalidInputError
from lensmodel.geometry import Frame
from lensmodel.photo.dng import XYZ_TO_SRGB
from lensmodel.simulate.lens import DEFAULT_SIZE, SimulatedLens
from lensmodel.types import CHANNELS, LensSettings, NoiseModel, Planes, StepHook, ignore_step

logger = logging.getLogger(__name__)

PATTERNS: Final = ("RGGB", "BGGR", "GRBG", "GBRG")
DEFAULT_STEP: Final = 0.1

_BITS: Final = (8, 16)


@dataclass(frozen=True, slots=True)
class SimulatedCamera:
    """A sensor with a Bayer mosaic.

    Parameters
    ----------
    height, width : int
        Pixels; even.
    pitch_um : float
        Pixel pitch in micrometres.
    full_well_electrons : float
        Electrons at the white level; a higher ISO means fewer.
    read_noise : float
        Standard deviation in electrons.
    bits : int
        Of the mosaic's numbers.
    black, white : int
        Black and white level.
    pattern : {"RGGB", "BGGR", "GRBG", "GBRG"}
        Colours of the 2 x 2 cell, row by row.
    white_balance : tuple of float
        Multipliers for r, g, b that make a grey scene grey: the sensor sees scene / multiplier.
    maker, model, serial : str
        As written into the metadata of its photos.
    """

    height: int = 1000
    width: int = 1500
    pitch_um: float = 4.5
    full_well_electrons: float = 20000.0
    read_noise: float = 4.0
    bits: int = 14
    black: int = 512
    white: int = 15872
    pattern: str = "RGGB"
    white_balance: tuple[float, float, float] = (2.0, 1.0, 1.6)
    maker: str = "Simulated Camera"
    model: str = "SC-1"
    serial: str = "SC1-0001"

    def __post_init__(self) -> None:
        if min(self.height, self.width) < 16 or self.height % 2 or self.width % 2:
            raise InvalidInputError(
                f"a Bayer frame needs even sides of 16 or more, got {self.height} x {self.width}"
            )
        if self.pattern not in PATTERNS:
            raise InvalidInputError(f"pattern must be one of {', '.join(PATTERNS)}, got {self.pattern!r}")
        if not _BITS[0] <= self.bits <= _BITS[1] or not 0 <= self.black < self.white < 2**self.bits:
            raise InvalidInputError(
                f"levels must satisfy 0 <= black < white < 2^bits with 8 to 16 bits, got black {self.black}, "
                f"white {self.white}, {self.bits} bits"
            )
        if not (self.full_well_electrons > 0 and self.read_noise >= 0 and 0.5 <= self.pitch_um <= 50.0):
            raise InvalidInputError(
                f"full well and pitch must be positive and read noise not negative, got "
                f"{self.full_well_electrons}, {self.pitch_um}, {self.read_noise}"
            )
        if len(self.white_balance) != len(CHANNELS) or min(self.white_balance) < 1.0:
            raise InvalidInputError(
                f"white balance needs three multipliers of at least 1, got {self.white_balance}"
            )

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

    @property
    def as_shot_neutral(self) -> tuple[float, float, float]:
        """What the sensor sees of a grey scene, as DNG wants it."""
        r, g, b = self.white_balance
        return 1.0 / r, 1.0 / g, 1.0 / b

    @property
    def color_matrix(self) -> NDArray[np.float64]:
        """CIE XYZ (D65) to sensor colours: scenes are linear sRGB, the sensor sees them unbalanced."""
        return np.asarray(XYZ_TO_SRGB) / np.asarray(self.white_balance)[:, None]

    def channel_map(self) -> NDArray[np.intp]:
        """Index into r, g, b of the colour filter over every pixel, `(height, width)`."""
        cell = np.array(["RGB".index(letter) for letter in self.pattern]).reshape(2, 2)
        return np.tile(cell, (self.height // 2, self.width // 2))

    def balanced(self, planes: Planes) -> Planes:
        """What the sensor sees of a scene: each channel over its white balance multiplier."""
        gains = np.asarray(self.white_balance, dtype=np.float32)[:, None, None]
        return np.ascontiguousarray(planes / gains)

    def mosaic(self, planes: Planes, rng: np.random.Generator | None) -> NDArray[np.uint16]:
        """Raw numbers of the light `planes` (sensor values, saturation 1); no noise without `rng`."""
        self._check(planes)
        light = np.take_along_axis(planes, self.channel_map()[None], axis=0)[0]
        return self._numbers(self._noisy(light, rng))

    def develop(self, planes: Planes, rng: np.random.Generator | None) -> Planes:
        """Three full planes with noise, quantised and clipped at 1: a sensor without a mosaic."""
        self._check(planes)
        numbers = self._numbers(self._noisy(planes, rng)).astype(np.float32)
        return (numbers - np.float32(self.black)) / np.float32(self.white - self.black)

    def _check(self, planes: Planes) -> None:
        expected = (len(CHANNELS), self.height, self.width)
        if planes.shape != expected:
            raise InvalidInputError(f"planes must have the camera's shape {expected}, got {planes.shape}")

    def _noisy(
        self, light: NDArray[np.float32], rng: np.random.Generator | None
    ) -> NDArray[np.float32] | NDArray[np.float64]:
        if rng is None:
            return light
        electrons = rng.poisson(np.maximum(light, 0.0) * self.full_well_electrons).astype(np.float64)
        electrons += rng.normal(0.0, self.read_noise, light.shape)
        return electrons / self.full_well_electrons

    def _numbers(self, level: NDArray[np.floating]) -> NDArray[np.uint16]:
        # a full well clips at the white level; read noise may fall below the black level
        return np.clip(np.rint(self.black + level * (self.white - self.black)), 0, self.white).astype(
            np.uint16
        )


@dataclass(frozen=True, slots=True)
class Truth:
    """What is known about a simulated photo.

    Parameters
    ----------
    lens, camera, settings
        What it was taken with.
    scene_sha256 : str
        Of the scene's float32 bytes.
    exposure : float
        Scene values were multiplied by it.
    defocus : float
        Focus error, waves at the open aperture.
    vignetting, lateral : bool
        Whether they were simulated.
    mirrored_px : int
        Width of the margin beyond the frame that had to be mirrored because the scene ended; 0 means
        that the borders are honest.
    """

    lens: SimulatedLens
    camera: SimulatedCamera
    settings: LensSettings
    scene_sha256: str
    exposure: float
    defocus: float
    vignetting: bool
    lateral: bool
    mirrored_px: int


@dataclass(frozen=True, slots=True, eq=False)
class SimulatedPhoto:
    """A simulated photo and its truth.

    Parameters
    ----------
    mosaic : ndarray, shape (height, width), uint16
        Raw numbers.
    planes : Planes, shape (3, height, width)
        Sensor values of all channels without a mosaic, with noise and clipping of their own.
    clean : Planes, shape (3, height, width)
        The light on the sensor: before noise, quantisation and clipping.
    sharp : Planes, shape (3, height, width)
        The same without blur, lateral colour and vignetting: what a correction should reach.
    truth : Truth
    """

    mosaic: NDArray[np.uint16]
    planes: Planes
    clean: Planes
    sharp: Planes
    truth: Truth


def blurred(
    scene: Planes,
    lens: SimulatedLens,
    settings: LensSettings,
    frame: Frame,
    *,
    pitch_um: float = 4.5,
    size: int = DEFAULT_SIZE,
    step: float = DEFAULT_STEP,
    defocus: float = 0.0,
    lateral: bool = True,
    vignetting: bool = False,
    on_step: StepHook = ignore_step,
) -> Planes:
    """Blur a scene as the lens does: every point becomes the kernel of its place.

    Kernels k_i are exact on a grid of nodes; between them the scene x is divided by smooth windows
    before the convolution, so that the image of a point is a weighted mean of its four neighbours'
    kernels and light is neither lost nor made::

        y = sum_i  k_i * (w_i x)          sum_i w_i = 1,  w_i a raised cosine in row and column

    Parameters
    ----------
    scene : Planes, shape (3, H + 2 m, W + 2 m)
        Linear light, the frame in its middle. Where the margin m is narrower than half a kernel,
        the scene is mirrored.
    lens, settings
        The lens and how it is set; the channel of `settings` is ignored.
    frame : Frame
        The frame, (H, W).
    pitch_um : float
        Pixel pitch in micrometres.
    size : int
        Odd side of the kernels in pixels.
    step : float
        Distance of the nodes in half diagonals.
    defocus : float
        Focus error, waves at the open aperture.
    lateral, vignetting : bool
        Whether to simulate them.
    on_step : StepHook
        Called after each node.

    Returns
    -------
    Planes, shape (3, H, W), float32

    Notes
    -----
    With the default step the kernel between nodes differs from the exact one by a relative L2 of
    0.5 to 3 percent, most in the corners of lenses with long comas. Cost: one kernel and one
    convolution a node and channel, about 10 CPU seconds whatever the number of pixels.

    Source: the windows before the convolution are those of M. Hirsch et al., "Efficient filter flow
    for space-variant multiframe blind deconvolution", CVPR 2010, eq. 2.
    """
    half = size // 2
    padded, _ = _with_margin(scene, frame, half)
    spacing = max(round(step * frame.half_diagonal), 8)
    rows, cols = _nodes(padded.shape[1], spacing), _nodes(padded.shape[2], spacing)
    window = 0.5 + 0.5 * np.cos(np.pi * np.arange(-spacing + 1, spacing) / spacing)
    window = window.astype(np.float32)
    row_c, col_c = (padded.shape[1] - 1) / 2.0, (padded.shape[2] - 1) / 2.0
    out = np.zeros_like(padded, shape=(3, padded.shape[1] + 2 * half, padded.shape[2] + 2 * half))
    total, done = len(rows) * len(cols), 0
    for row in rows:
        for col in cols:
            h = ((col - col_c) / frame.half_diagonal, (row_c - row) / frame.half_diagonal)
            top, left = max(row - spacing + 1, 0), max(col - spacing + 1, 0)
            tile = padded[:, top : row + spacing, left : col + spacing]
            w_row = window[top - row + spacing - 1 :][: tile.shape[1]]
            w_col = window[left - col + spacing - 1 :][: tile.shape[2]]
            light = tile * (w_row[:, None] * w_col[None, :])
            if vignetting:
                light *= np.float32(lens.transmission(h, settings))
            for index, channel in enumerate(CHANNELS):
                offset = (0.0, 0.0)
                r = math.hypot(*h)
                if lateral and channel != "g" and r > 0:
                    outwards = lens.lateral_shift(r, channel, settings.focal_mm) * frame.half_diagonal
                    offset = (-outwards * h[1] / r, outwards * h[0] / r)
                kernel = lens.kernel_at_field(
                    h, settings.with_channel(channel), size, pitch_um=pitch_um, defocus=defocus, offset=offset
                )
                image = _convolved(light[index], kernel.astype(np.float32))
                out[index, top : top + image.shape[0], left : left + image.shape[1]] += image
            done += 1
            on_step(done, total)
    return np.ascontiguousarray(out[:, 2 * half : 2 * half + frame.height, 2 * half : 2 * half + frame.width])


def _nodes(length: int, spacing: int) -> list[int]:
    """Places of the nodes, symmetric about the middle, the outer ones on or beyond the edges."""
    middle = (length - 1) // 2
    before, after = -(-middle // spacing), -(-(length - 1 - middle) // spacing)
    return [middle + k * spacing for k in range(-before, after + 1)]


def _convolved(light: NDArray[np.float32], kernel: NDArray[np.float32]) -> NDArray[np.float32]:
    """Full convolution, larger than `light` by the side of the kernel less one."""
    shape = (light.shape[0] + kernel.shape[0] - 1, light.shape[1] + kernel.shape[1] - 1)
    grid = [int(fft.next_fast_len(n, real=True)) for n in shape]
    product = fft.rfft2(light, s=grid) * fft.rfft2(kernel, s=grid)
    return fft.irfft2(product, s=grid, overwrite_x=True)[: shape[0], : shape[1]]


def _with_margin(scene: Planes, frame: Frame, margin: int) -> tuple[Planes, int]:
    """Cut or mirror the scene to the frame plus `margin`; also how much had to be mirrored."""
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
    return np.asarray(padded, dtype=np.float32), max(missing)


def photograph(
    scene: Planes,
    lens: SimulatedLens,
    settings: LensSettings,
    camera: SimulatedCamera,
    rng: np.random.Generator | None,
    *,
    exposure: float = 1.0,
    size: int = DEFAULT_SIZE,
    step: float = DEFAULT_STEP,
    defocus: float = 0.0,
    lateral: bool = True,
    vignetting: bool = False,
    on_step: StepHook = ignore_step,
) -> SimulatedPhoto:
    """Take a photo: blur, exposure, colour response, noise, clipping, mosaic.

    Parameters
    ----------
    scene : Planes, shape (3, H + 2 m, W + 2 m)
        White-balanced linear light; see `blurred` for the margin.
    lens, settings, camera
        What it is taken with.
    rng : numpy.random.Generator or None
        Source of the noise; None means no noise (quantisation and clipping remain).
    exposure : float
        Multiplies the scene.
    size, step, defocus, lateral, vignetting, on_step
        See `blurred`.

    Returns
    -------
    SimulatedPhoto
    """
    if not (math.isfinite(exposure) and exposure > 0):
        raise InvalidInputError(f"exposure must be positive, got {exposure}")
    frame = camera.frame
    clean = blurred(
        scene,
        lens,
        settings,
        frame,
        pitch_um=camera.pitch_um,
        size=size,
        step=step,
        defocus=defocus,
        lateral=lateral,
        vignetting=vignetting,
        on_step=on_step,
    )
    clean = camera.balanced(np.maximum(clean, 0.0) * np.float32(exposure))
    sharp, _ = _with_margin(scene, frame, 0)
    _, mirrored = _with_margin(scene, frame, size // 2)
    truth = Truth(
        lens=lens,
        camera=camera,
        settings=settings,
        scene_sha256=hashlib.sha256(np.ascontiguousarray(scene, dtype=np.float32).tobytes()).hexdigest(),
        exposure=exposure,
        defocus=defocus,
        vignetting=vignetting,
        lateral=lateral,
        mirrored_px=mirrored,
    )
    logger.info("simulated photo of %s at f/%s", lens.model, settings.aperture)
    return SimulatedPhoto(
        mosaic=camera.mosaic(clean, rng),
        planes=camera.develop(clean, rng),
        clean=clean,
        sharp=camera.balanced(sharp * np.float32(exposure)),
        truth=truth,
    )
