"""Hue: no colour that the neighbourhood does not have."""

from __future__ import annotations

from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.correction.audit import blocks, nearby
from lensmodel.correction.audit.check import Severity, TilePair
from lensmodel.correction.audit.tolerances import limit

_SIDE: Final = 7
"""Of the neighbourhood in pixels (chosen: a narrower one holds only the mixed colours of an edge's blur, a
wider one the colours of other things)."""
_LEAST: Final = 0.02
"""Range of colours that every neighbourhood is given (chosen: in a grey one any change at all would else be
infinitely large; a fiftieth is not seen)."""
_FREE, _SHARE = 0.25, 2.0
"""What a colour may leave the range nearby by: so much, and so many times the range (chosen: a speck smaller
than its blur is more colourful than the photo shows, and less room would hold it back; with more, foreign
colours would pass)."""
_WHITE, _BESIDE = 0.95, 5
"""Share of saturation at and above which light is white, and side in pixels of the square around it that is
beside it (chosen: demosaicing mixes light over about two pixels to either side; far below the limit, light
has a colour of its own)."""
_FREE_WHITE, _SHARE_WHITE = 0.04, 0.5
"""The same beside white. Chosen: a fifth of one colour of white missing is -0.07, which a limit of 1.8
allows."""
_NOISE: Final = 4.0  # standard deviations (chosen): noise alone exceeds them once in 16,000
_FLOOR: Final = 12.0  # standard deviations that dampen hue (chosen: at 12, noise alone moves it by a tenth)


def foreign_spots(pair: TilePair) -> Severity:
    """Severity of single colours beyond those that the photo shows within 3 pixels.

    Colour is (r - g) / (r + g + b) and (b - g) / (r + g + b) of the photo smoothed over 3 x 3 pixels, where
    noise adds to the light, so that dark places have hardly any colour. Beside white, where all colours
    are saturated, less is allowed: a colour that falls alone is seen at once.
    """
    if pair.loops is not None:
        return Severity(
            _compiled(pair, pair.loops)[0] / np.float32(limit("hue, spots", mosaic=pair.evidence.mosaic))
        )
    white = _beside_white(pair)
    free, share = (
        np.where(white, np.float32(low), np.float32(usual))
        for low, usual in ((_FREE_WHITE, _FREE), (_SHARE_WHITE, _SHARE))
    )
    worst = np.zeros(pair.shape, dtype=np.float32)
    for beyond, span in _colours(pair):
        np.maximum(worst, beyond / (free + share * span), out=worst)
    return Severity(worst / np.float32(limit("hue, spots", mosaic=pair.evidence.mosaic)))


def foreign_area(pair: TilePair) -> Severity:
    """Severity of colours beyond those of the photo over an area, relative to their range there."""
    if pair.loops is not None:
        return Severity.of_blocks(
            _compiled(pair, pair.loops)[1] / np.float32(limit("hue, area", mosaic=pair.evidence.mosaic))
        )
    worst: NDArray[np.float32] = np.zeros((1, 1), dtype=np.float32)
    for beyond, span in _colours(pair):
        part = blocks.windows(np.square(beyond))
        whole = blocks.windows(np.square(span) + np.float32(_LEAST**2))
        worst = np.maximum(worst, np.sqrt(part / whole))
    return Severity.of_blocks(worst / np.float32(limit("hue, area", mosaic=pair.evidence.mosaic)))


def _beside_white(pair: TilePair) -> NDArray[np.bool_]:
    """Where all colours are saturated close by."""
    top = np.asarray(pair.evidence.clip, dtype=np.float32)[:, None, None]
    least = (pair.original / top).min(axis=0)
    if least.max(initial=0.0) < _WHITE:
        return np.zeros(pair.shape, dtype=bool)
    return np.asarray(nearby.highest(least, _BESIDE) >= np.float32(_WHITE))


def _compiled(pair: TilePair, loops: ModuleType) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Figures of both checks before their limits, of pixels and of blocks; computed once."""
    if "hue" not in pair.memo:
        spots, sums = np.empty(pair.shape, dtype=np.float32), blocks.empty(4, pair.shape)
        limits = np.array([_FREE, _SHARE, _FREE_WHITE, _SHARE_WHITE, _NOISE, _FLOOR], dtype=np.float32)
        white = _beside_white(pair).astype(np.float32)
        loops.colours(
            pair.original, pair.corrected, pair.sigma, white, limits, _SIDE // 2, blocks.SIDE, sums, spots
        )
        sums[1::2] += np.float32(_LEAST**2) * blocks.sizes(pair.shape)
        wide = blocks.around(sums)
        pair.memo["hue"] = spots, np.sqrt((wide[0::2] / wide[1::2]).max(axis=0))
    spots, area = pair.memo["hue"]
    return spots, area


def _colours(pair: TilePair) -> list[tuple[NDArray[np.float32], NDArray[np.float32]]]:
    """How far each of two colours lies beyond its range in the photo, and that range; computed once."""
    if "colours" not in pair.memo:
        sigma = (pair.sigma[0] + pair.sigma[1] + pair.sigma[2]) * np.float32(1.0 / 3.0)
        calm = nearby.mean(pair.original, 3)
        floor = np.float32(_FLOOR) * sigma
        light_before, light_after = (
            np.maximum(p[0], 0.0) + np.maximum(p[1], 0.0) + np.maximum(p[2], 0.0) + floor
            for p in (calm, pair.corrected)
        )
        before = np.stack([calm[0] - calm[1], calm[2] - calm[1]]) / light_before
        x = pair.corrected
        after = np.stack([x[0] - x[1], x[2] - x[1]]) / light_after
        low, high = nearby.lowest(before, _SIDE), nearby.highest(before, _SIDE)
        beyond = np.maximum(after - high, low - after) - np.float32(_NOISE) * sigma / light_after
        pair.memo["colours"] = list(zip(np.maximum(beyond, np.float32(0.0)), high - low, strict=True))
    colours: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = pair.memo["colours"]
    return colours
