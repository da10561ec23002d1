"""Spread the choice over the field: non-maximum suppression, quotas, field cells."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.estimation.patches.windows import Windows

RINGS: Final = 8  # of equal width in r: as many as are needed to follow blur along the radius (chosen)
OCTANTS: Final = 8  # eighths of a turn, by definition
PATCHES_A_CELL: Final = 3
"""Of all that were asked for, on average: more leave places of the field without any, one alone is a poor
estimate (chosen)."""
MOST_A_CELL: Final = 4
"""Pooling the normal equations of four patches is worth most of what twelve give."""
CELL_R: Final = 0.12  # half-diagonals (chosen): nearer windows tell of the same PSF
CELL_ANGLE: Final = math.radians(24.0)  # the same around the centre, where blur changes less (chosen)
MOST_APART: Final = 3.0  # window sides: farther ones are never of one cell (chosen)

SPREAD_STEP: Final = 1.0  # window sides: nearer windows share pixels (chosen)
MOST_STEPS: Final = 4
"""Distances to the nearest seed count in steps of one window, up to four: beyond, any other window is far
enough, and the better one is taken (chosen)."""


def sector_of(windows: Windows) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Ring (of equal width in r) and octant of every window."""
    ring = np.minimum((windows.r * RINGS).astype(np.intp), RINGS - 1)
    octant = np.floor(windows.phi * (OCTANTS / (2.0 * math.pi))).astype(np.intp) % OCTANTS
    return ring, octant


def shortlist(windows: Windows, score: NDArray[np.float64], most_a_sector: int) -> NDArray[np.intp]:
    """Best windows of every ring and octant that keep half a window's distance from each other."""
    ring, octant = sector_of(windows)
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
    """Choose up to `count` windows in field cells.

    First the seeds, one a cell: always from the ring and octant that has the fewest so far, so
    that the corners get their share, far from the other seeds, and there the best. Then
    every cell in turn takes its best remaining neighbour, up to four. Two windows of one cell
    differ by at most 0.12 in r; and by at most 24 degrees, or they lie less than a window apart
    (where a window is large beside the frame, and near the centre, where the angle says little).

    Returns
    -------
    list of (int, int)
        Number of the window and of its cell.
    """
    order = _by_score(windows, score)
    # Half a window's distance between any two chosen; a whole one between the seeds, if there is room.
    seeds = _seeds(windows, order, math.ceil(count / PATCHES_A_CELL), float(windows.size))
    cells = [[seed] for seed in seeds]
    free = _far_from(windows, seeds, windows.size / 2.0)
    total = len(seeds)
    for _ in range(MOST_A_CELL - 1):
        for members in cells:
            if total >= count:
                break
            near = _same_cell(windows, members[0])
            pick = next((int(i) for i in order if free[i] and near[i]), None)
            if pick is not None:
                members.append(pick)
                free &= _distance(windows, pick) >= windows.size / 2.0
                total += 1
    while total < count and free.any():
        extra = next(int(i) for i in order if free[i])
        home = next((m for m in cells if len(m) < MOST_A_CELL and _same_cell(windows, m[0])[extra]), None)
        if home is None:
            cells.append([extra])
        else:
            home.append(extra)
        free &= _distance(windows, extra) >= windows.size / 2.0
        total += 1
    return [(i, number) for number, members in enumerate(cells) for i in members]


def _seeds(windows: Windows, order: NDArray[np.intp], count: int, distance: float) -> list[int]:
    ring, octant = sector_of(windows)
    # The rings share by area, as far as the photo has anything there: the model needs the corners.
    share = (np.arange(RINGS) + 0.5) * (np.bincount(ring, minlength=RINGS) > 0)
    share /= share.sum()
    in_sector = np.zeros((RINGS, OCTANTS), dtype=np.intp)
    nearest = np.full(len(windows), np.inf)
    free = np.ones(len(windows), dtype=bool)
    seeds: list[int] = []
    while len(seeds) < count and free.any():
        left = order[free[order]]
        fullness = in_sector.sum(axis=1) / np.maximum(share, 1e-9)
        steps = np.minimum(nearest[left] / (SPREAD_STEP * windows.size), MOST_STEPS).astype(np.intp)
        key = np.lexsort(
            (np.arange(left.size), -steps, fullness[ring[left]], in_sector[ring[left], octant[left]])
        )
        best = int(left[key[0]])
        seeds.append(best)
        in_sector[ring[best], octant[best]] += 1
        nearest = np.minimum(nearest, _distance(windows, best))
        free &= _distance(windows, best) >= distance
    return seeds


def _by_score(windows: Windows, score: NDArray[np.float64]) -> NDArray[np.intp]:
    """Best first; equal scores by place, so that the order never depends on chance."""
    return np.lexsort((windows.cols, windows.rows, -score))


def _distance(windows: Windows, i: int) -> NDArray[np.float64]:
    return np.maximum(np.abs(windows.rows - windows.rows[i]), np.abs(windows.cols - windows.cols[i])).astype(
        np.float64
    )


def _far_from(windows: Windows, chosen: list[int], distance: float) -> NDArray[np.bool_]:
    free = np.ones(len(windows), dtype=bool)
    for i in chosen:
        free &= _distance(windows, i) >= distance
    return free


def _same_cell(windows: Windows, i: int) -> NDArray[np.bool_]:
    turn = np.abs((windows.phi - windows.phi[i] + math.pi) % (2.0 * math.pi) - math.pi)
    apart = _distance(windows, i)
    close = (apart < windows.size) | ((turn <= CELL_ANGLE) & (apart <= MOST_APART * windows.size))
    return close & (np.abs(windows.r - windows.r[i]) <= CELL_R)
