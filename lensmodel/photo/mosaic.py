"""The numbers of the sensor before demosaicing: whether they are a picture, where they clip, noise, defects.

A hot pixel taken for a point of light teaches a kernel as narrow as itself. Light comes through a lens: the
pixels beside a point of light get some of it, those beside a defect in smooth surroundings none.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import product
from typing import Final, TypeAlias

import numpy as np
import rawpy
from numpy.typing import NDArray

from lensmodel.core.errors import RawDecodeError, TruncatedImageError, UnsupportedFormatError
from lensmodel.core.numerics import jit
from lensmodel.core.types import BayerPattern, Plane
from lensmodel.photo.containers import require_known_mosaic
from lensmodel.photo.noise import estimate_noise
from lensmodel.photo.values import PlaneNoise

_XTRANS_SIDE: Final = 512  # pixels: LibRaw demosaics no smaller X-Trans (its xtrans_interpolate)
_BAND: Final = 16  # rows that are judged together by `Mosaic.of`

_CLUSTER: Final = 0.005  # width of the pile of saturated pixels in the range: full wells differ a little
_STRAYS: Final = 0.02  # share of a pile that may lie above it: hot pixels; more is a part of the picture
_EDGE: Final = 0.02  # share of a pile below its lower end: 0 would take the darkest stray (chosen)
_LOWEST_PILE: Final = 0.8  # lowest level, relative to the stated one, at which sensors were seen to clip


@dataclass(frozen=True, slots=True, eq=False)
class Mosaic:
    """A colour filter array without its margins."""

    values: NDArray[np.uint16]  # (height, width), raw numbers
    colours: NDArray[np.uint8]  # 0 red, 1 green, 2 blue, 3 second green
    black: tuple[float, ...]  # black level of each of the four
    white: int  # level that the file states for saturation
    period: int  # pixels after which the colours repeat: 2 of Bayer, 6 of X-Trans

    @classmethod
    def of(cls, raw: rawpy.RawPy) -> Mosaic | None:
        """Take the mosaic of a file, `None` where pixels have all colours; refuse what no sensor gives."""
        if raw.raw_type != rawpy.RawType.Flat or raw.raw_pattern is None:
            return None
        letters = raw.color_desc.decode("ascii", "replace")
        require_known_mosaic(["".join(letters[colour] for colour in row) for row in raw.raw_pattern])
        black, values = tuple(map(float, raw.black_level_per_channel)), raw.raw_image_visible
        mosaic = cls(values, raw.raw_colors_visible, black, int(raw.white_level), len(raw.raw_pattern))
        height, width = values.shape
        if mosaic.period == 6 and min(height, width) < _XTRANS_SIDE:
            said = f"{width} x {height} pixels of an X-Trans mosaic are too few to be demosaiced"
            raise UnsupportedFormatError(f"{said}: give the whole frame")
        low, high = values.min(axis=1), values.max(axis=1)
        if low.min() == high.max():
            raise RawDecodeError(f"every pixel of the RAW data is {int(low[0])}; the file holds no picture")
        # A row in which all is saturated is a bright sky, and no damage.
        dead = float(np.mean((low == high) & (low < 0.9 * mosaic.white)))
        if dead > 0.02:
            raise TruncatedImageError(f"{dead:.0%} of the rows of the RAW data are empty; it was cut off")
        if (random := mosaic._random_share()) > 0.25:
            said = "of the RAW data are random numbers; the file is damaged or wrongly decoded"
            raise RawDecodeError(f"{random:.0%} {said}")
        return mosaic

    def _random_share(self) -> float:
        """Share of the bands of rows that have high contrast, but no likeness of neighbouring pixels."""
        # independent values differ by 2 / sqrt(pi) = 1.13 standard deviations on average, photographs by 0.5
        starts = range(0, len(self.values), _BAND)
        scale, random = max(self.white - min(self.black), 1.0), 0
        for row in starts:
            band = self.values[row : row + _BAND].astype(np.float32)
            steps, alike = band[:, 2:] - band[:, :-2], band
            if self.period == 6:  # greens that touch
                colours = self.colours[row : row + _BAND]
                steps = np.diff(band, axis=1)[colours[:, 1:] == colours[:, :-1]]
                alike = band[colours == 1]
            step, deviation = float(np.abs(steps).mean()) if steps.size else 0.0, float(alike.std())
            random += deviation > 0.15 * scale and step > 0.9 * deviation
        return random / len(starts)

    def saturation(self) -> tuple[int, tuple[float, float, float]]:
        """Level at which the sensor clips, and that of each colour relative to it, where pixels pile up."""
        # the level that a file states is often too high, and the colours of some sensors differ
        piles = {k: pile for k in range(4) if (pile := self._pile(k)) is not None}
        white = min(max((end for _, end in piles.values()), default=self.white), self.white)
        clip = [1.0, 1.0, 1.0, 1.0]
        for k, (start, _) in piles.items():
            clip[k] = min(1.0, (start - self.black[k]) / max(white - self.black[k], 1.0))
        return white, (clip[0], min(clip[1], clip[3]), clip[2])

    def _pile(self, colour: int) -> tuple[int, int] | None:
        """Lower and upper end of the pile of saturated pixels of one colour; `None` without one."""
        # full wells differ from pixel to pixel, by a hundredth on old sensors; hot pixels shine beyond them
        counts = np.bincount(self.values[self.colours == colour])
        scale = self.white - self.black[colour]
        first = max(int(self.black[colour] + _LOWEST_PILE * scale), 0)
        width = max(2, round(_CLUSTER * scale))
        if len(counts) <= first + 1:
            return None
        in_width = np.convolve(counts[first:], np.ones(width, dtype=np.intp))[width - 1 :]
        middle = first + int(np.argmax(in_width)) + width // 2
        low, high = max(middle - 2 * width, 0), middle + 2 * width
        pile, above = int(counts[low:high].sum()), int(counts[high:].sum())
        below = int(counts[max(2 * low - high, 0) : low].sum())
        # More than half of a colour in one pile is an even area of a drawing, not a clipped light.
        enough = max(50, 2e-5 * counts.sum()) < pile < 0.5 * counts.sum()
        if not enough or pile < 5 * below or above > _STRAYS * pile:
            return None
        # what of the picture lies under the pile as it does below it does not belong to it
        inside = np.cumsum(counts[low:] - below / (high - low))
        first = int(np.argmax(inside >= _EDGE * pile))
        last = np.searchsorted(np.cumsum(counts[low:]), (1.0 - _STRAYS / 2.0) * (pile + above))
        return low + first, low + int(last)

    def noise(self, white: int) -> PlaneNoise | None:
        """Measure the noise of the sensor in each colour, `white` being 1; `None` for X-Trans."""
        if self.period != 2:
            return None
        sites: dict[int, Plane] = {}  # of the second green as of the first
        for row, col in np.ndindex(2, 2):
            colour = int(self.colours[row, col])
            black = np.float32(self.black[colour])
            values = self.values[row::2, col::2].astype(np.float32)
            sites.setdefault(1 if colour == 3 else colour, (values - black) / (np.float32(white) - black))
        step = 1.0 / max(white - min(self.black), 1.0)
        return tuple(estimate_noise(sites[k], step=step) for k in range(3))

    def bayer_pattern(self) -> BayerPattern | None:
        """Channel of each pixel of the top left 2 x 2; `None` for X-Trans."""
        (a, b), (c, d) = np.where(self.colours[:2, :2] == 3, 1, self.colours[:2, :2]).tolist()
        return ((a, b), (c, d)) if self.period == 2 else None


# --- defective pixels --------------------------------------------------------------------------

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
_RIM: Final = 6  # pixels by which a mosaic is continued: more than `_REACH`, and whole periods of any mosaic
# Least height above all neighbours but one, not above their median: in standard deviations, and relative to
# how much those that are left differ (chosen)
_NEARLY: Final = (8.0, 0.75)
_SAMPLES: Final = 60_000  # pixels that tell of the noise (chosen): more would not change it
_LEVELS: Final = 24  # at which noise is measured (chosen)
_QUIET: Final = 0.3  # share of a level's pixels, most like their neighbours, that tell of the noise (chosen)
_QUIET_HEIGHT: Final = 0.42  # their quantile of |N(0, 1 + pi / 16)|: white noise against a median of eight

Places: TypeAlias = NDArray[np.int64]
"""Pixels of a mosaic that is continued beyond its rim, by their number, row by row."""


class Neighbours:
    """A mosaic, continued beyond its rim by what lies whole periods inside, and like pixels in it."""

    def __init__(self, values: NDArray[np.uint16], colours: NDArray[np.uint8], period: int) -> None:
        self.shape, self.width = values.shape, values.shape[1] + 2 * _RIM
        rows = np.concatenate([values[:_RIM], values, values[-_RIM:]])
        self.values = np.concatenate([rows[:, :_RIM], rows, rows[:, -_RIM:]], axis=1).ravel()
        pattern = np.where(colours[:period, :period] == 3, 1, colours[:period, :period])
        around = np.array([at for at in product(range(-_REACH, _REACH + 1), repeat=2) if any(at)])
        around = around[np.argsort(np.square(around).sum(axis=1), kind="stable")]
        self.offsets = np.empty((period, period, _NEIGHBOURS), dtype=np.int64)  # by distance
        for row, col in np.ndindex(period, period):
            same = pattern[tuple((around + np.array([row, col])).T % period)] == pattern[row, col]
            self.offsets[row, col] = around[same][:_NEIGHBOURS] @ (self.width, 1)

    def of(self, places: Places) -> Places:
        """Nearest pixels of the same colour, shape (8, places), by distance."""
        rows, cols = (index % len(self.offsets) for index in np.divmod(places, self.width))
        return (places[:, None] + self.offsets[rows, cols]).T

    def median(self, places: Places) -> NDArray[np.float32]:
        """Median of the nearest pixels of the same colour."""
        return np.median(self.values[self.of(places)].astype(np.float32), axis=0)


def replace_defects(values: NDArray[np.uint16], colours: NDArray[np.uint8], period: int) -> int:
    """Replace pixels that stand alone by the median of the nearest sound ones of their colour; count them."""
    near = Neighbours(values, colours, period)
    levels, deviations = _noise(near)
    least = (_NEARLY[0] * np.interp(np.arange(1 << 16), levels, deviations)).astype(np.float32)
    places = np.flatnonzero(_standing_out(near.values, near.offsets, near.width, least))
    ring = near.values[near.of(places)].astype(np.float32)
    middle = np.median(ring, axis=0)
    sign, height = np.sign(near.values[places] - middle), np.abs(near.values[places] - middle)
    apart = np.sort(np.abs(ring - middle), axis=0)
    sigma = np.maximum(np.interp(middle, levels, deviations), 1.4826 * apart[_NEIGHBOURS // 2])
    touching = [places + step for step in (-near.width, -1, 1, near.width)]
    bumps = np.stack([sign * (near.values[beside] - near.median(beside)) for beside in touching])

    def alone(sigmas: float, contrast: float, most_beside: float) -> Places:
        chosen = np.maximum(sigmas * sigma, contrast * apart[-1]) < height
        chosen &= bumps.mean(axis=0) < most_beside * height
        return places[chosen & (np.abs(bumps).max(axis=0) < most_beside * height + 4.0 * sigma)]

    sure, likely = alone(*_SURE), alone(*_LIKELY)
    if len(sure) > _MOST * values.size:
        return 0
    defects = likely if len(sure) > _MANY * len(np.setdiff1d(likely, sure)) else sure
    around = near.of(defects)
    ring = np.where(np.isin(around, defects), np.nan, near.values[around].astype(np.float32))
    first = np.argsort(np.isnan(ring), axis=0, kind="stable")[:_FILLED_FROM]
    ring = np.take_along_axis(ring, first, axis=0)
    sound = ~np.isnan(ring).all(axis=0)
    rows, cols = (index - _RIM for index in np.divmod(defects[sound], near.width))
    values[rows, cols] = np.rint(np.nanmedian(ring[:, sound], axis=0))
    return len(rows)


def _noise(near: Neighbours) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Levels, and the standard deviation of the noise there, on the pixels most like their neighbours."""
    size = math.prod(near.shape)
    rows, cols = np.divmod(np.arange(0, size, max(1, size // _SAMPLES) | 1), near.shape[1])
    places = (rows + _RIM) * near.width + cols + _RIM
    middle = near.median(places)
    height = np.abs(near.values[places] - middle)
    parts = np.array_split(np.argsort(middle, kind="stable"), _LEVELS)
    levels = [float(middle[part].mean()) for part in parts]
    sigma = [float(np.quantile(height[part], _QUIET)) / _QUIET_HEIGHT for part in parts]
    return np.array(levels), np.maximum(sigma, 0.5)  # no less than what rounding makes


@jit
def _standing_out(
    values: NDArray[np.uint16], offsets: NDArray[np.int64], width: int, least: NDArray[np.float32]
) -> NDArray[np.bool_]:
    """Pixels that differ from all but one of their neighbours of the colour by more than those differ."""
    period = len(offsets)
    found = np.zeros(len(values), np.bool_)
    for row in range(_RIM, len(values) // width - _RIM):
        for col in range(_RIM, width - _RIM):
            place = row * width + col
            high, second, second_low, low = 0, 0, 65535, 65535
            for offset in offsets[row % period, col % period]:
                one = int(values[place + offset])
                second, high = max(second, min(high, one)), max(high, one)
                second_low, low = min(second_low, max(low, one)), min(low, one)
            own = int(values[place])
            need = max(_NEARLY[1] * max(second - second_low, 0), least[second])
            found[place] = max(own - second, second_low - own) > need
    return found
