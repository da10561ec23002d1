"""Range: no light darker or brighter than the photo allows, no isolated pixel."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import blocks, near
from lensmodel.audit.base import Pair
from lensmodel.audit.limits import LIMITS
from lensmodel.types import Plane

_NEAR: Final = 9
"""Side in pixels of the neighbourhood whose light bounds that of its middle: most of the light of a usual
lens's point falls within 4 pixels."""
_SURE: Final = 4.0
"""Standard deviations of noise that a value may move without a reason."""
_NOTHING: Final = 2.0
"""Standard deviations of noise that light may lie below nothing: half as many, since an estimate of black
knows its bound."""
_IMPOSSIBLE: Final = 3.0
"""Weight of light below nothing on top of being too dark: no scene has any, while dark lines finer than the
PSF are darker than all that the photo shows. At the median of corrections with kernels 1.6 times too
wide, both then say as much."""


def too_dark(pair: Pair) -> Plane:
    """Severity of light below the photo's darkest within 4 pixels, and below nothing.

    A correction that takes the lens for worse than it is subtracts more light beside every edge than there
    was. How much of what it changed is of this kind, with m the least y around::

        s² = sum ( max(m - x - 4 sigma, 0)² + 3 max(-x - 2 sigma, 0)² ) / sum ( (x - y)² + sigma² )
    """
    least = near.lowest(pair.original, _NEAR)
    below = np.square(np.maximum(least - pair.corrected - np.float32(_SURE) * pair.sigma, np.float32(0.0)))
    nothing = np.maximum(-pair.corrected - np.float32(_NOTHING) * pair.sigma, np.float32(0.0))
    below += np.float32(_IMPOSSIBLE) * np.square(nothing)
    return _share(pair, below, LIMITS["too dark"])


def too_bright(pair: Pair) -> Plane:
    """Severity of light above the photo's brightest within 4 pixels, as a share of what was changed.

    Details narrower than the PSF rise above it with good reason, so that more is allowed than below.
    """
    most = near.highest(pair.original, _NEAR)
    beyond = np.maximum(pair.corrected - most - np.float32(_SURE) * pair.sigma, np.float32(0.0))
    return _share(pair, np.square(beyond), LIMITS["too bright"])


def _share(pair: Pair, power: NDArray[np.float32], limit: float) -> Plane:
    """Root of the share that something has in what was changed around each pixel, over a limit."""
    if "change" not in pair.memo:
        change = np.square(pair.corrected - pair.original) + np.square(pair.sigma)
        pair.memo["change"] = blocks.around(blocks.sums(change.sum(axis=0)))
    part = blocks.around(blocks.sums(power.sum(axis=0)))
    return blocks.to_pixels(np.sqrt(part / pair.memo["change"]) / np.float32(limit), pair.shape)


def isolated(pair: Pair) -> Plane:
    """Severity of single pixels that stand out of their neighbours and not in the photo.

    What it stands out of its 8 neighbours, over what it stands out of a mean of 5 x 5 in the photo and
    four times the noise.
    """
    low, high = near.neighbours(pair.corrected)
    spike = np.maximum(pair.corrected - high, low - pair.corrected)
    bump = np.abs(pair.original - near.mean(pair.original, 5))
    worst = (spike / (bump + np.float32(_SURE) * pair.sigma)).max(axis=0)
    return np.asarray(worst / np.float32(LIMITS["isolated pixels"]), dtype=np.float32)
