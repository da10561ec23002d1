"""Light beyond its neighbourhood, and single pixels, compiled; see `lensmodel.correction.audit.light`."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.audit.compiled.nearby import extremes, into_blocks
from lensmodel.correction.compiled.common import Real


@jit
def light(
    y: Real,
    x: Real,
    sigma: Real,
    reach: int,
    sure: tuple[float, float],
    weights: tuple[float, float],
    side: int,
    out: Real,
) -> None:
    """Sums over blocks of `side` pixels of what is too dark, too bright, and changed: three planes.

    `sure` and `weights` are for light beyond the photo's and for light below zero.
    """
    zero = np.float32(0.0)
    rows, cols = y.shape[1:]
    free, free_below = np.float32(sure[0]), np.float32(sure[1])
    possible, impossible = np.float32(weights[0]), np.float32(weights[1])
    low, high = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    strip = np.empty((3, cols), np.float32)
    out[:] = zero
    for c in range(3):
        extremes(y[c], reach, low, high)
        for block in range(out.shape[1]):
            strip[:] = zero
            for i in range(block * side, min(block * side + side, rows)):
                for j in range(cols):
                    noise, result = sigma[c, i, j], x[c, i, j]
                    below = max(low[i, j] - result - free * noise, zero)
                    nothing = max(-result - free_below * noise, zero)
                    beyond = max(result - high[i, j] - free * noise, zero)
                    change = result - y[c, i, j]
                    strip[0, j] += possible * below * below + impossible * nothing * nothing
                    strip[1, j] += beyond * beyond
                    strip[2, j] += change * change + noise * noise
            into_blocks(strip, side, out[:, block])


@jit
def isolated(y: Real, x: Real, sigma: Real, gains: Real, free: float, worst: Real) -> None:
    """How far each pixel stands out of its neighbours, over what it may: the largest of the colours."""
    channels, rows, cols = y.shape
    share, spared = np.float32(1.0 / 25.0), np.float32(free)
    column = np.empty(cols + 4, np.float32)
    low, high = np.empty(cols + 2, np.float32), np.empty(cols + 2, np.float32)
    least, most = np.empty(cols, np.float32), np.empty(cols, np.float32)
    before = np.empty(cols, np.float32)  # a copy to read from, or writing `worst` becomes a masked store
    worst[:] = np.float32(-np.inf)
    for c in range(channels):
        gain = gains[c]
        for i in range(rows):
            above, below = max(i - 1, 0), min(i + 1, rows - 1)
            for j in range(cols):
                a, b, m = x[c, above, j], x[c, below, j], x[c, i, j]
                least[j] = min(a, b)
                most[j] = max(a, b)
                low[j + 1] = min(least[j], m)
                high[j + 1] = max(most[j], m)
            low[0], low[cols + 1] = low[1], low[cols]
            high[0], high[cols + 1] = high[1], high[cols]
            for j in range(cols):
                column[j + 2] = y[c, i, j]
            for k in (-2, -1, 1, 2):
                near = min(max(i + k, 0), rows - 1)
                for j in range(cols):
                    column[j + 2] += y[c, near, j]
            before[:] = worst[i]
            column[0] = column[1] = column[2]
            column[cols + 2] = column[cols + 3] = column[cols + 1]
            for j in range(cols):
                mean = share * (column[j] + column[j + 1] + column[j + 2] + column[j + 3] + column[j + 4])
                result = x[c, i, j]
                floor = min(least[j], low[j], low[j + 2])
                top = max(most[j], high[j], high[j + 2])
                spike = max(result - top, floor - result)
                spike /= gain * abs(y[c, i, j] - mean) + spared * sigma[c, i, j]
                worst[i, j] = max(before[j], spike)
