"""Hue: no colour that is not in the neighbourhood."""

from __future__ import annotations

from typing import Final

import numpy as np
from scipy import ndimage

from lensmodel.audit.base import Evidence, sigma_of
from lensmodel.types import Plane, Planes

_SIDE: Final = 7
_FREE: Final = 0.1
_SHARE: Final = 2.0
_NOISE: Final = 4.0


def foreign_hue(original: Planes, corrected: Planes, evidence: Evidence) -> Plane:
    """Severity of colours beyond those that the photo shows within 3 pixels.

    Colour is (r - g) / (r + g + b) and (b - g) / (r + g + b), a share of the light, so that what is dark has
    none to speak of.
    """
    sigma = np.mean([sigma_of(n, y) for n, y in zip(evidence.noise, original, strict=True)], axis=0)
    calm = ndimage.uniform_filter(original, (1, 3, 3))
    floor = np.float32(12.0) * sigma
    light = np.maximum(calm, 0.0).sum(axis=0) + floor
    bounded = np.minimum(corrected, np.asarray(evidence.clip, dtype=np.float32)[:, None, None])
    made = np.maximum(bounded, 0.0).sum(axis=0) + floor
    worst = np.zeros(original.shape[1:], dtype=np.float32)
    for one in (0, 2):
        before = (calm[one] - calm[1]) / light
        after = (bounded[one] - bounded[1]) / made
        low, high = ndimage.minimum_filter(before, _SIDE), ndimage.maximum_filter(before, _SIDE)
        beyond = np.maximum(after - high, low - after)
        allowed = _FREE + _SHARE * (high - low) + _NOISE * sigma / made
        np.maximum(worst, beyond / allowed, out=worst)
    return worst
