"""Defective pixels of a sensor: found on the mosaic of one photo and replaced by their neighbours.

A hot pixel taken for a point of light teaches a kernel as narrow as itself, and a correction makes a ring
of it. Light comes through a lens: the pixels beside a point of light get some of it. So a photo shows a
defect where one pixel stands out of smooth surroundings that get none; in busy places it stays.
"""

from __future__ import annotations

from itertools import product
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

# Least height above the neighbours of the colour, in standard deviations of the noise and relative to how
# much these differ, where texture stays below, and most of it in the pixels beside: points of light have a
# tenth. All are chosen.
_SURE: Final = (25.0, 5.0, 0.05)
_LIKELY: Final = (10.0, 2.0, 0.15)

_MANY: Final = 3.0  # where so many times more are sure than likely, the likely ones are defects too (chosen)
_MOST: Final = 2e-3  # share of the pixels above which they are a picture, such as a sky of stars (chosen)
_NEIGHBOURS: Final = 8  # of the same colour
_FILLED_FROM: Final = 4  # of them, the nearest (chosen): more lie across edges
_REACH: Final = 4  # pixels to the farthest of them, in any mosaic that is read
# Least height above all neighbours but one, not above their median: in standard deviations, and relative to
# how much those that are left differ (chosen)
_NEARLY: Final = (8.0, 0.75)
_SAMPLES: Final = 60_000  # pixels that tell of the noise (chosen): more would not change it
_LEVELS: Final = 24  # at which noise is measured (chosen)
_QUIET: Final = 0.3  # share of a level's pixels, most like their neighbours, that tell of the noise (chosen)
_QUIET_HEIGHT: Final = 0.42  # their quantile of |N(0, 1 + pi / 16)|: white noise against a median of eight

Places: TypeAlias = NDArray[np.int64]
"""Pixels of a mosaic by their number, row by row; sorted."""


class Neighbours:
    """Which pixels of a mosaic are the nearest of the same colour, and which touch.

    `colours` are 0 red, 1 and 3 green, 2 blue, and repeat after `period` pixels, 2 or 6.
    """

    def __init__(self, colours: NDArray[np.uint8], period: int) -> None:
        self.shape, self.period = colours.shape, period
        self._step = period * -(-_REACH // period)  # by which a place beyond the frame moves into it
        pattern = np.where(colours[:period, :period] == 3, 1, colours[:period, :period])
        around = [at for at in product(range(-_REACH, _REACH + 1), repeat=2) if any(at)]
        around.sort(key=lambda at: (at[0] ** 2 + at[1] ** 2, at))
        self.alike: dict[tuple[int, int], list[tuple[int, int]]] = {}
        for row, col in np.ndindex(period, period):
            same = [
                (down, right)
                for down, right in around
                if pattern[(row + down) % period, (col + right) % period] == pattern[row, col]
            ]
            self.alike[row, col] = same[:_NEIGHBOURS]

    def inside(self, rows: NDArray[np.integer], cols: NDArray[np.integer]) -> tuple[Places, Places]:
        """Move places beyond the frame into it by whole periods: the colour stays, the pixel is another."""
        moved_rows, moved_cols = (
            index + self._step * ((index < 0).astype(np.int64) - (index >= length))
            for index, length in zip((rows, cols), self.shape, strict=True)
        )
        return moved_rows, moved_cols

    def of(self, places: Places) -> Places:
        """Nearest pixels of the same colour, shape (8, places), by distance."""
        rows, cols = np.divmod(places, self.shape[1])
        offsets = np.array([self.alike[site] for site in np.ndindex(self.period, self.period)])
        own = offsets[(rows % self.period) * self.period + cols % self.period]  # (places, 8, 2)
        at = self.inside(rows[:, None] + own[..., 0], cols[:, None] + own[..., 1])
        return (at[0] * self.shape[1] + at[1]).T

    def touching(self, places: Places) -> Places:
        """The pixels above, left, right and below, shape (4, places)."""
        rows, cols = np.divmod(places, self.shape[1])
        around = np.array([(-1, 0), (0, -1), (0, 1), (1, 0)])
        # by twice a step where a pixel has no other beside it: of the other colour, as on the other side
        at = self.inside(rows + around[:, :1], cols + around[:, 1:])
        return at[0] * self.shape[1] + at[1]


def defects(values: NDArray[np.uint16], near: Neighbours) -> Places:
    """Find the pixels of a mosaic that stand alone, brighter or darker than all around them."""
    levels, deviations = _noise(values, near)
    flat, places = values.ravel(), _standing_out(values, near, levels, deviations)
    ring = flat[near.of(places)].astype(np.float32)
    middle = np.median(ring, axis=0)
    sign = np.sign(flat[places] - middle)
    height = np.abs(flat[places] - middle)
    apart = np.sort(np.abs(ring - middle), axis=0)
    sigma = np.maximum(np.interp(middle, levels, deviations), 1.4826 * apart[_NEIGHBOURS // 2])
    beside = near.touching(places)
    level = np.median(flat[near.of(beside.ravel())].astype(np.float32), axis=0).reshape(beside.shape)
    bumps = sign * (flat[beside] - level)

    def alone(sigmas: float, contrast: float, most_beside: float) -> Places:
        chosen = np.maximum(sigmas * sigma, contrast * apart[-1]) < height
        chosen &= bumps.mean(axis=0) < most_beside * height
        return np.sort(places[chosen & (np.abs(bumps).max(axis=0) < most_beside * height + 4.0 * sigma)])

    sure, likely = alone(*_SURE), alone(*_LIKELY)
    if len(sure) > _MOST * values.size:
        return places[:0]
    return likely if len(sure) > _MANY * len(np.setdiff1d(likely, sure)) else sure


def replace_defects(values: NDArray[np.uint16], places: Places, near: Neighbours) -> int:
    """Write the median of the nearest sound neighbours of its colour into each place; return how many."""
    if len(places) == 0:
        return 0
    around = near.of(places)
    ring = values[np.divmod(around, values.shape[1])].astype(np.float32)
    ring[np.isin(around, places)] = np.nan
    first = np.argsort(np.isnan(ring), axis=0, kind="stable")[:_FILLED_FROM]
    ring = np.take_along_axis(ring, first, axis=0)
    sound = ~np.isnan(ring).all(axis=0)
    filled = np.rint(np.nanmedian(ring[:, sound], axis=0)).astype(values.dtype)
    values[np.divmod(places[sound], values.shape[1])] = filled
    return len(filled)


def _noise(values: NDArray[np.uint16], near: Neighbours) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Levels, and the standard deviation of the noise there, on the pixels most like their neighbours."""
    places = np.arange(0, values.size, max(1, values.size // _SAMPLES) | 1)
    flat = values.ravel()
    middle = np.median(flat[near.of(places)].astype(np.float32), axis=0)
    height = np.abs(flat[places] - middle)
    parts = np.array_split(np.argsort(middle, kind="stable"), _LEVELS)
    levels = [float(middle[part].mean()) for part in parts]
    sigma = [float(np.quantile(height[part], _QUIET)) / _QUIET_HEIGHT for part in parts]
    return np.array(levels), np.maximum(sigma, 0.5)  # no less than what rounding makes


def _standing_out(
    values: NDArray[np.uint16], near: Neighbours, levels: NDArray[np.float64], sigma: NDArray[np.float64]
) -> Places:
    """Pixels that differ from all but one of their neighbours of the colour by more than those differ."""
    index = near.inside(*(np.arange(-_REACH, side + _REACH) for side in values.shape))
    wide, period = values[np.ix_(*index)], near.period
    planes = {site: np.ascontiguousarray(wide[site[0] :: period, site[1] :: period]) for site in near.alike}
    least = (_NEARLY[0] * np.interp(np.arange(1 << 16), levels, sigma)).astype(np.float32)
    found = []
    for (row, col), offsets in near.alike.items():
        site = values[row::period, col::period]
        height, width = site.shape
        high, second = np.zeros((2, *site.shape), np.uint16)
        low, second_low = np.full((2, *site.shape), np.iinfo(np.uint16).max, np.uint16)
        for down, right in offsets:
            (top, odd_row), (left, odd_col) = (
                divmod(_REACH + at, period) for at in (row + down, col + right)
            )
            one = planes[odd_row, odd_col][top : top + height, left : left + width]
            np.maximum(second, np.minimum(high, one), out=second)
            np.maximum(high, one, out=high)
            np.minimum(second_low, np.maximum(low, one), out=second_low)
            np.minimum(low, one, out=low)
        spread = (second - np.minimum(second, second_low)).astype(np.float32)
        need = np.maximum(np.float32(_NEARLY[1]) * spread, least[second])
        above = site - np.minimum(site, second)
        below = second_low - np.minimum(second_low, site)
        rows, cols = np.nonzero(np.maximum(above, below) > need)
        found.append((rows * period + row) * values.shape[1] + cols * period + col)
    return np.concatenate(found)
