"""Sums over blocks of 8 pixels, and the way from a block's figure back to smooth pixels."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.types import Plane

SIDE: Final = 8
"""Side of a block in pixels: the period of JPEG, and small beside what an eye takes for one place."""
_WEIGHTS: Final = np.array([1.0, 2.0, 3.0, 2.0, 1.0], dtype=np.float32)
"""Weights of the blocks around one, along rows and columns: a window of 5 blocks that fades out."""


def sums(values: NDArray[np.floating] | NDArray[np.bool_]) -> NDArray[np.float32]:
    """Sum over each block; those on the lower and right rim that are not whole are padded with zeros.

    Parameters
    ----------
    values : ndarray, shape (..., rows, cols)
        One value per pixel.

    Returns
    -------
    ndarray of float32, shape (..., ceil(rows / 8), ceil(cols / 8))
    """
    *lead, rows, cols = values.shape
    down, across = -(-rows // SIDE), -(-cols // SIDE)
    if (rows, cols) != (down * SIDE, across * SIDE):
        pads = [(0, 0)] * len(lead) + [(0, down * SIDE - rows), (0, across * SIDE - cols)]
        values = np.pad(values, pads)
    cut = values.reshape(*lead, down, SIDE, across, SIDE)
    return np.asarray(cut.sum(axis=-1).sum(axis=-2), dtype=np.float32)


def around(totals: NDArray[np.float32]) -> NDArray[np.float32]:
    """Weighted sum over the 5 x 5 blocks around each; outside there is nothing, so that ratios stay right."""
    for axis in (-2, -1):
        totals = ndimage.correlate1d(totals, _WEIGHTS, axis=axis, mode="constant")
    return totals


def to_pixels(figures: NDArray[np.float32], shape: tuple[int, int]) -> Plane:
    """Bilinear interpolation of one figure per block to the pixels; constant beyond the outer blocks."""
    return spread(figures, shape, first=(SIDE - 1) / 2.0, step=SIDE)


def spread(figures: NDArray[np.float32], shape: tuple[int, int], *, first: float, step: int) -> Plane:
    """Bilinear interpolation of figures that stand `step` pixels apart, the first of them at `first`."""
    along = []
    for extent, count in zip(shape, figures.shape, strict=True):
        at = np.clip((np.arange(extent, dtype=np.float32) - np.float32(first)) / step, 0.0, count - 1)
        low = np.minimum(at.astype(np.intp), max(count - 2, 0))
        along.append((low, np.minimum(low + 1, count - 1), (at - low).astype(np.float32)))
    (top, below, down), (left, beside, right) = along
    rows = figures[top] + down[:, None] * (figures[below] - figures[top])
    return np.asarray(rows[:, left] + right * (rows[:, beside] - rows[:, left]), dtype=np.float32)
