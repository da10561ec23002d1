"""Range: no light darker or brighter than the photo allows, no isolated pixel."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import blocks, near
from lensmodel.audit.base import Pair
from lensmodel.types import Plane

NEGATIVE: Final = 0.15
DARK: Final = 0.3
BRIGHT: Final = 0.75
SPIKE: Final = 8.0
_NEAR: Final = 9
"""Side in pixels of the neighbourhood whose light bounds that of its middle: most of the light of a usual
lens's point falls within 4 pixels."""
_FREE: Final = 2.0
_SURE: Final = 4.0
"""Standard deviations of noise that may be negative light, and that a value may move without a reason."""


def negative_light(pair: Pair) -> Plane:
    """Severity of light below nothing.

    A correction that takes the lens for worse than it is subtracts more light beside every edge than there
    was. How much of what it changed is of this kind::

        s² = sum max(-x - 2 sigma, 0)² / sum ((x - y)² + sigma²)
    """
    below = np.maximum(-pair.corrected - np.float32(_FREE) * pair.sigma, np.float32(0.0))
    return _share(pair, below, NEGATIVE)


def too_dark(pair: Pair) -> Plane:
    """Severity of light below the photo's darkest within 4 pixels, as a share of what was changed."""
    low = near.lowest(pair.original, _NEAR)
    beyond = np.maximum(low - pair.corrected - np.float32(_SURE) * pair.sigma, np.float32(0.0))
    return _share(pair, beyond, DARK)


def too_bright(pair: Pair) -> Plane:
    """Severity of light above the photo's brightest within 4 pixels, as a share of what was changed.

    Details narrower than the PSF rise above it with good reason, so that more is allowed than below.
    """
    high = near.highest(pair.original, _NEAR)
    beyond = np.maximum(pair.corrected - high - np.float32(_SURE) * pair.sigma, np.float32(0.0))
    return _share(pair, beyond, BRIGHT)


def _share(pair: Pair, beyond: NDArray[np.float32], limit: float) -> Plane:
    """Root of the share that something has in what was changed around each pixel, over a limit."""
    change = np.square(pair.corrected - pair.original) + np.square(pair.sigma)
    part = blocks.around(blocks.sums(np.square(beyond).sum(axis=0)))
    whole = blocks.around(blocks.sums(change.sum(axis=0)))
    return blocks.to_pixels(np.sqrt(part / whole) / np.float32(limit), pair.shape)


def isolated(pair: Pair) -> Plane:
    """Severity of single pixels that stand out of their neighbours and not in the photo.

    What it stands out of its 8 neighbours, over what it stands out of a mean of 5 x 5 in the photo and
    four times the noise.
    """
    low, high = near.neighbours(pair.corrected)
    spike = np.maximum(pair.corrected - high, low - pair.corrected)
    bump = np.abs(pair.original - near.mean(pair.original, 5))
    worst = (spike / (bump + np.float32(_SURE) * pair.sigma)).max(axis=0)
    return np.asarray(worst / np.float32(SPIKE), dtype=np.float32)
