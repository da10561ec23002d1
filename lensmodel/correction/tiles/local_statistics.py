"""Local statistics of a picture on a coarse grid: signal and noise."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.typing import NDArray

from lensmodel.core.types import Planes
from lensmodel.correction.compiled.tile import block_means
from lensmodel.correction.tiles.canvas import Canvas

BLOCK = 4  # pixels: coarser than detail, finer than objects (chosen)
_UNSURE = np.float32(0.1)
"""Share of the noise that a variance over so few pixels cannot resolve, and that counts as signal (chosen: at
0, places without detail would be smoothed without limit)."""


def smoothed(blocks: NDArray[np.float32]) -> NDArray[np.float32]:
    """Local mean of a coarse plane over about 13 pixels of the fine one."""
    for axis in (0, 1):
        sums = np.float32(4.0) * blocks
        # The same array seen along the other axis: sums are taken in place.
        lines, into = (blocks, sums) if axis == 0 else (blocks.T, sums.T)
        into[1:] += lines[:-1]
        into[:-1] += lines[1:]
        into[0] += lines[0]
        into[-1] += lines[-1]
        blocks = sums
    blocks *= np.float32(1.0 / 36.0)
    return blocks


@dataclass(frozen=True, slots=True, eq=False)
class BlockMeans:
    """Means over blocks of a tile whose colours are scaled to equal light.

    Parameters
    ----------
    planes : ndarray, shape (channels, rows, cols)
        Of each colour.
    luma, square : ndarray, shape (rows, cols)
        Of the mean of the colours, and of its square.
    """

    planes: NDArray[np.float32]
    luma: NDArray[np.float32]
    square: NDArray[np.float32]

    @classmethod
    def of(cls, tile: Planes, light: NDArray[np.float32]) -> BlockMeans:
        """Take the means of a tile whose colours have the mean `light`."""
        shape = tuple(-(-extent // BLOCK) for extent in tile.shape[1:])
        planes = np.empty((len(tile), *shape), dtype=np.float32)
        luma, square = np.empty(shape, dtype=np.float32), np.empty(shape, dtype=np.float32)
        block_means(tile, np.float32(1.0) / light, planes, luma, square)
        return cls(planes, luma, square)


def signal_variance(blocks: BlockMeans, noise: NDArray[np.float32] | float) -> NDArray[np.float32]:
    """Local variance of luma less that of its noise, coarse; never below a tenth of the noise.

    Parameters
    ----------
    blocks : BlockMeans
        Of the tile.
    noise : ndarray or float
        Variance of its noise, coarse.
    """
    mean = smoothed(blocks.luma)
    local = smoothed(blocks.square) - mean * mean
    return np.asarray(np.maximum(local - noise, 0.0) + _UNSURE * noise + np.float32(1e-12), dtype=np.float32)


def spread_blocks(blocks: NDArray[np.float32], canvas: Canvas) -> NDArray[np.float32]:
    """Interpolate a coarse plane linearly onto a canvas, its margin cross-faded like the data's."""
    height, width = canvas.shape
    across = _interpolation(canvas.cols, canvas.margin, width) @ np.ascontiguousarray(blocks.T)
    return np.asarray(
        _interpolation(canvas.rows, canvas.margin, height) @ np.ascontiguousarray(across.T), dtype=np.float32
    )


@lru_cache(maxsize=64)
def _interpolation(extent: int, margin: int, length: int) -> scipy.sparse.csr_array:
    """Matrix that takes blocks of `extent` pixels to a canvas of `length`."""
    starts = np.arange(0, extent, BLOCK)
    middles = (starts + np.minimum(starts + BLOCK, extent) - 1) / 2.0
    t = np.arange(extent)
    fine = np.stack([np.interp(t, middles, row) for row in np.eye(starts.size)], axis=1)
    return scipy.sparse.csr_array(Canvas.wrap(fine.astype(np.float32), margin, length))
