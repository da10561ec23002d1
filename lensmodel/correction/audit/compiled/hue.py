"""Colours beyond those of the neighbourhood, compiled; see `lensmodel.correction.audit.hue`."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.audit.compiled.nearby import extremes, into_blocks
from lensmodel.correction.compiled.common import Real


@jit
def _mean_of_three(plane: Real, out: Real) -> None:
    """Mean over 3 x 3 pixels; rims repeat."""
    rows, cols = plane.shape
    column, share = np.empty(cols + 2, np.float32), np.float32(1.0 / 9.0)
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(cols):
            column[j + 1] = plane[above, j] + plane[i, j] + plane[below, j]
        column[0], column[cols + 1] = column[1], column[cols]
        for j in range(cols):
            out[i, j] = share * (column[j] + column[j + 1] + column[j + 2])


@jit
def colours(
    y: Real, x: Real, sigma: Real, white: Real, limits: Real, reach: int, side: int, out: Real, worst: Real
) -> None:
    """Colours of a result beyond their range in the photo nearby.

    Parameters
    ----------
    y, x, sigma : ndarray of float32, shape (3, rows, cols)
        Photo, result, noise.
    white : ndarray of float32, shape (rows, cols)
        1 beside saturated light, else 0.
    limits : ndarray of float32, shape (6,)
        What is free and the share of the range, usually and beside white; noise, floor of the light.
    reach : int
        Pixels on each side that are nearby.
    side : int
        Side of a block.
    out : ndarray of float32, shape (4, down, across)
        Sums over blocks of the square of what is beyond, and of the square of the range: for each colour.
    worst : ndarray of float32, shape (rows, cols)
        What is beyond over what is allowed.
    """
    zero, third = np.float32(0.0), np.float32(1.0 / 3.0)
    rows, cols = worst.shape
    free, share, free_white, share_white, noise, floor = limits
    calm, before = np.empty((3, rows, cols), np.float32), np.empty((2, rows, cols), np.float32)
    low, high = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    strip, other = np.empty((2, cols), np.float32), np.empty(cols, np.float32)
    for c in range(3):
        _mean_of_three(y[c], calm[c])
    for i in range(rows):
        for j in range(cols):
            r, g, b = calm[0, i, j], calm[1, i, j], calm[2, i, j]
            grain = third * (sigma[0, i, j] + sigma[1, i, j] + sigma[2, i, j])
            inverse = np.float32(1.0) / (max(r, zero) + max(g, zero) + max(b, zero) + floor * grain)
            before[0, i, j] = (r - g) * inverse
            before[1, i, j] = (b - g) * inverse
    out[:] = zero
    worst[:] = zero
    for k in range(2):
        extremes(before[k], reach, low, high)
        for block in range(out.shape[1]):
            strip[:] = zero
            for i in range(block * side, min(block * side + side, rows)):
                other[:] = worst[i]
                for j in range(cols):
                    r, g, b = x[0, i, j], x[1, i, j], x[2, i, j]
                    grain = third * (sigma[0, i, j] + sigma[1, i, j] + sigma[2, i, j])
                    inverse = np.float32(1.0) / (max(r, zero) + max(g, zero) + max(b, zero) + floor * grain)
                    colour = (x[2 * k, i, j] - g) * inverse
                    beyond = max(colour - high[i, j], low[i, j] - colour) - noise * grain * inverse
                    beyond = max(beyond, zero)
                    span = high[i, j] - low[i, j]
                    w = white[i, j]
                    allowed = free + w * (free_white - free) + (share + w * (share_white - share)) * span
                    worst[i, j] = max(other[j], beyond / allowed)
                    strip[0, j] += beyond * beyond
                    strip[1, j] += span * span
            into_blocks(strip, side, out[2 * k : 2 * k + 2, block])
