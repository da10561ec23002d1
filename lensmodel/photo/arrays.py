"""A photo that is an array already: planes of linear light, without a file."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import CHANNELS, LensSettings, NoiseModel
from lensmodel.photo import Encoding, LinearPhoto, PhotoInfo, PhotoMetadata, estimate_noise


def photo_from_array(
    planes: ArrayLike,
    *,
    noise: NoiseModel | Sequence[NoiseModel] | None = None,
    clip: float = 1.0,
    aperture: float | None = None,
    focal_mm: float | None = None,
    focus_m: float | None = None,
    pixel_pitch_um: float | None = None,
) -> LinearPhoto:
    """Make a developed photo of an array.

    Parameters
    ----------
    planes : array_like of float, shape (3, height, width)
        Red, green and blue in linear light: black 0, saturation at `clip`; kept as float32.
    noise : NoiseModel or sequence of three, optional
        Variance of the pixels against their level; None measures it on the flat places of each plane
        (`estimate_noise`).
    clip : float
        Level at which the sensor saturates.
    aperture : float, optional
        f-number, 0.5 to 128; `focal_mm` in mm and `focus_m` in metres as far as they are known.
    pixel_pitch_um : float, optional
        Pitch of the pixels in micrometres, above 0.

    Returns
    -------
    LinearPhoto

    Raises
    ------
    InvalidInputError
        If the shape is another, a pixel is not finite, or another value is out of its range.
    """
    array = np.ascontiguousarray(planes, dtype=np.float32)
    if array.ndim != 3 or array.shape[0] != len(CHANNELS) or array.size == 0:
        raise InvalidInputError(f"a photo must have the shape (3, height, width), got {array.shape}")
    if not np.isfinite(array).all():
        raise InvalidInputError("a photo must be finite; mask or replace NaN and infinity first")
    if not clip > 0.0:
        raise InvalidInputError(f"clip must be a positive level, got {clip}")
    LensSettings(aperture, focal_mm, focus_m)  # refuses what no lens has
    if pixel_pitch_um is not None and not (math.isfinite(pixel_pitch_um) and pixel_pitch_um > 0.0):
        raise InvalidInputError(
            f"the pixel pitch must be positive micrometres, got {pixel_pitch_um}; leave it out if unknown"
        )
    if isinstance(noise, NoiseModel):
        noise = (noise,) * 3
    known = tuple(noise) if noise is not None else tuple(estimate_noise(plane, clip) for plane in array)
    if len(known) != len(CHANNELS):
        raise InvalidInputError(f"noise needs one model, or one for each of three planes, got {len(known)}")
    _, height, width = array.shape
    metadata = PhotoMetadata(
        aperture=aperture, focal_mm=focal_mm, focus_m=focus_m, pixel_pitch_um=pixel_pitch_um
    )
    return LinearPhoto(
        planes=array,
        frame=Frame(height, width),
        noise=(known[0], known[1], known[2]),
        clip=(clip,) * 3,
        info=PhotoInfo("tiff", width, height, metadata),
        encoding=Encoding(bit_depth=32, transfer="linear", metadata=metadata),
        pipeline="array/1",
    )
