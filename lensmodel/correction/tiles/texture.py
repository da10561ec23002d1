"""The photo's own texture and grain, which a prior of natural pictures mistakes for noise."""

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
"""Share of the unexplained residual that is added back: three quarters of the power of the grain, so that
together with grain that the inverse of the blur amplifies it is no more than there was (chosen)."""

_LEAST_VARIANCE: Final = 1e-12  # black without read noise has none

_SMOOTH: Final = 1.2
"""Standard deviation in pixels of the local means of a mosaic colour's residual: two of its pixels
(chosen)."""


_GRAIN: Final = 3.0
"""Standard deviations of the noise within which a residual is grain (chosen: noise exceeds them in one pixel
of 400; further out, it is an error of the PSF that must not be added back)."""

_WINDOW: Final = 7
"""Side in pixels of the window in which the residual is compared with the noise (chosen: the power of fewer
pixels is known too badly, a wider window mixes texture with what is beside it)."""
_NOISE, _TEXTURE = 1.5, 4.0
"""Power of the residual over that of the noise: up to the first it is noise alone, from the second it is
texture. The first is more than chance makes of a variance over so few pixels (chosen)."""


def texture_kept(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    *,
    texture: float = 1.0,
    denoise: float = 0.0,
) -> Planes:
    """Add back the part of the photo that a restored picture, blurred again, does not explain.

    x + share ( y - K x ): where the prior painted a flat area this is the photo's own grain, where it
    erased texture it is that texture as the photo shows it, and where the data are explained it is nothing.
    Clipped pixels do not count.

    In a mosaic each pixel measures one colour, e_k = m_k ( y_k - K_k * x_k ). What exceeds the noise around
    a mean S is detail of that colour, interpolated in it alone, or a coloured edge would show the mosaic. The
    rest g, within the noise, counts as light of no colour, or grain would be coloured and coarse, but
    never as more than the grain of a colour: where red is next to nothing, its noise over its light is
    huge::

        r_c = S_c + interpolated( e_c - S_c - g_c ) + L_c sum_k min(1, n_c / n_k) g_k / L_k

    with L the mean light of a colour in the tile and n its noise over L.

    Parameters
    ----------
    photo, restored : Planes, shape (channels, rows, cols)
        A tile, and its correction.
    blurs, sensors : sequence
        By colour.
    texture : float
        0 to 1: how much of `SHARE` is added back.
    denoise : float
        0 to 1: how much less is added back where it looks like noise alone.
    """
    if texture <= 0.0:
        return restored
    residual = np.stack(
        [_residual(*colour) for colour in zip(photo, restored, blurs, sensors, strict=True)], dtype=np.float32
    )
    share = np.float32(SHARE * texture) * _texture_share(residual, photo, sensors, denoise)
    if all(sensor.measured is None for sensor in sensors):
        return np.asarray(restored + share * residual, dtype=np.float32)
    light = np.maximum(photo.mean(axis=(1, 2)), np.float32(1e-4))
    grain = [
        max(float(np.sqrt(sensor.noise.variance(bright))) / float(bright), 1e-9)
        for sensor, bright in zip(sensors, light, strict=True)
    ]
    fine = []
    for c, sensor in enumerate(sensors):
        known = np.ones(photo.shape[1:], np.float32) if sensor.measured is None else sensor.measured
        known = np.asarray(known, dtype=np.float32)
        weight = ndimage.gaussian_filter(known, _SMOOTH, mode="nearest")
        mean = ndimage.gaussian_filter(known * residual[c], _SMOOTH, mode="nearest") / weight
        within = np.float32(_GRAIN) * np.sqrt(sensor.variance(photo[c]))
        beyond = residual[c] - mean
        grainy = np.clip(beyond, -within, within)
        beyond = ndimage.convolve(known * (beyond - grainy), BETWEEN, mode="nearest")
        fine.append(known * grainy / light[c])
        residual[c] = mean + beyond / ndimage.convolve(known, BETWEEN, mode="nearest")
    for c in range(len(residual)):
        for k, part in enumerate(fine):
            residual[c] += light[c] * np.float32(min(1.0, grain[c] / grain[k])) * part
    return np.asarray(restored + share * residual, dtype=np.float32)


def _texture_share(
    residual: Planes, photo: Planes, sensors: Sequence[Sensor], denoise: float
) -> NDArray[np.float32] | np.float32:
    """1 where the residual is texture, 1 - denoise where it is noise."""
    if denoise <= 0.0:
        return np.float32(1.0)
    ratio = np.zeros(photo.shape[1:], dtype=np.float32)
    for plane, light, sensor in zip(residual, photo, sensors, strict=True):
        known = np.ones(plane.shape, np.float32) if sensor.measured is None else sensor.measured
        known = np.asarray(known, dtype=np.float32)
        expected = ndimage.uniform_filter(known * sensor.variance(light), _WINDOW)
        ratio += ndimage.uniform_filter(known * plane * plane, _WINDOW) / np.maximum(
            expected, _LEAST_VARIANCE
        )
    t = np.clip((ratio / len(residual) - _NOISE) / (_TEXTURE - _NOISE), 0.0, 1.0)
    return np.asarray(1.0 - denoise * (1.0 - t * t * (3.0 - 2.0 * t)), dtype=np.float32)


def _residual(
    photo: NDArray[np.float32], restored: NDArray[np.float32], blur: UniformBlur, sensor: Sensor
) -> NDArray[np.float32]:
    """Y - K x where y was measured below saturation, else 0."""
    quick = CompiledBlur.of(blur, compiled("auto"))
    again = quick.forward(np.pad(restored, blur.reach, mode="edge"))
    return np.where(photo < np.float32(sensor.clip), photo - again, np.float32(0.0))
