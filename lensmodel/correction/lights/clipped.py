"""Regions of a tile in which the light of clipped pixels can be estimated, cut so that they cost little."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_BLOCK: Final = 8
"""Side in pixels of the blocks that make up regions (chosen: finer ones cost time to join, coarser ones
pixels that no light reaches)."""

_FIXED: Final = 5000
"""Fixed cost of a region, in pixels: calls on small arrays, tables of its own size (chosen: a
square of 70; less would cut lights into many small regions, more would join far ones)."""

Window = tuple[slice, slice]
_Span = tuple[int, int]


@dataclass(frozen=True, slots=True)
class ClippedRegion:
    """A part of a tile whose lights are estimated together.

    Parameters
    ----------
    data : tuple of slice
        The data to use, in pixels of the tile.
    own : tuple of slice
        The light that only this region estimates, in pixels of the latent plane, wider than `data` by
        the reach of the blur on each side.
    answers : tuple of slice
        The clipped pixels that it estimates, in pixels of `data`.
    """

    data: Window
    own: Window
    answers: Window


def regions(clipped: NDArray[np.bool_], reach: int) -> list[ClippedRegion]:
    """Cut clipped pixels into regions.

    Light shows on measured pixels only: clipped pixels further inside a blown area than twice the blur's
    reach are left as they are. The rest is cut along gaps, or in the middle, as long as the pieces
    with twice the reach around them are cheaper than the whole.

    Parameters
    ----------
    clipped : ndarray of bool, shape (rows, cols)
        Pixels of which only a lower bound is known.
    reach : int
        Reach of the blur in pixels.
    """
    if not clipped.any():
        return []
    unclipped = _blocks(~clipped)
    if not unclipped.any():
        return []
    near = 2 * (-(-2 * reach // _BLOCK)) + 1
    active = _blocks(clipped) & ndimage.binary_dilation(unclipped, np.ones((near, near), dtype=np.bool_))
    everything = ((0, active.shape[0]), (0, active.shape[1]))
    pieces = _cut(active, everything, 6 * reach)[1]
    return [_region(piece, tight, clipped.shape, active.shape, reach) for piece, tight in pieces]


def span_around(marked: NDArray[np.bool_], axis: int, reach: int) -> slice:
    """From `reach` before the first mark along an axis to `reach` after the last."""
    at = np.flatnonzero(marked.any(axis=1 - axis))
    return slice(max(int(at[0]) - reach, 0), int(at[-1]) + reach + 1)


def _blocks(marked: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether any pixel of a block is marked."""
    rows, cols = (np.arange(0, extent, _BLOCK) for extent in marked.shape)
    return np.logical_or.reduceat(np.logical_or.reduceat(marked, rows, axis=0), cols, axis=1)


def _cut(
    active: NDArray[np.bool_], piece: tuple[_Span, _Span], rim: int
) -> tuple[float, list[tuple[tuple[_Span, _Span], tuple[_Span, _Span]]]]:
    """Cost of the cheapest pieces, and each piece with the least window around its active blocks."""
    (top, bottom), (left, right) = piece
    part = active[top:bottom, left:right]
    rows, cols = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    if rows.size == 0:
        return 0.0, []
    tight = (
        (top + int(rows[0]), top + int(rows[-1]) + 1),
        (left + int(cols[0]), left + int(cols[-1]) + 1),
    )
    whole = _cost(tight, rim)
    alone: tuple[float, list[tuple[tuple[_Span, _Span], tuple[_Span, _Span]]]] = (whole, [(piece, tight)])
    if whole <= 2 * _cost(((0, 1), (0, 1)), rim):
        return alone
    # The widest gap, or the middle of the longer side: trying all cuts takes longer than solving the light.
    gaps = [int(np.diff(marks).max(initial=1)) for marks in (rows, cols)]
    lengths = [last - first for first, last in tight]
    axis = int(np.argmax(gaps if max(gaps) > 1 else lengths))
    at = piece[axis][0] + _cut_position((rows, cols)[axis])
    before, after = (
        ((low, high), (left, right)) if axis == 0 else ((top, bottom), (low, high))
        for low, high in ((piece[axis][0], at), (at, piece[axis][1]))
    )
    cut_before, cut_after = _cut(active, before, rim), _cut(active, after, rim)
    if cut_before[0] + cut_after[0] < whole:
        return cut_before[0] + cut_after[0], cut_before[1] + cut_after[1]
    return alone


def _cut_position(marks: NDArray[np.intp]) -> int:
    """Where to cut: in the middle of the widest gap, or of the whole."""
    gaps = np.diff(marks)
    if gaps.size and gaps.max() > 1:
        widest = int(gaps.argmax())
        return int(marks[widest] + marks[widest + 1] + 1) // 2
    return int(marks[0] + marks[-1] + 1) // 2


def _cost(tight: tuple[_Span, _Span], rim: int) -> float:
    """Pixels of the plane on which a piece is solved, plus its fixed cost."""
    high, wide = (_BLOCK * (last - first) + rim for first, last in tight)
    return float(high * wide + _FIXED)


def _region(
    piece: tuple[_Span, _Span],
    tight: tuple[_Span, _Span],
    shape: tuple[int, ...],
    blocks: tuple[int, ...],
    reach: int,
) -> ClippedRegion:
    """The windows of a piece, in pixels."""
    data, own, answers = [], [], []
    for (first, last), (low, high), extent, count in zip(piece, tight, shape, blocks, strict=True):
        # A piece at the tile's rim also estimates the light beyond it.
        begin = low * _BLOCK - reach if first == 0 else max(low * _BLOCK - reach, first * _BLOCK)
        end = high * _BLOCK + reach if last == count else min(high * _BLOCK + reach, last * _BLOCK)
        start = max(low * _BLOCK - 2 * reach, 0)
        stop = min(high * _BLOCK + 2 * reach, extent)
        end = min(end, extent + reach)
        data.append(slice(start, stop))
        own.append(slice(begin + reach - start, end + reach - start))
        answers.append(slice(max(begin - start, 0), end - start))
    return ClippedRegion((data[0], data[1]), (own[0], own[1]), (answers[0], answers[1]))
