"""Range: no light darker or brighter than the photo allows, no isolated pixel."""

from __future__ import annotations

from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import CHANNELS, Kernel
from lensmodel.correction.audit import blocks, nearby
from lensmodel.correction.audit.check import Severity, TilePair
from lensmodel.correction.audit.tolerances import limit

_NEAR: Final = 9
"""Side in pixels of the neighbourhood whose light bounds that of its middle: most of the light of a usual
lens's point falls within 4 pixels."""
_SURE: Final = 4.0
_SPIKE: Final = 12.0
"""Standard deviations of noise by which a value may move, and a pixel stand out, in any case (chosen: of a
million pixels some sixty move by 4 by chance; a correction amplifies noise pixel by pixel, so three times
that before one is a fault)."""
_ROOM: Final = 1.25
"""Factor for points that lie a part of a pixel beside the middle of theirs (chosen: the images of
such points stand out less; much more room would let isolated pixels pass)."""
_USUAL_GAIN: Final = 8.0
"""Gain of a point behind a PSF with a standard deviation of 1 pixel, and the largest gain to assume."""
_NOTHING: Final = 2.0
"""Standard deviations of noise by which light may lie below zero: half as many as in `_SURE`, since an
estimate of black knows its bound."""
_POSSIBLE, _IMPOSSIBLE = 0.25, 3.0
"""Weights of light below the photo's darkest and of light below zero. No scene has the latter, while dark
lines finer than the PSF are darker than anything that the photo shows: with a weight of 1, pictures of slats
and girders would need a limit 1.7 times that of others, with a quarter 1.1 times. Measured once, no command
repeats it."""


def too_dark(pair: TilePair) -> Severity:
    """Severity of light below the photo's darkest within 4 pixels, and below zero.

    A correction that assumes a worse lens subtracts more light beside every edge than there was. The share
    of its change that is of this kind is, with m the least y nearby::

        s² = sum ( max(m - x - 4 sigma, 0)² / 4 + 3 max(-x - 2 sigma, 0)² ) / sum ( (x - y)² + sigma² )
    """
    if pair.loops is not None:
        return _ratio(
            _compiled(pair, pair.loops)[0],
            _compiled(pair, pair.loops)[2],
            limit("too dark", mosaic=pair.evidence.mosaic),
        )
    least = nearby.lowest(pair.original, _NEAR)
    below = np.square(np.maximum(least - pair.corrected - np.float32(_SURE) * pair.sigma, np.float32(0.0)))
    nothing = np.maximum(-pair.corrected - np.float32(_NOTHING) * pair.sigma, np.float32(0.0))
    below *= np.float32(_POSSIBLE)
    below += np.float32(_IMPOSSIBLE) * np.square(nothing)
    return _share(pair, below, limit("too dark", mosaic=pair.evidence.mosaic))


def too_bright(pair: TilePair) -> Severity:
    """Severity of light above the photo's brightest within 4 pixels, as a share of what was changed.

    Details narrower than the PSF rightly rise above it, so more is allowed than below.
    """
    if pair.loops is not None:
        return _ratio(
            _compiled(pair, pair.loops)[1],
            _compiled(pair, pair.loops)[2],
            limit("too bright", mosaic=pair.evidence.mosaic),
        )
    most = nearby.highest(pair.original, _NEAR)
    beyond = np.maximum(pair.corrected - most - np.float32(_SURE) * pair.sigma, np.float32(0.0))
    return _share(pair, np.square(beyond), limit("too bright", mosaic=pair.evidence.mosaic))


def _share(pair: TilePair, power: NDArray[np.float32], allowed: float) -> Severity:
    """Root of the share of a power in that of the change around each pixel, over a limit."""
    if "change" not in pair.memo:
        change = np.square(pair.corrected - pair.original) + np.square(pair.sigma)
        pair.memo["change"] = blocks.windows(change).sum(axis=0)
    return _ratio(blocks.windows(power).sum(axis=0), pair.memo["change"], allowed)


def _ratio(part: NDArray[np.float32], whole: NDArray[np.float32], allowed: float) -> Severity:
    return Severity.of_blocks(np.sqrt(part / whole) / np.float32(allowed))


def _compiled(pair: TilePair, loops: ModuleType) -> NDArray[np.float32]:
    """What is too dark, too bright and changed, around each block; computed once."""
    if "light" not in pair.memo:
        sums = blocks.empty(3, pair.shape)
        sure, weights = (_SURE, _NOTHING), (_POSSIBLE, _IMPOSSIBLE)
        loops.light(pair.original, pair.corrected, pair.sigma, _NEAR // 2, sure, weights, blocks.SIDE, sums)
        pair.memo["light"] = blocks.around(sums)
    return np.asarray(pair.memo["light"])


def isolated(pair: TilePair) -> Severity:
    """Severity of single pixels that stand out of their neighbours, but do not in the photo.

    A point of light I stands out of the mean of the 5 x 5 pixels around it by (k_0 - mean k) I in the photo,
    with k the PSF. So how far a pixel stands out of its 8 neighbours is compared with how far the photo does
    there, over that share, and with 12 times the noise, which a correction may have amplified.
    """
    gains = np.array([_point_gain(pair, c) for c in range(len(CHANNELS))], dtype=np.float32)
    if pair.loops is not None:
        standing = np.empty(pair.shape, dtype=np.float32)
        pair.loops.isolated(pair.original, pair.corrected, pair.sigma, gains, _SPIKE, standing)
        return Severity(standing / np.float32(limit("isolated pixels", mosaic=pair.evidence.mosaic)))
    low, high = nearby.neighbours(pair.corrected)
    spike = np.maximum(pair.corrected - high, low - pair.corrected)
    bump = np.abs(pair.original - nearby.mean(pair.original, 5))
    spike /= gains[:, None, None] * bump + np.float32(_SPIKE) * pair.sigma
    worst = np.maximum(np.maximum(spike[0], spike[1]), spike[2])
    return Severity(worst / np.float32(limit("isolated pixels", mosaic=pair.evidence.mosaic)))


def _point_gain(pair: TilePair, channel: int) -> float:
    """How much more a point stands out of its surroundings than its image does, by the PSF if it is known."""
    if pair.evidence.blurs is None:
        return _USUAL_GAIN
    kernel = pair.evidence.blurs[channel].kernel
    middle = kernel.shape[0] // 2
    share = kernel[middle, middle] - _middle_mean(kernel, middle)
    return float(np.clip(_ROOM / max(share, 1e-6), 1.0, _USUAL_GAIN))


def _middle_mean(kernel: Kernel, middle: int) -> float:
    """Mean of a kernel over the 5 x 5 pixels in its middle."""
    low = max(middle - 2, 0)
    return float(kernel[low : middle + 3, low : middle + 3].sum() / 25.0)
