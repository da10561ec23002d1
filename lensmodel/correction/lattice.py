"""The lattice of cells, fixed in the field, that each have one PSF."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import FieldPosition, Frame

_CELLS_PER_HALF_DIAGONAL: Final = 18.0
"""Half the frame's diagonal over the side of a cell (chosen: cells of 200 pixels at 24 megapixels, over which
a PSF hardly changes; more cells are mostly halo)."""
_MIN_PITCH, _MAX_PITCH = 96, 208
"""Bounds of a cell's side in pixels: smaller ones are all halo, larger ones blur the PSF's change."""
_RAMP: Final = 16
"""Width in pixels over which neighbouring cells fade into each other (chosen: narrower, a seam may show
between their PSFs; what is wider is computed twice)."""


_Beside = tuple[FieldPosition, FieldPosition, float]


@dataclass(frozen=True, slots=True)
class Roi:
    """A window of the photo in pixels."""

    top: int
    left: int
    height: int
    width: int

    @classmethod
    def of(cls, frame: Frame, roi: tuple[int, int, int, int] | None) -> Roi:
        """Check a window `(top, left, height, width)` against the frame; None is all of it."""
        if roi is None:
            return cls(0, 0, frame.height, frame.width)
        window = cls(*roi)
        if not (
            0 <= window.top < window.top + window.height <= frame.height
            and 0 <= window.left < window.left + window.width <= frame.width
        ):
            raise InvalidInputError(f"{window} does not lie in a photo of {frame.height} x {frame.width}")
        return window


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One cell: its part of the frame, and its weight there."""

    top: int
    left: int
    rise: NDArray[np.float32]  # weights along the rows; those of all cells sum to one
    run: NDArray[np.float32]  # and along the columns
    position: FieldPosition  # centre of the cell: where its PSF is taken
    middle: tuple[float, float]  # the same as a pixel (row, col)
    # Centres of the cells above and below, and left and right, with the pixels between them; at the border
    # the cell itself stands in for the missing one.
    beside: tuple[_Beside, _Beside]

    @property
    def bottom(self) -> int:
        """Row after the last one."""
        return self.top + len(self.rise)

    @property
    def right(self) -> int:
        """Column after the last one."""
        return self.left + len(self.run)

    def meets(self, roi: Roi) -> bool:
        """Whether the cell has a pixel in `roi`."""
        return (
            self.top < roi.top + roi.height
            and self.bottom > roi.top
            and self.left < roi.left + roi.width
            and self.right > roi.left
        )


def usual_pitch(frame: Frame, factor: int = 1) -> int:
    """Side of a cell in pixels: a fixed share of the field, times `factor`, within practical bounds."""
    share = factor * frame.half_diagonal / _CELLS_PER_HALF_DIAGONAL
    return int(np.clip(share, _MIN_PITCH, factor * _MAX_PITCH))


def cells(frame: Frame, pitch: int | None = None) -> tuple[Cell, ...]:
    """Cut a frame into cells, row by row.

    The lattice depends on the frame only, never on the requested part or on the available memory,
    so a preview shows the same pixels as the whole picture. The `pitch` is the side of a cell in pixels.
    """
    pitch = usual_pitch(frame) if pitch is None else pitch
    down, across = _pieces(frame.height, pitch), _pieces(frame.width, pitch)
    rows, cols = [piece[2] for piece in down], [piece[2] for piece in across]
    cells = []
    for i, (top, rise, row) in enumerate(down):
        above, below = rows[max(i - 1, 0)], rows[min(i + 1, len(rows) - 1)]
        for j, (left, run, col) in enumerate(across):
            before, after = cols[max(j - 1, 0)], cols[min(j + 1, len(cols) - 1)]
            beside = (
                (frame.position(above, col), frame.position(below, col), below - above),
                (frame.position(row, before), frame.position(row, after), after - before),
            )
            cells.append(Cell(top, left, rise, run, frame.position(row, col), (row, col), beside))
    return tuple(cells)


def _pieces(extent: int, pitch: int) -> list[tuple[int, NDArray[np.float32], float]]:
    """First pixel, weights and centre of each piece of an axis."""
    count = max(1, round(extent / pitch))
    edges = [round(i * extent / count) for i in range(count + 1)]
    half = min(_RAMP // 2, (edges[1] - edges[0]) // 2)
    pieces = []
    for low, high in itertools.pairwise(edges):
        start = low if low == 0 else low - half
        stop = high if high == extent else high + half
        t = np.arange(start, stop, dtype=np.float64)
        weight = np.ones(stop - start)
        if low > 0:
            weight = np.minimum(weight, np.clip((t - low + half + 0.5) / (2 * half), 0.0, 1.0))
        if high < extent:
            weight = np.minimum(weight, np.clip((high + half - t - 0.5) / (2 * half), 0.0, 1.0))
        pieces.append((start, weight.astype(np.float32), (low + high - 1) / 2.0))
    return pieces
