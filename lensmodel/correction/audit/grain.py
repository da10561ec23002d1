"""Grain: noise power in flat places, fine and coarse."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Plane
from lensmodel.correction.audit import blocks, nearby
from lensmodel.correction.audit.check import Severity, TilePair
from lensmodel.correction.audit.tolerances import LIMITS

_CALM: Final = 1.5
"""Standard deviation of a block over that of the noise, up to which it is flat (chosen: with less, noise by
chance leaves no flat block; with more, faint texture that a correction may sharpen counts as grain)."""
_SCALES: Final = (1, 2)
"""Distances of the second differences in pixels: grain of a period of 2 pixels and of 4."""


def amplified(pair: TilePair) -> Severity:
    """Severity of more grain in flat places than the photo has there: root of the ratio of powers.

    Less grain is no fault of this kind: how much to keep is a setting of the photographer's.
    """
    noise, light, square, *detail = _sums(pair)
    energy = square - np.square(light) / np.float32(blocks.SIDE**2)
    flat = (energy < np.float32(_CALM**2) * noise).astype(np.float32)
    worst: NDArray[np.float32] = np.zeros(noise.shape, dtype=np.float32)
    # places that rounding left without noise count as if they had the stated noise
    least = np.maximum(blocks.around(flat * noise), np.float32(1e-12))
    for scale in range(len(_SCALES)):
        was, now = (blocks.around(flat * sums) for sums in detail[2 * scale : 2 * scale + 2])
        worst = np.maximum(worst, now / (was + least))
    return Severity.of_blocks((np.sqrt(worst) / LIMITS["grain"]).astype(np.float32))


def _sums(pair: TilePair) -> list[NDArray[np.float32]]:
    """Sums over blocks: noise, light and its square, and the detail of photo and result at each scale."""
    sigma, (y, x) = pair.luma_sigma, pair.luma
    if pair.loops is not None:
        sums = blocks.empty(3 + 2 * len(_SCALES), pair.shape)
        pair.loops.flat_grain(pair.luma, sigma, _SCALES, blocks.SIDE, sums)
        return list(sums)
    detail = [blocks.sums(_detail(plane, scale)) for scale in _SCALES for plane in (y, x)]
    return [blocks.sums(np.square(sigma)), blocks.sums(y), blocks.sums(np.square(y)), *detail]


def _detail(plane: Plane, scale: int) -> NDArray[np.float32]:
    """Power of the difference of second differences at a distance: blind to planes and edges along the axes.

    Its gain for white noise is 1. J. Immerkaer, "Fast noise variance estimation", CVIU 64, 1996, eq. 2.
    """
    wide, two = nearby.padded(plane, scale), np.float32(2.0)
    rows = wide[: -2 * scale] - two * wide[scale:-scale] + wide[2 * scale :]
    both = rows[:, : -2 * scale] - two * rows[:, scale:-scale] + rows[:, 2 * scale :]
    return np.asarray(np.square(both) / np.float32(36.0), dtype=np.float32)
