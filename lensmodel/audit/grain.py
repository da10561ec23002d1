"""Grain: noise power in flat places, fine and coarse."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import blocks, near
from lensmodel.audit.base import Pair, Severity
from lensmodel.audit.limits import LIMITS
from lensmodel.types import Plane

_CALM: Final = 1.5
"""Standard deviation of a block over the noise's up to which it is flat: as `deconv.limits`."""
_SCALES: Final = (1, 2)
"""Distances of the second differences: grain of a period of 2 pixels and of 4."""


def amplified(pair: Pair) -> Severity:
    """Severity of more grain in flat places than the photo has there: root of the ratio of powers.

    Less is no fault of this kind: what a correction's own settings keep of it is up to the photographer.
    """
    (y, x), count = pair.luma, np.float32(blocks.SIDE**2)
    noise = blocks.sums(np.square(pair.luma_sigma))
    own = blocks.sums(np.square(y)) - np.square(blocks.sums(y)) / count
    flat = (own < np.float32(_CALM**2) * noise).astype(np.float32)
    worst: NDArray[np.float32] = np.zeros(noise.shape, dtype=np.float32)
    # what rounding left without noise counts as if it had the noise that was stated
    least = np.maximum(blocks.around(flat * noise), np.float32(1e-12))
    for scale in _SCALES:
        was, now = (blocks.around(flat * blocks.sums(_detail(plane, scale))) for plane in (y, x))
        worst = np.maximum(worst, now / (was + least))
    return Severity.of_blocks((np.sqrt(worst) / LIMITS["grain"]).astype(np.float32))


def _detail(plane: Plane, scale: int) -> NDArray[np.float32]:
    """Power of the difference of second differences at a distance: blind to planes and edges along the axes.

    Its gain for white noise is 1. J. Immerkaer, "Fast noise variance estimation", CVIU 64, 1996, eq. 2.
    """
    wide, two = near.padded(plane, scale), np.float32(2.0)
    rows = wide[: -2 * scale] - two * wide[scale:-scale] + wide[2 * scale :]
    both = rows[:, : -2 * scale] - two * rows[:, scale:-scale] + rows[:, 2 * scale :]
    return np.asarray(np.square(both) / np.float32(36.0), dtype=np.float32)
