"""Ringing: waves beside strong edges, where the photo is flat."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.correction.audit import blocks, nearby
from lensmodel.correction.audit.check import Severity, TilePair
from lensmodel.correction.audit.tolerances import LIMITS

_SMALL, _WIDE = 5, 15
"""Sides in pixels of a place that should be flat, and of the window in which its edge may lie (chosen: the
first holds a whole wave near the limit of the grid, the second an edge from which waves have not yet died
away; in wider ones few places are flat, and steps belong to something else)."""
_FLAT: Final = 0.08
"""Share of the step nearby up to which a place passes for flat (chosen: with less, hardly a
place beside an edge is flat; with more, the edge's own slope counts as a wave)."""
_NOISE: Final = 8.0
"""Standard deviations between the extremes of 25 pixels of noise: four on average, and twice that, so that no
noisy place is left out for its noise (chosen)."""
_STRONG: Final = 40.0
"""Standard deviations of a step that can ring visibly (chosen: a wave of a tenth of it is as large as the
range of 25 pixels of noise, that of a smaller step is lost in it)."""


def swing(pair: TilePair) -> Severity:
    """Severity of waves of the light within 2 pixels, over the step of the photo within 7, where it is flat.

    Flat is where the photo's own range within 2 pixels is no more than 8 standard deviations of its
    noise and 8 percent of the step, and the step more than 40.
    """
    (y, x), sigma = pair.luma, pair.luma_sigma
    if pair.loops is not None:
        sums, limits = blocks.empty(3, pair.shape), np.array([_NOISE, _FLAT, _STRONG], dtype=np.float32)
        pair.loops.flat_waves(y, x, sigma, (_SMALL // 2, _WIDE // 2), limits, blocks.SIDE, sums)
        return _severity(*blocks.around(sums))
    step = nearby.highest(y, _WIDE) - nearby.lowest(y, _WIDE)
    photo_range = nearby.highest(y, _SMALL) - nearby.lowest(y, _SMALL)
    wave = nearby.highest(x, _SMALL) - nearby.lowest(x, _SMALL)
    flat = (photo_range <= np.float32(_NOISE) * sigma + np.float32(_FLAT) * step) & (
        step > np.float32(_STRONG) * sigma
    )
    part = blocks.windows(flat * np.square(wave))
    whole = blocks.windows(flat * np.square(step))
    return _severity(part, whole, blocks.windows(flat))


def _severity(part: NDArray[np.float32], whole: NDArray[np.float32], count: NDArray[np.float32]) -> Severity:
    trust = np.minimum(count / np.float32(128.0), 1.0)
    share = trust * np.sqrt(part / np.maximum(whole, np.float32(1e-12)))
    return Severity.of_blocks((share / LIMITS["ringing"]).astype(np.float32))
