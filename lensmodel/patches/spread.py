"""Spread windows over the field.

`spread_windows` keeps of scored windows the best ones that lie apart: non-maximum suppression, quotas, cells
of the field. `spread_evenly`, for the learned estimator, moves one window in each of equal cells to where
detail is richest; flat and clipped ones alone are left out, for the network weighs its patches.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.types import Frame
from lensmodel.patches.windows import Patch, Reason, Rejection, Selection, Windows
from lensmodel.photo.values import LinearPhoto

RINGS: Final = 8  # of equal width in r: as many as are needed to follow blur along the radius (chosen)
OCTANTS: Final = 8  # eighths of a turn, by definition
PATCHES_A_CELL: Final = 3  # on average: more leave places without any, one alone is a poor estimate (chosen)
MOST_A_CELL: Final = 4  # pooling the normal equations of four patches is worth most of what twelve give
CELL_R: Final = 0.12  # half-diagonals (chosen): nearer windows tell of the same PSF
CELL_ANGLE: Final = math.radians(24.0)  # the same around the centre, where blur changes less (chosen)
MOST_APART: Final = 3.0  # window sides: farther ones are never of one cell (chosen)
SPREAD_STEP: Final = 1.0  # window sides: nearer windows share pixels (chosen)
MOST_STEPS: Final = 4  # window sides to the nearest seed that count; beyond, the better one wins (chosen)


def shortlist(windows: Windows, score: NDArray[np.float64], most_a_sector: int) -> NDArray[np.intp]:
    """Best windows of every ring and octant that keep half a window's distance from each other."""
    ring, octant = _sector_of(windows)
    room = np.full((RINGS, OCTANTS), most_a_sector)
    chosen: list[int] = []
    free = np.ones(len(windows), dtype=bool)
    for i in _by_score(windows, score):
        if free[i] and room[ring[i], octant[i]] > 0:
            chosen.append(int(i))
            room[ring[i], octant[i]] -= 1
            free &= _distance(windows, int(i)) >= windows.size / 2.0
    return np.array(chosen, dtype=np.intp)


def spread_windows(windows: Windows, score: NDArray[np.float64], count: int) -> list[tuple[int, int]]:
    """Choose up to `count` windows in field cells: their numbers, and those of their cells.

    First the seeds, one a cell; then every cell in turn takes its best remaining neighbour, up to four.
    """
    order = _by_score(windows, score)
    # Half a window's distance between any two chosen; a whole one between the seeds, if there is room.
    cells = [[seed] for seed in _seeds(windows, order, math.ceil(count / PATCHES_A_CELL))]
    free = np.ones(len(windows), dtype=bool)
    for (seed,) in cells:
        free &= _distance(windows, seed) >= windows.size / 2.0

    def best(among: NDArray[np.bool_]) -> int | None:
        found = order[(free & among)[order]]
        return int(found[0]) if found.size and sum(map(len, cells)) < count else None

    def put(window: int, members: list[int]) -> None:
        members.append(window)
        np.logical_and(free, _distance(windows, window) >= windows.size / 2.0, out=free)

    for members in cells * (MOST_A_CELL - 1):
        window = best(_same_cell(windows, members[0]))
        if window is not None:
            put(window, members)
    while (window := best(free)) is not None:  # one that is near no cell founds its own
        near = (m for m in cells if len(m) < MOST_A_CELL and _same_cell(windows, m[0])[window])
        home = next(near, None)
        if home is None:
            cells.append(home := [])
        put(window, home)
    return [(i, number) for number, members in enumerate(cells) for i in members]


def _seeds(windows: Windows, order: NDArray[np.intp], count: int) -> list[int]:
    """First windows of cells, from the rings and octants that have the fewest so far."""
    ring, octant = _sector_of(windows)
    # The rings share by area, as far as the photo has anything there: the model needs the corners.
    share = (np.arange(RINGS) + 0.5) * (np.bincount(ring, minlength=RINGS) > 0)
    share /= share.sum()
    in_sector = np.zeros((RINGS, OCTANTS), dtype=np.intp)
    nearest = np.full(len(windows), np.inf)
    seeds: list[int] = []
    while len(seeds) < count and (nearest >= windows.size).any():
        left = order[nearest[order] >= windows.size]
        fullness = in_sector.sum(axis=1) / np.maximum(share, 1e-9)
        steps = np.minimum(nearest[left] / (SPREAD_STEP * windows.size), MOST_STEPS).astype(np.intp)
        key = np.lexsort((-steps, fullness[ring[left]], in_sector[ring[left], octant[left]]))
        best = int(left[key[0]])  # of equal ones the first, the best: the sort is stable
        seeds.append(best)
        in_sector[ring[best], octant[best]] += 1
        nearest = np.minimum(nearest, _distance(windows, best))
    return seeds


def _sector_of(windows: Windows) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ring (of equal width in r) and octant of every window."""
    ring = np.minimum((windows.r * RINGS).astype(np.intp), RINGS - 1)
    octant = np.floor(windows.phi * (OCTANTS / (2.0 * math.pi))).astype(np.intp) % OCTANTS
    return ring, octant


def _by_score(windows: Windows, score: NDArray[np.float64]) -> NDArray[np.intp]:
    """Best first; equal scores by place, so that the order never depends on chance."""
    return np.lexsort((windows.cols, windows.rows, -score))


def _distance(windows: Windows, i: int) -> NDArray[np.int64]:
    """Pixels from one window to each, along the axis on which they are farther apart."""
    return np.maximum(np.abs(windows.rows - windows.rows[i]), np.abs(windows.cols - windows.cols[i]))


def _same_cell(windows: Windows, i: int) -> NDArray[np.bool_]:
    turn = np.abs((windows.phi - windows.phi[i] + math.pi) % (2.0 * math.pi) - math.pi)
    apart = _distance(windows, i)
    close = (apart < windows.size) | ((turn <= CELL_ANGLE) & (apart <= MOST_APART * windows.size))
    return close & (np.abs(windows.r - windows.r[i]) <= CELL_R)


_BLOCK: Final = 16  # pixels: a window is eight of them along a side (chosen)
_LEAST_STEP: Final = 64  # pixels between windows: nearer ones share most of their pixels (chosen)
_CLIPPED: Final = 0.02  # of the pixels of a window: statistics of edges suffer beyond
_FULL: Final = 0.98  # of the level at which a plane clips
_SIGNAL: Final = 2.0  # power of gradients over that of noise: below, noise is all there is (chosen)
_MOVES: Final = (-0.8, -0.4, 0.0, 0.4, 0.8)  # within the room of a cell: neighbours do not meet


def spread_evenly(developed: LinearPhoto, *, count: int, size: int) -> Selection:
    """Choose at most `count` windows of side `size`, the same ones always."""
    frame = developed.frame
    if min(frame.height, frame.width) < size:
        raise NoUsablePatchesError(
            f"the photo is {frame.width} x {frame.height} px, a patch needs {size}; "
            "use the photo in its full size"
        )
    ratio, clipped = _blocks(developed)
    patches: list[Patch] = []
    rejected: list[Rejection] = []
    for rows, cols in _cells(frame, count, size):
        looked: list[tuple[bool, float, tuple[int, int], Reason]] = []
        for top, left in itertools.product(rows, cols):
            at = round(top / _BLOCK), round(left / _BLOCK)
            part = tuple(slice(start, start + size // _BLOCK) for start in at)
            score = float(np.log10(np.maximum(ratio[part], 1.0)).mean())
            full = float(clipped[part].mean()) > _CLIPPED
            usable = not full and float(ratio[part].mean()) >= _SIGNAL
            looked.append((usable, score, (top, left), "clipped" if full else "flat"))
        usable, score, (top, left), reason = max(looked)
        if usable:
            position = frame.position(top + (size - 1) / 2.0, left + (size - 1) / 2.0)
            patches.append(Patch(top, left, size, position, min(score / 3.0, 1.0), 0))
        else:
            rejected.append(Rejection(top, left, size, reason))
    if not patches:
        reasons = sorted({rejection.reason for rejection in rejected})
        raise NoUsablePatchesError(
            f"none of {len(rejected)} windows is usable ({', '.join(reasons)}); "
            "take a scene with fine detail all over, at a lower ISO"
        )
    return Selection(tuple(patches), tuple(rejected))


def _cells(frame: Frame, count: int, size: int) -> Iterator[tuple[list[int], list[int]]]:
    """Rows and columns of each equal cell at which a window may begin, of the same colour of a mosaic."""
    most = [max((side - size) // _LEAST_STEP + 1, 1) for side in (frame.height, frame.width)]
    down = min(max(round((count * frame.height / frame.width) ** 0.5), 1), most[0], count)
    across = min(max(count // down, 1), most[1])

    def along(side: int, number: int) -> list[list[int]]:
        step, last = (side - size) / number, (side - size) // 2 * 2
        middles = [(i + 0.5) * step for i in range(number)]
        return [[min(max(2 * round((m + a * 0.5 * step) / 2.0), 0), last) for a in _MOVES] for m in middles]

    return itertools.product(along(frame.height, down), along(frame.width, across))


def _blocks(developed: LinearPhoto) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Power of the gradients of green over that of its noise, and the share of clipped pixels, by block."""
    height, width = (side // _BLOCK * _BLOCK for side in (developed.frame.height, developed.frame.width))
    shape = (height // _BLOCK, width // _BLOCK)
    detail, level, clipped = np.zeros((3, *shape))
    half, limits = _BLOCK // 2, np.array([_FULL * clip for clip in developed.clip], dtype=np.float32)
    for index in range(shape[0]):  # strips: a photo may be mapped from a file
        strip = developed.planes[:, index * _BLOCK : (index + 1) * _BLOCK, :width]
        full = (strip >= limits[:, None, None]).any(axis=0)
        green = np.asarray(strip[1, ::2, ::2], dtype=np.float32)
        power = np.zeros_like(green)
        power[:, :-1] += np.diff(green, axis=1) ** 2
        power[:-1] += np.diff(green, axis=0) ** 2
        detail[index] = power.reshape(half, -1, half).mean(axis=(0, 2))
        level[index] = green.reshape(half, -1, half).mean(axis=(0, 2))
        clipped[index] = full.reshape(_BLOCK, -1, _BLOCK).mean(axis=(0, 2))
    noise = 4.0 * developed.coarse_noise[1].variance(level)  # two differences of two values each
    return detail / np.maximum(noise, 1e-12), clipped
