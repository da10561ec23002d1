"""Hue: no colour that is not in the neighbourhood."""

from __future__ import annotations

from typing import Final

import numpy as np

from lensmodel.audit import blocks, near
from lensmodel.audit.base import Pair
from lensmodel.audit.limits import LIMITS
from lensmodel.types import Plane

_SIDE: Final = 7
_LEAST: Final = 0.02
_FREE, _SHARE = 0.25, 2.0
_NOISE: Final = 4.0
_FLOOR: Final = 12.0


def foreign_hue(pair: Pair) -> Plane:
    """Severity of colours beyond those that the photo shows within 3 pixels.

    Colour is (r - g) / (r + g + b) and (b - g) / (r + g + b) of the photo smoothed over 3 x 3 pixels, where
    noise adds to the light, so that what is dark has no colour to speak of. What lies beyond is judged
    pixel by pixel against a fixed bound, and over an area against the range that the photo has there.
    """
    sigma = pair.sigma.mean(axis=0)
    calm = near.mean(pair.original, 3)
    floor = np.float32(_FLOOR) * sigma
    light = np.maximum(calm, 0.0).sum(axis=0) + floor
    made = np.maximum(pair.corrected, 0.0).sum(axis=0) + floor
    worst = np.zeros(pair.shape, dtype=np.float32)
    for one in (0, 2):
        before = (calm[one] - calm[1]) / light
        after = (pair.corrected[one] - pair.corrected[1]) / made
        low, high = near.lowest(before, _SIDE), near.highest(before, _SIDE)
        span = high - low
        beyond = np.maximum(after - high, low - after) - np.float32(_NOISE) * sigma / made
        beyond = np.maximum(beyond, np.float32(0.0))
        np.maximum(worst, beyond / (_FREE + _SHARE * span), out=worst)
        part = blocks.around(blocks.sums(np.square(beyond)))
        whole = blocks.around(blocks.sums(np.square(span) + np.float32(_LEAST**2)))
        np.maximum(worst, blocks.to_pixels(np.sqrt(part / whole), pair.shape), out=worst)
    return worst / np.float32(LIMITS["hue"])
