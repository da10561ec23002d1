"""Sums over blocks of 8 pixels, and the interpolation of block figures back to pixels.

All are linear along rows and along columns, so each is two products with small matrices that depend on the
size of the tile only: a few percent of the time of strided sums.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Plane

Real = NDArray[np.float32]

SIDE: Final = 8
"""Side of a block in pixels: that of a JPEG block (ITU-T T.81), and small beside what an eye takes for one
place."""
_WEIGHTS: Final = (1.0, 2.0, 3.0, 4.0, 5.0, 4.0, 3.0, 2.0, 1.0)
"""Weights of the blocks around one, along rows and columns: a window of 9 blocks that fades out (chosen).
A wrong kernel is wrong all around; patches of different sharpness would show, and fewer pixels say less."""


def sums(values: NDArray[np.floating] | NDArray[np.bool_]) -> Real:
    """Sum over each block; those on the lower and right rim may not be whole.

    Parameters
    ----------
    values : ndarray, shape (..., rows, cols)
        One value per pixel.

    Returns
    -------
    ndarray of float32, shape (..., ceil(rows / 8), ceil(cols / 8))
    """
    rows, cols = values.shape[-2:]
    return np.asarray(_members(rows) @ values.astype(np.float32, copy=False) @ _members(cols).T)


def around(totals: Real) -> Real:
    """Weighted sum over the 9 x 9 blocks around each; zeros outside, so that ratios stay right."""
    rows, cols = totals.shape[-2:]
    return np.asarray(_near(rows) @ totals @ _near(cols))


def windows(values: NDArray[np.floating] | NDArray[np.bool_]) -> Real:
    """`around` of `sums`, at once."""
    rows, cols = values.shape[-2:]
    return np.asarray(_window(rows) @ values.astype(np.float32, copy=False) @ _window(cols).T)


@lru_cache(maxsize=64)
def sizes(shape: tuple[int, int]) -> Real:
    """Pixels of each block of a tile."""
    return _fixed(np.outer(*(_members(extent).sum(axis=1) for extent in shape)))


def empty(figures: int, shape: tuple[int, ...]) -> Real:
    """Room for figures of every block of a tile, `(figures, ceil(rows / 8), ceil(cols / 8))`."""
    return np.empty((figures, *(-(-extent // SIDE) for extent in shape)), dtype=np.float32)


def to_pixels(figures: Real, shape: tuple[int, int], *, first: float, step: int) -> Plane:
    """Bilinear interpolation of figures that stand `step` pixels apart, the first of them at `first`.

    Beyond the outer ones it is constant.
    """
    down, across = (
        _between(extent, count, first, step) for extent, count in zip(shape, figures.shape, strict=True)
    )
    return np.asarray(down @ figures @ across.T, dtype=np.float32)


@lru_cache(maxsize=64)
def _members(extent: int) -> Real:
    """Which pixels belong to which block, `(blocks, pixels)`."""
    return _fixed(np.arange(extent)[None, :] // SIDE == np.arange(-(-extent // SIDE))[:, None])


@lru_cache(maxsize=64)
def _near(count: int) -> Real:
    """Weight of each block for each block, `(blocks, blocks)`."""
    far = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))
    middle = len(_WEIGHTS) // 2
    return _fixed(np.where(far <= middle, np.asarray(_WEIGHTS)[middle - np.minimum(far, middle)], 0.0))


@lru_cache(maxsize=64)
def _window(extent: int) -> Real:
    members = _members(extent)
    return _fixed(_near(len(members)) @ members)


@lru_cache(maxsize=64)
def _between(extent: int, count: int, first: float, step: int) -> Real:
    """Weight of each figure for each pixel, `(pixels, figures)`."""
    at = np.clip((np.arange(extent) - first) / step, 0.0, count - 1)
    return _fixed(np.maximum(1.0 - np.abs(at[:, None] - np.arange(count)[None, :]), 0.0))


def _fixed(matrix: NDArray[np.generic]) -> Real:
    fixed = np.ascontiguousarray(matrix, dtype=np.float32)
    fixed.setflags(write=False)
    return fixed
