"""The JPEG that a camera makes of its own raw numbers: tone curve, denoising, sharpening, half the chroma."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import atomic
from lensmodel.core.types import CHANNELS, Planes
from lensmodel.photo.tags.exif_block import exif_block
from lensmodel.photo.values import LensIdentity, PhotoMetadata
from lensmodel.simulate.camera import SimulatedCamera, SimulatedPhoto
from lensmodel.simulate.files import shot_info

_LUMA: Final = (0.299, 0.587, 0.114)
"""Weights of r, g, b in luma: ITU-R BT.601, as JFIF 1.02 asks."""

_BLUE, _RED = 1.772, 1.402  # Cb = (B - Y) / 1.772, Cr = (R - Y) / 1.402: JFIF 1.02
_SUBSAMPLINGS: Final = MappingProxyType({"4:4:4": 0, "4:2:2": 1, "4:2:0": 2})  # Pillow's numbers
_CURVE: Final = np.linspace(0.0, 1.0, 4097)  # light at which the tone curve is read

# Gradient-corrected linear interpolation: H. S. Malvar, L. He, R. Cutler, "High-quality linear interpolation
# for demosaicing of Bayer-patterned color images", ICASSP 2004, figure 2.
_GREEN: Final = np.array(
    [[0, 0, -1, 0, 0], [0, 0, 2, 0, 0], [-1, 2, 4, 2, -1], [0, 0, 2, 0, 0], [0, 0, -1, 0, 0]]
) / np.float32(8.0)
_BESIDE: Final = np.array(
    [[0, 0, 0.5, 0, 0], [0, -1, 0, -1, 0], [-1, 4, 5, 4, -1], [0, -1, 0, -1, 0], [0, 0, 0.5, 0, 0]]
) / np.float32(8.0)
_ACROSS: Final = np.array(
    [[0, 0, -1.5, 0, 0], [0, 2, 0, 2, 0], [-1.5, 0, 6, 0, -1.5], [0, 2, 0, 2, 0], [0, 0, -1.5, 0, 0]]
) / np.float32(8.0)


@dataclass(frozen=True, slots=True)
class CameraJpeg:
    """How a camera makes a JPEG: balance, demosaicing, tone curve, denoising, unsharp mask, compression.

    Parameters
    ----------
    radius : float
        Standard deviation of the unsharp mask's Gaussian, pixels.
    amount : float
        Of the unsharp mask: Y + amount (Y - G Y), on luma after the tone curve. 0 does not sharpen.
    denoise : float
        Threshold of luma's fine details, in standard deviations of the sensor's noise as the curve makes it.
        Chroma is smoothed by a Gaussian of that many pixels. 0 does not denoise.
    contrast : float
        Share of the smooth step 3 v² - 2 v³ in the tone curve, 0 for that of sRGB alone.
    subsampling : {"4:4:4", "4:2:2", "4:2:0"}
        Resolution of chroma.
    quality : int
        1 to 100, of the tables of the Independent JPEG Group.
    """

    radius: float = 0.8
    amount: float = 0.7
    denoise: float = 1.0
    contrast: float = 0.3
    subsampling: str = "4:2:0"
    quality: int = 92

    def __post_init__(self) -> None:
        if self.subsampling not in _SUBSAMPLINGS:
            raise InvalidInputError(
                f"subsampling must be one of {', '.join(_SUBSAMPLINGS)}, got {self.subsampling!r}"
            )
        if not (0.1 <= self.radius <= 10.0 and 0.0 <= self.amount <= 5.0 and 0.0 <= self.denoise <= 10.0):
            raise InvalidInputError(f"radius, amount or denoise is out of its range in {self}")
        if not (0.0 <= self.contrast <= 1.0 and 1 <= self.quality <= 100):
            raise InvalidInputError(f"contrast must lie in 0..1 and quality in 1..100, got {self}")

    def tone(self, light: NDArray[np.floating]) -> NDArray[np.float32]:
        """File values 0..1 of linear light: sRGB (IEC 61966-2-1), then the contrast."""
        value = np.clip(light, 0.0, 1.0)
        value = np.where(value <= 0.0031308, 12.92 * value, 1.055 * value ** (1 / 2.4) - 0.055)
        step = value * value * (3.0 - 2.0 * value)
        return np.asarray(value + self.contrast * (step - value), dtype=np.float32)

    def picture(self, mosaic: NDArray[np.uint16], camera: SimulatedCamera) -> NDArray[np.uint8]:
        """8-bit numbers `(row, col, channel)` of a mosaic, before compression."""
        level = (mosaic.astype(np.float32) - np.float32(camera.black)) / np.float32(
            camera.white - camera.black
        )
        gains = np.asarray(camera.white_balance, dtype=np.float32)
        balanced = level * gains[camera.channel_map()]
        toned = self.tone(_demosaiced(np.minimum(balanced, np.float32(1.0)), camera))
        luma, blue, red = _split(toned)
        if self.denoise > 0.0:
            luma = _cored(luma, np.float32(self.denoise) * self._noise(luma, camera))
            blue, red = (ndimage.gaussian_filter(plane, self.denoise) for plane in (blue, red))
        return _numbers(_joined(self._sharpened(luma), blue, red))

    def rendered(self, light: Planes, camera: SimulatedCamera) -> Planes:
        """File values 0..1 of the light on a sensor, `(3, height, width)`, rendered as its photos are.

        Without mosaic, noise, denoising and rounding: of the sharp scene this is what the camera would have
        shown behind a lens without blur. Chroma has the resolution of the file.
        """
        gains = np.asarray(camera.white_balance, dtype=np.float32)[:, None, None]
        luma, blue, red = _split(self.tone(light * gains))
        down = (2 if self.subsampling == "4:2:0" else 1, 1 if self.subsampling == "4:4:4" else 2)
        blue, red = (_halved(plane, down) for plane in (blue, red))
        return np.clip(_joined(self._sharpened(luma), blue, red), 0.0, 1.0)

    def write(self, path: str | Path, photo: SimulatedPhoto) -> None:
        """Write the JPEG of a simulated photo with what its camera says of lens and exposure."""
        shot = shot_info(photo)
        said = PhotoMetadata(
            camera_maker=shot.camera_maker,
            camera_model=shot.camera_model,
            lens=LensIdentity(maker=shot.lens_maker, model=shot.lens_model),
            aperture=shot.aperture,
            focal_mm=shot.focal_mm,
            focus_m=shot.focus_m,
            iso=shot.iso,
            exposure_s=shot.exposure_s,
        )
        pixels = self.picture(photo.mosaic, photo.truth.camera)
        with atomic(Path(path)) as file:
            Image.fromarray(pixels).save(
                file,
                "JPEG",
                quality=self.quality,
                subsampling=_SUBSAMPLINGS[self.subsampling],
                exif=b"Exif\0\0" + exif_block(said, 1),
            )

    def _sharpened(self, luma: NDArray[np.float32]) -> NDArray[np.float32]:
        soft = ndimage.gaussian_filter(luma, self.radius)
        return luma + np.float32(self.amount) * (luma - soft)

    def _noise(self, luma: NDArray[np.float32], camera: SimulatedCamera) -> NDArray[np.float32]:
        """Standard deviation of the sensor's noise in file values where luma is so bright."""
        values = self.tone(_CURVE)
        deviation = np.sqrt(camera.noise.variance(_CURVE)) * np.gradient(values, _CURVE)
        return np.interp(luma, values, deviation).astype(np.float32)


CAMERA_JPEGS: Final[Mapping[str, CameraJpeg]] = MappingProxyType(
    {
        "soft": CameraJpeg(
            radius=0.6, amount=0.3, denoise=0.5, contrast=0.1, subsampling="4:2:2", quality=97
        ),
        "usual": CameraJpeg(),
        "strong": CameraJpeg(radius=1.1, amount=1.2, denoise=2.0, contrast=0.5, quality=85),
    }
)
"""Three kinds of cameras, from one set to soft pictures to one that makes them crisp."""


def _demosaiced(mosaic: NDArray[np.float32], camera: SimulatedCamera) -> Planes:
    """Three full planes of a mosaic; see the source at the top."""
    colour = camera.channel_map()
    green, along, down, across = (
        ndimage.convolve(mosaic, kernel, mode="mirror") for kernel in (_GREEN, _BESIDE, _BESIDE.T, _ACROSS)
    )
    planes = np.empty((len(CHANNELS), *mosaic.shape), dtype=np.float32)
    planes[1] = np.where(colour == 1, mosaic, green)
    for own, other in ((0, 2), (2, 0)):
        in_row = np.broadcast_to((colour == own).any(axis=1, keepdims=True), colour.shape)
        beside = np.where(in_row, along, down)
        planes[own] = np.where(colour == own, mosaic, np.where(colour == other, across, beside))
    return np.clip(planes, 0.0, 1.0)


def _split(values: NDArray[np.float32]) -> tuple[NDArray[np.float32], ...]:
    """Luma, Cb and Cr, the latter around 0."""
    luma = np.tensordot(np.asarray(_LUMA, dtype=np.float32), values, axes=1)
    return luma, (values[2] - luma) / np.float32(_BLUE), (values[0] - luma) / np.float32(_RED)


def _joined(luma: NDArray[np.float32], blue: NDArray[np.float32], red: NDArray[np.float32]) -> Planes:
    r, b = luma + np.float32(_RED) * red, luma + np.float32(_BLUE) * blue
    g = (luma - np.float32(_LUMA[0]) * r - np.float32(_LUMA[2]) * b) / np.float32(_LUMA[1])
    return np.stack([r, g, b])


def _cored(luma: NDArray[np.float32], threshold: NDArray[np.float32]) -> NDArray[np.float32]:
    """Two octaves of detail without what lies within a threshold, half of it in the coarser one."""
    base = luma
    kept = np.zeros_like(luma)
    for sigma, share in ((0.8, 1.0), (1.6, 0.5)):
        soft = ndimage.gaussian_filter(luma, sigma)
        detail = base - soft
        size = np.abs(detail) - np.float32(share) * threshold
        kept += np.copysign(np.maximum(size, np.float32(0.0)), detail)
        base = soft
    return base + kept


def _halved(plane: NDArray[np.float32], down: tuple[int, int]) -> NDArray[np.float32]:
    """Means over cells, interpolated linearly between their centres, as JFIF centres them."""
    for axis, step in enumerate(down):
        if step == 1:
            continue
        even = plane.take(range(0, plane.shape[axis] // 2 * 2, 2), axis)
        odd = plane.take(range(1, plane.shape[axis] // 2 * 2, 2), axis)
        small = (even + odd) / np.float32(2.0)
        at = np.clip((np.arange(plane.shape[axis]) - 0.5) / 2.0, 0.0, small.shape[axis] - 1.0)
        low = np.minimum(at.astype(np.intp), small.shape[axis] - 2)
        share = np.expand_dims((at - low).astype(np.float32), 1 - axis)
        plane = small.take(low, axis) * (1 - share) + small.take(low + 1, axis) * share
    return plane


def _numbers(values: Planes) -> NDArray[np.uint8]:
    rounded = np.rint(np.clip(values, 0.0, 1.0) * np.float32(255.0)).astype(np.uint8)
    return np.ascontiguousarray(np.moveaxis(rounded, 0, -1))
