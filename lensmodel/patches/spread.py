"""Spread windows over the field.

`spread_windows` keeps of scored windows the best ones that lie apart: non-maximum suppression, quotas, cells
of the field. `spread_evenly`, for the learned estimator, cuts the frame into equal cells and moves one window
within each to where detail is richest; flat and clipped ones alone are left out, for the network weighs its
patches.
"""

from __future__ import annotations

import math
from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.geometry import Frame
from lensmodel.patches.windows import Patch, Reason, Rejection, Selection, Windows
from lensmodel.photo.values import LinearPhoto

RINGS: Final = 8  # of equal width in r: as many as are needed to follow blur along the radius (chosen)
OCTANTS: Final = 8  # eighths of a turn, by definition
PATCHES_A_CELL: Final = 3
"""Of all asked for, on average: more leave places without any, one alone is a poor estimate (chosen)."""
MOST_A_CELL: Final = 4
"""Pooling the normal equations of four patches is worth most of what twelve give."""
CELL_R: Final = 0.12  # half-diagonals (chosen): nearer windows tell of the same PSF
CELL_ANGLE: Final = math.radians(24.0)  # the same around the centre, where blur changes less (chosen)
MOST_APART: Final = 3.0  # window sides: farther ones are never of one cell (chosen)

SPREAD_STEP: Final = 1.0  # window sides: nearer windows share pixels (chosen)
MOST_STEPS: Final = 4
"""Distances to the nearest seed count in window sides up to this; beyond, the better one wins (chosen)."""


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
    detail, noise, clipped = _blocks(developed)
    rows, cols = _cells(frame, count, size)
    patches: list[Patch] = []
    rejected: list[Rejection] = []
    for row, row_room in rows:
        for col, col_room in cols:
            moved = [
                (
                    _even(row + a * row_room, frame.height - size),
                    _even(col + b * col_room, frame.width - size),
                )
                for a in _MOVES
                for b in _MOVES
            ]
            looked = [_look(detail, noise, clipped, place, size) for place in dict.fromkeys(moved)]
            usable = [one for one in looked if one[1] == ""]
            score, reason, (top, left) = max(usable or looked, key=lambda one: (one[0], one[2]))
            if reason:
                rejected.append(Rejection(top, left, size, reason))
                continue
            center = (top + (size - 1) / 2.0, left + (size - 1) / 2.0)
            patches.append(Patch(top, left, size, frame.position(*center), min(score / 3.0, 1.0), 0))
    if not patches:
        reasons = sorted({rejection.reason for rejection in rejected})
        raise NoUsablePatchesError(
            f"none of {len(rejected)} windows is usable ({', '.join(reasons)}); "
            "take a scene with fine detail all over, at a lower ISO"
        )
    return Selection(tuple(patches), tuple(rejected))


def _cells(
    frame: Frame, count: int, size: int
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """First rows and columns of windows in the middle of their cells, with the room to either side."""
    most = [max((side - size) // _LEAST_STEP + 1, 1) for side in (frame.height, frame.width)]
    down = min(max(round((count * frame.height / frame.width) ** 0.5), 1), most[0], count)
    across = min(max(count // down, 1), most[1])

    def along(side: int, number: int) -> list[tuple[float, float]]:
        step = (side - size) / number
        return [((i + 0.5) * step, 0.5 * step) for i in range(number)]

    return along(frame.height, down), along(frame.width, across)


def _even(value: float, most: int) -> int:
    """Round to a pixel of the same colour as the first of a mosaic."""
    return min(max(2 * round(value / 2.0), 0), most // 2 * 2)


def _blocks(developed: LinearPhoto) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Power of the gradients of green, that of its noise, and the share of clipped pixels, by block."""
    height, width = (side // _BLOCK * _BLOCK for side in (developed.frame.height, developed.frame.width))
    shape = (height // _BLOCK, width // _BLOCK)
    detail, level, clipped = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    model = developed.coarse_noise[1]
    for index in range(shape[0]):  # strips: a photo may be mapped from a file
        strip = developed.planes[:, index * _BLOCK : (index + 1) * _BLOCK, :width]
        full = np.zeros(strip.shape[1:], dtype=bool)
        for plane, clip in zip(strip, developed.clip, strict=True):
            full |= plane >= _FULL * clip
        green = np.asarray(strip[1, ::2, ::2], dtype=np.float32)
        power = np.zeros_like(green)
        power[:, :-1] += np.diff(green, axis=1) ** 2
        power[:-1] += np.diff(green, axis=0) ** 2
        half = _BLOCK // 2
        detail[index] = power.reshape(half, -1, half).mean(axis=(0, 2))
        level[index] = green.reshape(half, -1, half).mean(axis=(0, 2))
        clipped[index] = full.reshape(_BLOCK, -1, _BLOCK).mean(axis=(0, 2))
    return detail, 4.0 * model.variance(level), clipped  # two differences of two values each


def _look(
    detail: NDArray[np.float64],
    noise: NDArray[np.float64],
    clipped: NDArray[np.float64],
    place: tuple[int, int],
    size: int,
) -> tuple[float, Reason | Literal[""], tuple[int, int]]:
    """Mean logarithm of signal over noise of a window's blocks, and why it is not used."""
    top, left = (round(value / _BLOCK) for value in place)
    part = (slice(top, top + size // _BLOCK), slice(left, left + size // _BLOCK))
    ratio = detail[part] / np.maximum(noise[part], 1e-12)
    score = float(np.log10(np.maximum(ratio, 1.0)).mean())
    reason: Reason | Literal[""]
    reason = "clipped" if clipped[part].mean() > _CLIPPED else "flat" if ratio.mean() < _SIGNAL else ""
    return score, reason, place
