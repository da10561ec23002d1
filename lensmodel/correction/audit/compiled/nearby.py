"""What the compiled loops share: least and largest values around each pixel, sums over blocks."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import Real


@jit
def _row_extremes(plane: Real, i: int, reach: int, low: Real, high: Real, spare: Real) -> None:
    """Extremes over the rows around row i, into the middle of buffers that are `reach` wider at both ends.

    From one buffer into another, two rows at a time: a minimum written where it was read becomes a masked
    store, which takes five times as long.
    """
    rows, cols = plane.shape
    first, last = max(i - reach, 0), min(i + reach, rows - 1)
    # views, since indices that may be negative keep loops from being vectorized
    least, most = low[reach : reach + cols], high[reach : reach + cols]
    spare[0, :cols] = plane[first]
    spare[1, :cols] = plane[first]
    now = 0
    for k in range(first + 1, last + 1, 2):
        row, next_row = plane[k], plane[min(k + 1, last)]
        _joined(spare[now], spare[now + 1], row, next_row, spare[2 - now], spare[3 - now])
        now = 2 - now
    least[:] = spare[now, :cols]
    most[:] = spare[now + 1, :cols]
    low[:reach] = least[0]
    high[:reach] = most[0]
    low[reach + cols :] = least[cols - 1]
    high[reach + cols :] = most[cols - 1]


@jit
def _joined(low: Real, high: Real, row: Real, next_row: Real, lower: Real, higher: Real) -> None:
    """Extremes of those so far and of two more rows."""
    for j in range(row.size):
        lower[j] = min(low[j], row[j], next_row[j])
    for j in range(row.size):
        higher[j] = max(high[j], row[j], next_row[j])


@jit
def _doubled(low: Real, high: Real, step: int, count: int, lower: Real, higher: Real) -> None:
    """Extremes of windows and of those `step` pixels further on."""
    low_ahead, high_ahead = low[step:], high[step:]
    for j in range(count):
        lower[j] = min(low[j], low_ahead[j])
    for j in range(count):
        higher[j] = max(high[j], high_ahead[j])


@jit
def extremes(plane: Real, reach: int, lowest: Real, highest: Real) -> None:
    """Least and largest value in the square of side 2 reach + 1 around each pixel; rims repeat.

    Along a row windows double: four comparisons for nine pixels.
    """
    rows, cols = plane.shape
    wide, side = cols + 2 * reach, 2 * reach + 1
    line, spare = np.empty((4, wide), np.float32), np.empty((4, cols), np.float32)
    for i in range(rows):
        _row_extremes(plane, i, reach, line[0], line[1], spare)
        width, now = 1, 0
        count = wide
        while width < side:
            step = min(width, side - width)
            count -= step
            then = 2 - now
            _doubled(line[now], line[now + 1], step, count, line[then], line[then + 1])
            width += step
            now = then
        lowest[i] = line[now, :cols]
        highest[i] = line[now + 1, :cols]


@jit
def into_blocks(strip: Real, side: int, out: Real) -> None:
    """Add sums over `side` columns of each line of a strip to `out`, `(lines, blocks)`."""
    cols = strip.shape[1]
    for line in range(strip.shape[0]):
        for block in range(out.shape[1]):
            total = np.float32(0.0)
            for j in range(block * side, min(block * side + side, cols)):
                total += strip[line, j]
            out[line, block] += total
