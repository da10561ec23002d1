"""Range: no light darker or brighter than the photo allows, no isolated pixel."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.audit import blocks
from lensmodel.audit.base import Evidence, sigma_of
from lensmodel.types import Plane, Planes

_BLACK_SHARE: Final = 0.16
_GONE: Final = 0.05
_SURE: Final = 4.0
_NOISE: Final = 4.0
"""Standard deviations of the photo's noise that a value may move without a reason."""


def black_light(original: Planes, corrected: Planes, evidence: Evidence) -> Plane:
    """Severity of light that was taken away down to nothing, or below, where the photo has some.

    Light is not negative. A correction that takes the lens for worse than it is subtracts more than there
    was, beside every edge; how much of what the correction changed is of this kind::

        s = sqrt( sum (x < 0.05 y) (y - x)² / sum (x - y)² ) / limit
    """
    gone: NDArray[np.float32] = np.zeros(1, dtype=np.float32)
    lost = gone
    for x, y, noise in zip(corrected, original, evidence.noise, strict=True):
        sigma = sigma_of(noise, y)
        change = np.square(x - y)
        black = (x < _GONE * y) & (y > _SURE * sigma)
        gone = gone + blocks.around(blocks.sums(np.where(black, change, np.float32(0.0))))
        lost = lost + blocks.around(blocks.sums(change + np.square(sigma)))
    share = np.sqrt(gone / np.maximum(lost, np.float32(1e-12)))
    return blocks.to_pixels((share / _BLACK_SHARE).astype(np.float32), (original.shape[1], original.shape[2]))


def isolated(original: Planes, corrected: Planes, evidence: Evidence) -> Plane:
    """Severity of single pixels that stand out of their neighbours and not in the photo.

    A pixel may stand out of its 8 neighbours by some times what it stands out of the ring around in the
    photo, and by the noise.
    """
    worst = np.zeros(original.shape[1:], dtype=np.float32)
    for x, y, noise in zip(corrected, original, evidence.noise, strict=True):
        high = ndimage.maximum_filter(x, footprint=_AROUND)
        low = ndimage.minimum_filter(x, footprint=_AROUND)
        spike = np.maximum(x - high, low - x)
        bump = np.abs(y - ndimage.uniform_filter(y, 5))
        allowed = np.float32(_GAIN) * bump + np.float32(_NOISE) * sigma_of(noise, y)
        np.maximum(worst, spike / allowed, out=worst)
    return worst


_GAIN: Final = 6.0
_AROUND: Final = np.array([[1, 1, 1], [1, 0, 1], [1, 1, 1]], dtype=bool)
