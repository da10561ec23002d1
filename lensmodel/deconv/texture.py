"""The photo's own texture and grain, which a prior of natural pictures takes for noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.blur import UniformBlur
from lensmodel.deconv.base import Sensor
from lensmodel.deconv.compiled_blur import CompiledBlur
from lensmodel.deconv.engine import compiled
from lensmodel.types import Planes

SHARE: Final = 0.87
"""How much of what a correction leaves unexplained the photo keeps: three quarters of the power of its grain,
so that grain which the inverse of the blur amplifies does not add up to more than there was (chosen)."""

_SMOOTH: Final = 1.2
"""Standard deviation in pixels of the means of what is left of a colour of a mosaic: two of its pixels
(chosen)."""


def texture_kept(
    photo: Planes, restored: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor], share: float
) -> Planes:
    """Give back what a restored picture, blurred again, does not explain of the photo.

    x + share ( y - K x ): where the prior painted a flat area this is the photo's own grain, where it
    erased texture that texture as the photo shows it, and where the data are explained nothing. Pixels that
    are clipped tell nothing.

    Of a mosaic each pixel tells of one colour. Means around it, S_c, tell of all; what is finer is taken for
    light of no colour, as fine detail nearly is, but never for more than the grain of a colour: where red is
    next to nothing, its noise over its light is huge::

        r_c = S_c + L_c sum_k min(1, n_c / n_k) m_k ( e_k - S_k ) / L_k,     e_k = m_k ( y_k - K_k * x_k )

    with L the mean light of a colour in the tile and n its noise over L.

    Parameters
    ----------
    photo, restored : Planes, shape (channels, rows, cols)
        A tile, and what was made of it.
    blurs, sensors : sequence
        By colour.
    share : float
        0 to 1.
    """
    if share <= 0.0:
        return restored
    left = np.stack(
        [_left(*colour) for colour in zip(photo, restored, blurs, sensors, strict=True)], dtype=np.float32
    )
    if all(sensor.measured is None for sensor in sensors):
        return np.asarray(restored + np.float32(share) * left, dtype=np.float32)
    light = np.maximum(photo.mean(axis=(1, 2)), np.float32(1e-4))
    grain = [
        max(float(np.sqrt(sensor.noise.variance(bright))) / float(bright), 1e-9)
        for sensor, bright in zip(sensors, light, strict=True)
    ]
    fine = []
    for c, sensor in enumerate(sensors):
        known = np.ones(photo.shape[1:], np.float32) if sensor.measured is None else sensor.measured
        known = np.asarray(known, dtype=np.float32)
        there = ndimage.gaussian_filter(known, _SMOOTH, mode="nearest")
        mean = ndimage.gaussian_filter(known * left[c], _SMOOTH, mode="nearest") / there
        fine.append(known * (left[c] - mean) / light[c])
        left[c] = mean
    for c in range(len(left)):
        for k, part in enumerate(fine):
            left[c] += light[c] * np.float32(min(1.0, grain[c] / grain[k])) * part
    return np.asarray(restored + np.float32(share) * left, dtype=np.float32)


def _left(
    photo: NDArray[np.float32], restored: NDArray[np.float32], blur: UniformBlur, sensor: Sensor
) -> NDArray[np.float32]:
    """Y - K x where y was measured below saturation, else 0."""
    quick = CompiledBlur.of(blur, compiled("auto"))
    again = quick.forward(np.pad(restored, blur.reach, mode="edge"))
    return np.where(photo < np.float32(sensor.clip), photo - again, np.float32(0.0))
