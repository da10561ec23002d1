"""A sensor, and the photo that it takes through a simulated lens."""

from __future__ import annotations

import hashlib
import logging
import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import CHANNELS, LensSettings, NoiseModel, Planes, StepHook, ignore_step
from lensmodel.photo.dng import XYZ_TO_SRGB
from lensmodel.simulate.blur import BlurOptions, blurred, with_margin
from lensmodel.simulate.lens import CameraLens

logger = logging.getLogger(__name__)

PATTERNS: Final = ("RGGB", "BGGR", "GRBG", "GBRG")

_BITS: Final = (8, 16)  # of the raw files that cameras write


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
        """Index into r, g, b of the colour filter over every pixel, `(height, width)`.

        Returns
        -------
        ndarray of int, shape (height, width)
        """
        cell = np.array(["RGB".index(letter) for letter in self.pattern]).reshape(2, 2)
        return np.tile(cell, (self.height // 2, self.width // 2))

    def balanced(self, planes: Planes) -> Planes:
        """What the sensor sees of a scene: each channel over its white balance multiplier.

        Parameters
        ----------
        planes : Planes, shape (3, H, W), float32
            White-balanced linear light.

        Returns
        -------
        Planes, shape (3, H, W), float32
        """
        gains = np.asarray(self.white_balance, dtype=np.float32)[:, None, None]
        return np.ascontiguousarray(planes / gains)

    def mosaic(self, planes: Planes, rng: np.random.Generator | None) -> NDArray[np.uint16]:
        """Raw numbers of the light `planes` (sensor values, saturation 1); no noise without `rng`.

        Parameters
        ----------
        planes : Planes, shape (3, H, W), float32
            Sensor values.
        rng : numpy.random.Generator or None
            Source of the noise.

        Returns
        -------
        ndarray of uint16, shape (H, W)
        """
        self._check(planes)
        light = np.take_along_axis(planes, self.channel_map()[None], axis=0)[0]
        return self._numbers(self._noisy(light, rng))

    def develop(self, planes: Planes, rng: np.random.Generator | None) -> Planes:
        """Three full planes with noise, quantised and clipped at 1: a sensor without a mosaic.

        Parameters
        ----------
        planes : Planes, shape (3, H, W), float32
            Sensor values.
        rng : numpy.random.Generator or None
            Source of the noise; None makes none.

        Returns
        -------
        Planes, shape (3, H, W), float32
        """
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
    options : BlurOptions
        Focus error, which effects were simulated, and the grid of kernels.
    mirrored_px : int
        Width of the margin beyond the frame that had to be mirrored because the scene ended; 0 means
        that the borders are honest.
    """

    lens: CameraLens
    camera: SimulatedCamera
    settings: LensSettings
    scene_sha256: str
    exposure: float
    options: BlurOptions
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


def photograph(
    scene: Planes,
    lens: CameraLens,
    settings: LensSettings,
    camera: SimulatedCamera,
    rng: np.random.Generator | None,
    *,
    exposure: float = 1.0,
    options: BlurOptions | None = None,
    on_step: StepHook = ignore_step,
) -> SimulatedPhoto:
    """Take a photo: blur, exposure, colour response, noise, clipping, mosaic.

    Parameters
    ----------
    scene : Planes, shape (3, H + 2 m, W + 2 m)
        White-balanced linear light; see `blurred` for the margin.
    lens, settings, camera
        What it is taken with. The pixel pitch is the camera's.
    rng : numpy.random.Generator or None
        Source of the noise; None means no noise (quantisation and clipping remain).
    exposure : float
        Multiplies the scene.
    options : BlurOptions, optional
        See `blurred`; its pitch is replaced by the camera's.
    on_step : StepHook
        See `blurred`.

    Returns
    -------
    SimulatedPhoto

    Raises
    ------
    InvalidInputError
        If the scene does not fit the frame, or an argument is out of its range.
    """
    if not (math.isfinite(exposure) and exposure > 0):
        raise InvalidInputError(f"exposure must be positive, got {exposure}")
    options = replace(options or BlurOptions(), pitch_um=camera.pitch_um)
    frame = camera.frame
    clean = blurred(scene, lens, settings, frame, options, on_step=on_step)
    clean = camera.balanced(clean * np.float32(exposure))
    sharp, _ = with_margin(scene, frame, 0)
    _, mirrored = with_margin(scene, frame, options.size // 2)
    truth = Truth(
        lens=lens,
        camera=camera,
        settings=settings,
        scene_sha256=hashlib.sha256(np.ascontiguousarray(scene, dtype=np.float32).tobytes()).hexdigest(),
        exposure=exposure,
        options=options,
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
