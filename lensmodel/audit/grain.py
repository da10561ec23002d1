"""Grain: noise power in flat places, fine and coarse."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import blocks
from lensmodel.audit.base import Pair
from lensmodel.types import Plane, Planes

RATIO: Final = 3.0
_CALM: Final = 1.5


def amplified(pair: Pair) -> Plane:
    """Severity of more grain in flat places than the photo has there: root of the ratio of powers."""
    noise = blocks.sums(np.square(pair.sigma))
    count = np.float32(blocks.SIDE**2)
    own = blocks.sums(np.square(pair.original)) - np.square(blocks.sums(pair.original)) / count
    flat = own < np.float32(_CALM**2) * noise
    worst: NDArray[np.float32] = np.zeros(noise.shape, dtype=np.float32)
    for scale in (1, 2):
        was, now = (
            blocks.around(np.where(flat, blocks.sums(detail(planes, scale)), np.float32(0.0)))
            for planes in (pair.original, pair.corrected)
        )
        # so that what rounding left without noise counts as if it had the noise that was stated
        least = blocks.around(np.where(flat, noise, np.float32(0.0)))
        worst = np.maximum(worst, now / np.maximum(was + least, np.float32(1e-12)))
    return blocks.to_pixels(np.sqrt(worst.max(axis=0)) / np.float32(RATIO), pair.shape)


def detail(planes: Planes, scale: int) -> NDArray[np.float32]:
    """Power of the difference of second differences at a distance: blind to planes and edges along the axes.

    Its gain for white noise is 1. J. Immerkaer, "Fast noise variance estimation", CVIU 64, 1996, eq. 2.
    """
    wide = np.pad(planes, ((0, 0), (scale, scale), (scale, scale)), mode="edge")
    rows = wide[:, : -2 * scale] - np.float32(2.0) * wide[:, scale:-scale] + wide[:, 2 * scale :]
    both = rows[..., : -2 * scale] - np.float32(2.0) * rows[..., scale:-scale] + rows[..., 2 * scale :]
    return np.asarray(np.square(both) / np.float32(36.0), dtype=np.float32)
