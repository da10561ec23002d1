"""Products of all shifted windows of an image, without writing the windows out.

The normal equations of a kernel step are sums over pixels p of x(p + a) x(p + b), for all offsets a and b
in the kernel's square. Sums that differ by a shift of both offsets share all rows but a few at their ends, so
that the work grows with the third power of the side and not with the fourth.
"""

from __future__ import annotations

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray


def window_products(
    x: NDArray[np.float64], y: NDArray[np.float64], side: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of products of windows of x with one another and with y, means taken off.

    Parameters
    ----------
    x : ndarray, shape (n + side - 1, m + side - 1)
        About zero mean: sums are of single precision.
    y : ndarray, shape (n, m)
    side : int

    Returns
    -------
    gram : ndarray, shape (side², side²)
        sum_p (x(p + a) - mean)(x(p + b) - mean), offsets a and b in reading order.
    cross : ndarray, shape (side²,)
        sum_p (x(p + a) - mean)(y(p) - mean).
    """
    n, m = y.shape
    values = x.astype(np.float32)
    windows = np.ascontiguousarray(sliding_window_view(values, side, axis=1))  # (n + side - 1, m, side)
    gram = np.empty((side, side, side, side))
    for lag in range(side):
        for row, products in enumerate(_of_rows(windows, lag, n)):
            gram[row, :, row + lag, :] = products
            gram[row + lag, :, row, :] = products.T
    target = (y - y.mean()).astype(np.float32).ravel()
    cross = np.stack([target @ windows[row : row + n].reshape(-1, side) for row in range(side)])
    by_column = np.add.accumulate(windows.sum(axis=1, dtype=np.float64), axis=0)
    means = by_column[n - 1 :].copy()
    means[1:] -= by_column[: side - 1]
    flat = means.ravel() / (n * m)
    return gram.reshape(side * side, -1) - n * m * np.outer(flat, flat), cross.astype(np.float64).ravel()


def _of_rows(windows: NDArray[np.float32], lag: int, n: int) -> NDArray[np.float64]:
    """Sums over the n rows from t on of windows[t]' windows[t + lag], shape (side - lag, side, side)."""
    side = windows.shape[2]
    starts = side - lag
    if n < starts:  # no row that all sums share
        all_rows = np.matmul(
            windows[: n + starts - 1].transpose(0, 2, 1), windows[lag : n + starts - 1 + lag]
        )
        up_to = np.add.accumulate(np.pad(all_rows.astype(np.float64), ((1, 0), (0, 0), (0, 0))), axis=0)
        return np.asarray(up_to[n:] - up_to[:-n])
    inner = windows[starts - 1 : n].reshape(-1, side)
    shared = inner.T @ windows[starts - 1 + lag : n + lag].reshape(-1, side)
    tops = np.matmul(windows[: starts - 1].transpose(0, 2, 1), windows[lag : starts - 1 + lag])
    ends = np.matmul(windows[n : n + starts - 1].transpose(0, 2, 1), windows[n + lag : n + lag + starts - 1])
    sums = np.empty((starts, side, side))
    sums[:] = shared
    # From the first row of a sum on, down to the rows that all sums share; and beyond those.
    sums[:-1] += np.add.accumulate(tops[::-1].astype(np.float64), axis=0)[::-1]
    sums[1:] += np.add.accumulate(ends.astype(np.float64), axis=0)
    return sums
