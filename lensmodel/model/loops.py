"""The inner loops of the regression, compiled; imported where they are needed: Numba takes long to load."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit

# Of the cubic B-spline (M. Unser, IEEE Signal Processing Magazine 16, 1999, eq. 4), in single precision.
_ONE, _HALF = np.float32(1.0), np.float32(0.5)
_SIXTH, _TWO_THIRDS = np.float32(1.0 / 6.0), np.float32(2.0 / 3.0)


@jit
def _inside(a: float, b: float, c: float, size: int) -> tuple[int, int]:
    """Integers j in 0..size with a j^2 + 2 b j + c <= 0, as first and last + 1."""
    root = b * b - a * c
    if root < 0.0:
        return 0, 0
    root = math.sqrt(root)
    first, last = math.ceil((-b - root) / a), math.floor((-b + root) / a)
    return max(first, 0), min(last + 1, size)


@jit
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Weights of the four coefficients round a point that lies `t` beyond the second."""
    rest = _ONE - t
    first, last = rest * rest * rest * _SIXTH, t * t * t * _SIXTH
    second = _TWO_THIRDS - t * t * (_ONE - _HALF * t)
    return first, second, _ONE - first - second - last, last


@jit
def _value(spline: NDArray[np.float32], side: int, y: float, x: float) -> np.float32:
    """Value of a spline at (y, x); 0 where not all of its coefficients lie on the grid."""
    if not (1.0 <= y < side - 2 and 1.0 <= x < side - 2):
        return np.float32(0.0)
    row, col = int(y), int(x)
    v0, v1, v2, v3 = _weights(np.float32(y - row))
    h0, h1, h2, h3 = _weights(np.float32(x - col))
    p = (row - 1) * side + col - 1
    q, r, o = p + side, p + 2 * side, p + 3 * side
    return (
        v0 * (h0 * spline[p] + h1 * spline[p + 1] + h2 * spline[p + 2] + h3 * spline[p + 3])
        + v1 * (h0 * spline[q] + h1 * spline[q + 1] + h2 * spline[q + 2] + h3 * spline[q + 3])
        + v2 * (h0 * spline[r] + h1 * spline[r + 1] + h2 * spline[r + 2] + h3 * spline[r + 3])
        + v3 * (h0 * spline[o] + h1 * spline[o + 1] + h2 * spline[o + 2] + h3 * spline[o + 3])
    )


@jit
def sums(
    rows: NDArray[np.float32],
    radii: NDArray[np.float64],
    chosen: NDArray[np.intp],
    weights: NDArray[np.float64],
    maps: NDArray[np.float64],
    starts: NDArray[np.intp],
    shifts: NDArray[np.float64],
    out: NDArray[np.float64],
) -> None:
    """Add weighted sums of splines, read through affine maps, to `out` (answers, size, size).

    `chosen` (m,) are the samples that are read, one answer after the other from `starts` on, with their
    `weights`, which include the determinants of the `maps` (m, 2, 2), from (row, col) offsets of the answer
    in pixels to those of the sample in steps of its grid; each answer is moved by its `shifts` in pixels.
    """
    side, size = round(math.sqrt(rows.shape[1])), out.shape[1]
    half, middle = side // 2, size // 2
    for answer in range(out.shape[0]):
        left = -middle - shifts[answer, 1]
        for k in range(starts[answer], starts[answer + 1]):
            row, weight = chosen[k], weights[k]
            spline, reach = rows[row], radii[row]
            dy, dx = maps[k, 0, 1], maps[k, 1, 1]
            for i in range(size):
                down = i - middle - shifts[answer, 0]
                y = maps[k, 0, 0] * down + dy * left
                x = maps[k, 1, 0] * down + dx * left
                first, last = _inside(dy * dy + dx * dx, y * dy + x * dx, y * y + x * x - reach * reach, size)
                y, x = y + half, x + half
                for j in range(first, last):
                    out[answer, i, j] += weight * _value(spline, side, y + j * dy, x + j * dx)
