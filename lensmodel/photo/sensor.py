"""What a photo itself tells of its sensor: noise, and on the mosaic damage, saturation and defective pixels.

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
from scipy import ndimage, optimize

from lensmodel.core.errors import RawDecodeError, TruncatedImageError, UnsupportedFormatError
from lensmodel.core.numerics import jit
from lensmodel.core.types import BayerPattern, NoiseModel, Plane, block_means
from lensmodel.photo.containers import require_known_mosaic
from lensmodel.photo.values import PlaneNoise

BLOCK: Final = 8  # side of the blocks in pixels: flat places of this size exist in almost any photo
GRAIN: Final = 4  # side of blocks whose means tell of coarse grain: fine grain averages out there (chosen)
_GRAIN_LEVELS: Final = (0.25, 0.5, 0.75)  # shares of the pixels that are darker (chosen)
_BINS: Final = 24  # levels at most, from dark to bright (chosen): a line of two terms needs no more
_FLAT_SHARE: Final = 0.15  # share of the blocks of one level, the least textured, that count (chosen)
_MIN_BLOCKS: Final = 24  # of a level (chosen): 1,536 pixels tell a standard deviation within some percent
_ENOUGH_PIXELS: Final = 3_000_000  # of a plane (chosen): more would not change the fit
_MAD_TO_SIGMA: Final = 1.4826  # of a normal distribution: 1 / its upper quartile
_CUT: Final = 1.5  # standard deviations beyond which a difference counts as no more than that: see `_scale`
_CUT_POWER: Final = 0.778465  # mean of min(z^2, _CUT^2) of a standard normal z

# The difference of two Laplacians: unit gain for white noise, blind to planes and to edges
# along the axes. J. Immerkaer, "Fast noise variance estimation", CVIU 64, 1996, eq. 2.
_HIGH_PASS: Final = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]).astype(np.float32) / np.float32(6.0)


def estimate_noise(
    plane: Plane, clip: float = 1.0, step: float = 0.0, codes: NDArray[np.floating] | None = None
) -> NoiseModel:
    """Fit var(y) = shot * y + read to the flat places of a plane of linear light whose noise is white.

    A variance is no less than what rounding makes: by the smallest `step` between the file's numbers near
    black, or by the light of each of its `codes` of 8 bits. A. Foi, M. Trimeche, V. Katkovnik, K. Egiazarian,
    "Practical Poissonian-Gaussian noise modeling and fitting for single-image raw-data", IEEE TIP 17, 2008.
    """
    levels, variances, counts = _levels(_sampled(np.asarray(plane, dtype=np.float32)), clip).T
    if codes is not None and len(levels):
        variances = np.maximum(variances, np.interp(levels, codes, np.gradient(codes) ** 2 / 12.0))
    if len(levels) < 2:
        return NoiseModel(0.0, max(float(variances.sum()), step * step / 12.0))
    slope, offset = _line(levels, variances, counts)
    return NoiseModel(slope, max(offset, step * step / 12.0))


def coding_noise(coarseness: float, curve: NDArray[np.floating]) -> NoiseModel | None:
    """Noise that a JPEG's rounding of cosine coefficients makes where detail is: step^2 / 12 in each."""
    if not coarseness:
        return None
    # the middle step speaks for all: the coarsest are those of frequencies of which a lens leaves little
    codes = curve[::257]
    levels, widths = codes[1:-1].astype(np.float64), np.gradient(codes)[1:-1]
    variances = np.maximum((coarseness * widths) ** 2 / 12.0, 1e-16)
    design = np.stack([levels, np.ones_like(levels)], axis=1) / variances[:, None]
    return NoiseModel(*map(float, optimize.nnls(design, np.ones_like(levels))[0]))


def graininess(plane: Plane, noise: NoiseModel, clip: float = 1.0) -> float:
    """Variance of means over 4 x 4 flat pixels, times 16, over that of the pixels: 1 for white noise.

    Demosaicing leaves 6 to 9, a camera's own denoising 40 and more.
    """
    fine = _sampled(np.asarray(plane, dtype=np.float32))
    levels = np.quantile(fine[::GRAIN, ::GRAIN], _GRAIN_LEVELS)
    single = noise.variance(levels)
    several = estimate_noise(block_means(fine, GRAIN), clip).variance(levels)
    usable = (single > 0.0) & (several > 0.0)
    return float(np.exp(np.log(GRAIN**2 * several[usable] / single[usable]).mean())) if usable.any() else 1.0


def _sampled(plane: Plane) -> Plane:
    """Evenly spaced bands of rows of a large plane: more pixels would not change the fit."""
    band = 8 * BLOCK
    every = plane.size // _ENOUGH_PIXELS + 1
    bands = [plane[row : row + band] for row in range(0, plane.shape[0] - band + 1, every * band)]
    return np.concatenate(bands) if every > 1 and bands else plane


def _levels(plane: Plane, clip: float) -> NDArray[np.float64]:
    """Mean, variance and number of pixels of each level that was seen flat, shape (n, 3).

    Texture is judged on the low-passed plane and noise on the high-passed one, so that the choice does not
    favour blocks whose noise happens to be small.
    """
    low = ndimage.gaussian_filter(plane, 2.0, mode="nearest", truncate=3.0)
    blocks, high = _blocks(plane), _blocks(ndimage.convolve(plane, _HIGH_PASS, mode="nearest"))
    mean, texture = blocks.mean(axis=1, dtype=np.float64), _blocks(low).std(axis=1, dtype=np.float64)
    usable = (blocks.max(axis=1) < 0.98 * clip) & ((blocks <= 0).mean(axis=1) < 0.02)
    # Areas without any change, painted or clipped by a program, tell nothing about the sensor.
    usable = np.flatnonzero(usable & (np.ptp(high, axis=1) > 0))
    order, rows = usable[np.argsort(mean[usable])], list[tuple[float, float, int]]()
    levels = max(1, min(_BINS, len(order) // (4 * _MIN_BLOCKS)))
    for part in np.array_split(order, levels) if len(order) >= _MIN_BLOCKS else []:
        keep = max(_MIN_BLOCKS, int(_FLAT_SHARE * len(part)))
        flat = part[np.argsort(texture[part])[:keep]]
        sigma = _scale(high[flat])
        if sigma > 0:  # else most differences are exactly 0: rounding or compression ate the noise
            rows.append((float(mean[flat].mean()), sigma * sigma, high[flat].size))
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _scale(values: NDArray[np.float32]) -> float:
    """Robust standard deviation: the s for which the mean of min(v^2, (1.5 s)^2) is that of a normal v.

    P. J. Huber, "Robust estimation of a location parameter", Ann. Math. Stat. 35, 1964, proposal 2.
    """
    # a median of a camera's 8-bit differences jumps by a factor of 2 where the noise is half a step
    power = np.square(values, dtype=np.float32).ravel()
    sigma = _MAD_TO_SIGMA * float(np.sqrt(np.median(power)))
    for _ in range(20):
        before, clipped = sigma, np.minimum(power, np.float32((_CUT * sigma) ** 2))
        sigma = float(np.sqrt(clipped.mean(dtype=np.float64) / _CUT_POWER))
        if abs(sigma - before) <= 1e-3 * before:
            break
    return sigma


def _blocks(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    rows, cols = (side // BLOCK for side in plane.shape)
    cut = plane[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK)
    return np.ascontiguousarray(cut.swapaxes(1, 2)).reshape(rows * cols, BLOCK * BLOCK)


def _line(
    levels: NDArray[np.float64], variances: NDArray[np.float64], counts: NDArray[np.float64]
) -> tuple[float, float]:
    """Slope and offset of a line through the levels, robust against those where no place is flat."""
    # The error of a variance is proportional to the variance, so the weights are count / var^2; texture only
    # ever adds, so points above the line lose weight, those below do not. `chance` is three standard errors
    # of a variance from the median deviation of pixels, every second independent after the high-pass.
    chance = 3.0 * np.sqrt(2.7 * 2.0 * 2.0 / counts)
    trust, model = np.ones_like(levels), np.maximum(variances, 1e-16)
    slope = offset = 0.0
    for _ in range(12):
        weight = np.sqrt(counts * trust) / np.maximum(model, 1e-16)
        slope, offset = optimize.nnls(np.stack([levels * weight, weight], axis=1), variances * weight)[0]
        model = np.maximum(slope * levels + offset, 1e-16)
        trust = np.minimum(1.0, chance / np.maximum((variances - model) / model, chance)) ** 2
    return float(slope), float(offset)


# --- the mosaic, before demosaicing -------------------------------------------------------------

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
