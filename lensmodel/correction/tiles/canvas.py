"""The periodic canvas on which Fourier methods see a tile."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor

_JOINT: Final = 4
"""Pixels over which the ends of a tile fade into each other where its rim is cut off (chosen: with none, the
step between the ends rings inwards; more is computed for nothing)."""


@dataclass(frozen=True, slots=True)
class Canvas:
    """A periodic grid that holds the data and a margin on which nothing was measured.

    Parameters
    ----------
    rows, cols : int
        Size of the data.
    margin : int
        Unmeasured pixels before the data; after them there are at least as many.
    """

    rows: int
    cols: int
    margin: int

    @classmethod
    def around(cls, tile: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]) -> Canvas:
        """Canvas for a tile `(channel, row, col)`.

        The margin is at least the kernel's side wide in total, so that light which wraps around
        never meets data from the other end. Where the tile's rim will be cut off, it need only join
        the ends without a step.
        """
        wide = max(blur.reach for blur in blurs)
        margin = min(_JOINT, wide) if all(sensor.surrounded for sensor in sensors) else wide
        return cls(tile.shape[1], tile.shape[2], margin)

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the grid, quick to transform."""
        return (
            int(fft.next_fast_len(self.rows + 2 * self.margin, real=True)),
            int(fft.next_fast_len(self.cols + 2 * self.margin, real=True)),
        )

    @property
    def data(self) -> tuple[slice, slice]:
        """Where the data lie on the grid."""
        return slice(self.margin, self.margin + self.rows), slice(self.margin, self.margin + self.cols)

    def fill(self, plane: NDArray[np.float32]) -> NDArray[np.float32]:
        """Place the data and cross-fade the margin from one end to the other, no step anywhere."""
        height, width = self.shape
        wide = self.wrap(plane, self.margin, height)
        return np.ascontiguousarray(self.wrap(wide.T, self.margin, width).T)

    def cut(self, canvas: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the part of a canvas that holds data."""
        rows, cols = self.data
        return canvas[rows, cols]

    @staticmethod
    def wrap(plane: NDArray[np.float32], margin: int, length: int) -> NDArray[np.float32]:
        """Extend the rows of `plane` to `length`; the margin mirrors both ends, faded into each other."""
        rows = plane.shape[0]
        first, second, fade = seam(rows, length)
        bridge = plane[first] * (1 - fade)[:, None] + plane[second] * fade[:, None]
        return np.roll(np.concatenate([plane, bridge.astype(np.float32)]), margin, axis=0)


@lru_cache(maxsize=64)
def seam(rows: int, length: int) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.float32]]:
    """Rows to fade from and to beyond `rows`, up to `length`, and the share of the latter."""
    t = np.arange(length - rows)
    fade = ((t + 0.5) / max(length - rows, 1)).astype(np.float32)
    return np.maximum(rows - 1 - t, 0), np.minimum(length - rows - 1 - t, rows - 1), fade


def fitted_halo(cell: tuple[int, int], least: int) -> int:
    """Widest halo of a cell for which its canvas is no larger than for the least one.

    Sizes that are quick to transform are few: the pixels that a canvas has to spare are better filled with
    data than with a longer seam.
    """
    spare = []
    for extent in cell:
        needed = extent + 2 * (least + _JOINT)
        spare.append(int(fft.next_fast_len(needed, real=True)) - needed)
    return least + min(spare) // 2
