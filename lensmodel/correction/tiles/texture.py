"""The photo's own texture and grain, which a prior of natural pictures takes for noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.blur.compiled_uniform import CompiledBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.engine import compiled
from lensmodel.correction.tiles.mosaic import BETWEEN

SHARE: Final = 0.87
"""How much of what a correction leaves unexplained the photo keeps: three quarters of the power of its grain,
so that grain which the inverse of the blur amplifies does not add up to more than there was (chosen)."""

_LEAST_VARIANCE: Final = 1e-12  # black without read noise has none

_SMOOTH: Final = 1.2
"""Standard deviation in pixels of the means of what is left of a colour of a mosaic: two of its pixels
(chosen)."""


_GRAIN: Final = 3.0
"""Standard deviations of the noise within which what is left is grain."""

_WINDOW: Final = 7
"""Pixels along a side over which what is left is compared with the noise (chosen)."""
_NOISE, _TEXTURE = 1.5, 4.0
"""Power of what is left over that of the noise, up to which it is noise alone, and from which on texture: the
former is beyond what a variance over so few pixels leaves to chance (chosen)."""


def texture_kept(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    *,
    texture: float = 1.0,
    denoise: float = 0.0,
) -> Planes:
    """Give back what a restored picture, blurred again, does not explain of the photo.

    x + share ( y - K x ): where the prior painted a flat area this is the photo's own grain, where it
    erased texture that texture as the photo shows it, and where the data are explained nothing. Pixels that
    are clipped tell nothing.

    Of a mosaic each pixel tells of one colour, e_k = m_k ( y_k - K_k * x_k ). What is beyond the noise around
    a mean S is detail of that colour, interpolated in it alone, or a coloured edge would show the mosaic. The
    rest g, within the noise, is taken for light of no colour, or grain would be coloured and coarse, but
    never for more than the grain of a colour: where red is next to nothing, its noise over its light is
    huge::

        r_c = S_c + interpolated( e_c - S_c - g_c ) + L_c sum_k min(1, n_c / n_k) g_k / L_k

    with L the mean light of a colour in the tile and n its noise over L.

    Parameters
    ----------
    photo, restored : Planes, shape (channels, rows, cols)
        A tile, and what was made of it.
    blurs, sensors : sequence
        By colour.
    texture : float
        0 to 1: how much of it is given back, of `SHARE`.
    denoise : float
        0 to 1: how much less where it looks like noise alone.
    """
    if texture <= 0.0:
        return restored
    left = np.stack(
        [_left(*colour) for colour in zip(photo, restored, blurs, sensors, strict=True)], dtype=np.float32
    )
    share = np.float32(SHARE * texture) * _kept(left, photo, sensors, denoise)
    if all(sensor.measured is None for sensor in sensors):
        return np.asarray(restored + share * left, dtype=np.float32)
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
        within = np.float32(_GRAIN) * np.sqrt(sensor.variance(photo[c]))
        beyond = left[c] - mean
        grainy = np.clip(beyond, -within, within)
        beyond = ndimage.convolve(known * (beyond - grainy), BETWEEN, mode="nearest")
        fine.append(known * grainy / light[c])
        left[c] = mean + beyond / ndimage.convolve(known, BETWEEN, mode="nearest")
    for c in range(len(left)):
        for k, part in enumerate(fine):
            left[c] += light[c] * np.float32(min(1.0, grain[c] / grain[k])) * part
    return np.asarray(restored + share * left, dtype=np.float32)


def _kept(
    left: Planes, photo: Planes, sensors: Sequence[Sensor], denoise: float
) -> NDArray[np.float32] | np.float32:
    """1 where what is left is texture, 1 - denoise where it is noise."""
    if denoise <= 0.0:
        return np.float32(1.0)
    ratio = np.zeros(photo.shape[1:], dtype=np.float32)
    for plane, light, sensor in zip(left, photo, sensors, strict=True):
        known = np.ones(plane.shape, np.float32) if sensor.measured is None else sensor.measured
        known = np.asarray(known, dtype=np.float32)
        expected = ndimage.uniform_filter(known * sensor.variance(light), _WINDOW)
        ratio += ndimage.uniform_filter(known * plane * plane, _WINDOW) / np.maximum(
            expected, _LEAST_VARIANCE
        )
    t = np.clip((ratio / len(left) - _NOISE) / (_TEXTURE - _NOISE), 0.0, 1.0)
    return np.asarray(1.0 - denoise * (1.0 - t * t * (3.0 - 2.0 * t)), dtype=np.float32)


def _left(
    photo: NDArray[np.float32], restored: NDArray[np.float32], blur: UniformBlur, sensor: Sensor
) -> NDArray[np.float32]:
    """Y - K x where y was measured below saturation, else 0."""
    quick = CompiledBlur.of(blur, compiled("auto"))
    again = quick.forward(np.pad(restored, blur.reach, mode="edge"))
    return np.where(photo < np.float32(sensor.clip), photo - again, np.float32(0.0))
