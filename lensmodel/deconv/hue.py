"""Colours that a correction may make: those that the photo shows around."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.blur import UniformBlur
from lensmodel.deconv.base import Sensor
from lensmodel.types import Planes

_UNSURE: Final = 0.1
"""Error of the kernels from which on no new hue is allowed: that of one colour makes hues then (chosen)."""

_NEAR: Final = 2
"""Pixels around each one whose hues are known there (chosen)."""

_LEAST_LIGHT: Final = 3.0
"""Standard deviations of the noise below which light has no hue (chosen)."""


def hue_held(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
) -> Planes:
    """Hold the hue of a result within those of the photo nearby, the more the less the kernels are sure.

    A green kernel that is too wide beside a red one that is too narrow gives every edge a coloured line. The
    light of all colours together stays as it was found.

    Parameters
    ----------
    photo, restored : Planes, shape (channels, rows, cols)
        A tile, and what was made of it.
    blurs, sensors : sequence
        By colour; a lateral shift widens what counts as nearby.
    errors : sequence of float
        Expected relative L2 errors of the kernels.
    """
    share = np.float32(min(max(errors) / _UNSURE, 1.0))
    if share == 0.0 or len(photo) == 1:
        return restored
    shift = max(abs(offset) for blur in blurs for offset in blur.offset)
    side = 2 * (_NEAR + int(np.ceil(shift))) + 1
    clipped = np.stack([p >= np.float32(s.clip) for p, s in zip(photo, sensors, strict=True)])
    noise = np.stack([s.variance(p) for p, s in zip(photo, sensors, strict=True)])
    anywhere = np.asarray(clipped.any(axis=0))
    held = of_known_hue(photo, restored, anywhere, noise, (1, side, side))
    return np.where(anywhere, restored, restored + share * (held - restored)).astype(np.float32)


def of_known_hue(
    photo: Planes,
    made: Planes,
    clipped: NDArray[np.bool_],
    noise: NDArray[np.float32],
    window: tuple[int, int, int],
) -> Planes:
    """Hold each colour's share of the light within those of the photo in a window; light stays the same.

    Clipped pixels have no hue: all colours at saturation are grey on the sensor and pink in the picture.
    """
    floor = np.float32(_LEAST_LIGHT) * np.sqrt(noise.sum(axis=0)) + np.float32(1e-6)

    def shares(planes: Planes) -> Planes:
        positive = np.maximum(planes, np.float32(0.0))
        return np.asarray((positive + floor / len(planes)) / (positive.sum(axis=0) + floor), dtype=np.float32)

    known = shares(photo)
    unknown = np.where(clipped, np.float32(np.inf), known), np.where(clipped, np.float32(-np.inf), known)
    low = np.minimum(ndimage.minimum_filter(unknown[0], window, mode="nearest"), known)
    high = np.maximum(ndimage.maximum_filter(unknown[1], window, mode="nearest"), known)
    light = np.maximum(made, np.float32(0.0)).sum(axis=0) + floor
    share = np.clip(shares(made), low, high)
    share /= share.sum(axis=0)
    return np.asarray(share * light - floor / len(made), dtype=np.float32)
