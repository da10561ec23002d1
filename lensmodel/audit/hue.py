"""Hue: no colour that is not in the neighbourhood."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import blocks, near
from lensmodel.audit.base import Pair, Severity
from lensmodel.audit.limits import LIMITS

_SIDE: Final = 7
_LEAST: Final = 0.02
_FREE, _SHARE = 0.25, 2.0
_WHITE, _BESIDE = 0.95, 5
"""Share of saturation from which on light is white, and side of the square around it that is beside it."""
_FREE_WHITE, _SHARE_WHITE = 0.04, 0.5
"""Chosen: a fifth of one colour of white away is -0.07, what the limit of 1.8 leaves free."""
_NOISE: Final = 4.0
_FLOOR: Final = 12.0


def foreign_spots(pair: Pair) -> Severity:
    """Severity of single colours beyond those that the photo shows within 3 pixels.

    Colour is (r - g) / (r + g + b) and (b - g) / (r + g + b) of the photo smoothed over 3 x 3 pixels, where
    noise adds to the light, so that what is dark has no colour to speak of. Beside white, where all colours
    are saturated, less is free: one that falls alone is seen at once.
    """
    top = np.asarray(pair.evidence.clip, dtype=np.float32)[:, None, None]
    white = near.highest((pair.original / top).min(axis=0), _BESIDE) >= np.float32(_WHITE)
    free, share = (
        np.where(white, np.float32(low), np.float32(usual))
        for low, usual in ((_FREE_WHITE, _FREE), (_SHARE_WHITE, _SHARE))
    )
    worst = np.zeros(pair.shape, dtype=np.float32)
    for beyond, span in _colours(pair):
        np.maximum(worst, beyond / (free + share * span), out=worst)
    return Severity(worst / np.float32(LIMITS["hue, spots"]))


def foreign_area(pair: Pair) -> Severity:
    """Severity of colours beyond those of the photo over an area, in the measure of their range there."""
    worst: NDArray[np.float32] = np.zeros((1, 1), dtype=np.float32)
    for beyond, span in _colours(pair):
        part = blocks.windows(np.square(beyond))
        whole = blocks.windows(np.square(span) + np.float32(_LEAST**2))
        worst = np.maximum(worst, np.sqrt(part / whole))
    return Severity.of_blocks(worst / np.float32(LIMITS["hue, area"]))


def _colours(pair: Pair) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """How far each of two colours lies beyond its range in the photo, and that range; made once."""
    if "colours" not in pair.memo:
        sigma = (pair.sigma[0] + pair.sigma[1] + pair.sigma[2]) * np.float32(1.0 / 3.0)
        calm = near.mean(pair.original, 3)
        floor = np.float32(_FLOOR) * sigma
        light, made = (
            np.maximum(p[0], 0.0) + np.maximum(p[1], 0.0) + np.maximum(p[2], 0.0) + floor
            for p in (calm, pair.corrected)
        )
        before = np.stack([calm[0] - calm[1], calm[2] - calm[1]]) / light
        x = pair.corrected
        after = np.stack([x[0] - x[1], x[2] - x[1]]) / made
        low, high = near.lowest(before, _SIDE), near.highest(before, _SIDE)
        beyond = np.maximum(after - high, low - after) - np.float32(_NOISE) * sigma / made
        pair.memo["colours"] = list(zip(np.maximum(beyond, np.float32(0.0)), high - low, strict=True))
    found: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = pair.memo["colours"]
    return found
