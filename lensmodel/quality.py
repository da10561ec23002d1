"""Sharpness: MTF of slanted edges (ISO 12233 e-SFR) and of kernels, and the edges of a chart found unaided.

Steps, for an edge that crosses the rows; others are turned first:

1. signed derivative of every row (of |d| noise would pull the line), Hamming window on the edge, centroid;
2. straight line through the centroids, second pass with windows that follow the line;
3. distance of every pixel to the edge along its normal, t = (x - c(row)) cos(theta);
4. mean in bins of 1/4 pixel: the edge spread function, oversampled 4 times;
5. central difference, Hamming window on its peak, |DFT|, 1 at zero frequency;
6. division by the response of the difference, sin(2 pi f / 4) / (2 pi f / 4), and of the bins,
   sin(pi f / 4) / (pi f / 4).

Edges are found in means of 4 x 4 pixels: runs of windows whose structure tensor J says that all gradients
point one way, and not along the grid, coherence = sqrt((Jxx - Jyy)² + 4 Jxy²) / (Jxx + Jyy), and whose
gradients lie on one line; then, strongest first, in the middle of each run at full size: unclipped, flat on
both sides, and explained by its own edge profile to a few percent of the step.

Sources: ISO 12233:2017, annex D; P. D. Burns, "Slanted-edge MTF for digital camera and scanner analysis",
IS&T PICS 2000; J. Bigun, G. H. Granlund, "Optimal orientation detection of linear symmetry", ICCV 1987.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError, LensModelError, NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Kernel, NoiseModel, block_means

Array: TypeAlias = NDArray[np.float64]
Box = tuple[int, int, int, int]  # (row, col, height, width) in pixels of the frame

OVERSAMPLING: Final = 4  # bins a pixel of the edge spread function
_MIN_SIDE: Final = 16  # pixels (chosen): over it an edge of 2 degrees moves by half a pixel
_MIN_ROWS: Final = 10  # that a line is fitted to: fewer do not tell which of them is off (chosen)
_REACH: Final = 48.0  # pixels of edge spread on each side; more only adds noise
_MAX_CORRECTION: Final = 10.0  # ISO 12233: limit of the division by the difference's response
_LENGTH: Final = 2048  # of its Fourier transform: several times a profile, fine enough to interpolate
_MIN_STEP_OVER_NOISE: Final = 3.0  # standard deviations: weaker steps are noise (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class EdgeResponse:
    """What one slanted edge says about the sharpness across it."""

    frequencies: Array  # (n,), cycles/pixel along the normal of the edge, 0 to 1
    mtf: Array  # (n,), contrast, 1 at zero frequency
    mtf50: float  # lowest frequency where the contrast falls to a half; 1.0 where it does not fall so far
    overshoot: float  # how far the edge profile leaves its bright or its dark level, in percent of the step
    normal: float  # angle of the normal from dark to bright, radians, counter-clockwise from the right
    offset: float  # pixels along the normal from the middle of the crop to the edge
    step: float  # bright minus dark level
    esf_distance: Array  # (m,), edge profile: distance in pixels, dark to bright, and level
    esf: Array

    @property
    def angle_deg(self) -> float:
        """Slant: angle in degrees between the edge and the nearer of row and column axis, 0 to 45."""
        folded = abs(math.degrees(self.normal)) % 90.0
        return min(folded, 90.0 - folded)


def crossing(frequencies: ArrayLike, contrast: ArrayLike, level: float) -> float:
    """First frequency where `contrast` falls to `level`, linearly interpolated; the last if never."""
    f, c = np.asarray(frequencies, dtype=np.float64), np.asarray(contrast, dtype=np.float64)
    below = 1 + np.flatnonzero(c[1:] < level)
    if not below.size:
        return float(f[-1])
    i = int(below[0])
    share = (c[i - 1] - level) / (c[i - 1] - c[i])
    return float(f[i - 1] + share * (f[i] - f[i - 1]))


def edge_area(rows: NDArray[np.floating], cols: NDArray[np.floating], normal: float) -> Array:
    """Share of each unit pixel on the bright side of an edge through the origin.

    A square seen along the normal is a trapezoid, the box of width a = |cos| convolved with that
    of width b = |sin|; its integral up to the pixel's distance d from the edge is exact::

        F(d) = [(d + p)+^2 - (d + m)+^2 - (d - m)+^2 + (d - p)+^2] / (2 a b)
        p = (a + b) / 2,  m = |a - b| / 2
    """
    distance = np.asarray(cols) * math.cos(normal) - np.asarray(rows) * math.sin(normal)
    a, b = abs(math.cos(normal)), abs(math.sin(normal))
    if min(a, b) < 1e-9:  # along the grid the trapezoid is a box
        return np.clip(distance + 0.5, 0.0, 1.0)
    p, m = (a + b) / 2.0, abs(a - b) / 2.0

    def squared(x: NDArray[np.floating]) -> Array:
        return np.square(np.maximum(x, 0.0))

    area = squared(distance + p) - squared(distance + m) - squared(distance - m) + squared(distance - p)
    return np.clip(area / (2.0 * a * b), 0.0, 1.0)


def slanted_edge(plane: NDArray[np.floating], measured: NDArray[np.bool_] | None = None) -> EdgeResponse:
    """Measure one slanted edge, near-vertical or near-horizontal, either side bright.

    80 x 60 pixels or more are recommended; the edge should lean 2 to 10 degrees, or more as long as it stays
    clear of 45. Of a mosaic, `measured` says which pixels the profile is taken from: what demosaicing fills
    in has the sharpness of the other colours.
    """
    crop = np.asarray(plane, dtype=np.float64)
    if crop.ndim != 2 or min(crop.shape) < _MIN_SIDE or not np.isfinite(crop).all():
        raise InvalidInputError(
            f"an edge needs a finite crop of {_MIN_SIDE} x {_MIN_SIDE} pixels or more, got {crop.shape}"
        )
    smooth = ndimage.uniform_filter(crop, 5)[2:-2, 2:-2]
    down, across = (float(np.square(np.diff(smooth, axis=axis)).mean()) for axis in (0, 1))
    turned = down > across  # the edge lies: it is steep from row to row
    upright = crop.T if turned else crop
    intercept, slope, sign = _edge_line(upright)
    # normal of the edge in the upright crop, towards the bright side
    d_col, d_row = sign * np.array([1.0, -slope]) / math.hypot(1.0, slope)
    rows, cols = upright.shape
    x = np.arange(cols) - (intercept + slope * np.arange(rows)[:, None])
    used = np.ones(crop.shape, dtype=np.bool_) if measured is None else measured
    distance, esf = _profile(x * d_col, upright, used.T if turned else used)
    middle = (cols - 1) / 2.0 - (intercept + slope * (rows - 1) / 2.0)
    frequencies, mtf = _spectrum(esf)
    dark, bright = _levels(distance, esf)
    step = bright - dark
    return EdgeResponse(
        frequencies=frequencies,
        mtf=mtf,
        mtf50=crossing(frequencies, mtf, 0.5),
        overshoot=max(float(esf.max()) - bright, dark - float(esf.min()), 0.0) / step * 100.0,
        normal=math.atan2(-d_col, d_row) if turned else math.atan2(-d_row, d_col),
        offset=float(-middle * d_col),
        step=step,
        esf_distance=distance,
        esf=esf,
    )


def _edge_line(crop: Array) -> tuple[float, float, float]:
    """Line c(row) = intercept + slope row of a near-vertical edge; and +1 if bright is on the right."""
    rows, cols = crop.shape
    derivative = (crop[:, 2:] - crop[:, :-2]) / 2.0
    x, y = np.arange(1.0, cols - 1.0), np.arange(float(rows))
    quarter = max(cols // 4, 2)
    sign = 1.0 if crop[:, -quarter:].mean() >= crop[:, :quarter].mean() else -1.0
    # first windows: where the smoothed derivative of each row is largest, not blindly the middle,
    # because a strongly leaning edge is far from it in the outer rows
    smooth = sliding_window_view(np.pad(sign * derivative, ((0, 0), (4, 4))), 9, axis=1).mean(axis=2)
    intercept, slope = _robust_line(y, x[smooth.argmax(axis=1)])
    for half in (cols / 4.0, 12.0, 12.0):
        reach = max(min(half, cols / 2.0 - 2.0), 4.0)
        center = intercept + slope * y
        used = (center - reach >= 0.0) & (center + reach <= cols - 1.0)
        if used.sum() < _MIN_ROWS:
            used = (center >= 4.0) & (center <= cols - 5.0)
        if used.sum() < _MIN_ROWS:
            raise NotEnoughEvidenceError(
                "the edge leaves the crop after a few rows; crop it so that it runs through the middle"
            )
        offset = x[None, :] - center[:, None]
        window = np.where(np.abs(offset) <= reach, 0.54 + 0.46 * np.cos(np.pi * offset / reach), 0.0)
        weight = sign * derivative * window
        total = weight.sum(axis=1)
        good = used & (total > 0.2 * np.median(total[used]))
        if good.sum() < _MIN_ROWS:
            raise NotEnoughEvidenceError(
                "no edge stands out of the noise; crop one straight high-contrast edge"
            )
        centroid = (weight * x).sum(axis=1)[good] / total[good]
        slope, intercept = np.polyfit(y[good], centroid, 1)
    return float(intercept), float(slope), sign


def _robust_line(y: Array, x: Array) -> tuple[float, float]:
    """Line through points with outliers: median of the slopes of far pairs (Theil and Sen)."""
    half = y.size // 2
    slope = float(np.median((x[half:] - x[: x.size - half]) / (y[half:] - y[: y.size - half])))
    return float(np.median(x - slope * y)), slope


def _profile(distance: Array, crop: Array, used: NDArray[np.bool_]) -> tuple[Array, Array]:
    """Mean level in bins of a quarter pixel of the distance, as far as both sides are well filled."""
    bins = np.floor(distance * OVERSAMPLING + 0.5).astype(np.intp)
    limit = round(_REACH * OVERSAMPLING)
    inside = used & (np.abs(bins) <= limit)
    index = bins[inside] + limit
    count = np.bincount(index, minlength=2 * limit + 1)
    total = np.bincount(index, weights=crop[inside], minlength=2 * limit + 1)
    per_side = np.minimum(count[limit:], count[limit::-1])
    # where the crop ends, bins hold few pixels of few rows: leave them out
    full = np.convolve(per_side, np.ones(OVERSAMPLING), "same") >= 0.25 * OVERSAMPLING * np.median(
        per_side[: 4 * OVERSAMPLING]
    )
    reach = int(np.append(full, False).argmin()) - 2
    if reach < 6 * OVERSAMPLING:
        raise NotEnoughEvidenceError("fewer than six pixels of ground beside the edge; crop it wider")
    keep = slice(limit - reach, limit + reach + 1)
    count, total = count[keep], total[keep]
    filled = count > 0
    if filled.mean() < 0.7:
        raise NotEnoughEvidenceError(
            "the edge meets the pixel grid at too few phases; let it lean 2 to 10 degrees"
        )
    position = np.arange(-reach, reach + 1) / OVERSAMPLING
    esf = np.interp(position, position[filled], total[filled] / count[filled])
    dark, bright = _levels(position, esf)
    tail = max(esf.size // 6, 4)
    noise = math.sqrt((float(np.var(esf[:tail])) + float(np.var(esf[-tail:]))) / 2.0)
    if not bright - dark > _MIN_STEP_OVER_NOISE * noise:
        raise NotEnoughEvidenceError("no edge stands out of the noise; crop one straight high-contrast edge")
    return position, esf


def _levels(position: Array, esf: Array) -> tuple[float, float]:
    """Dark and bright level: mean over the outer third of each side."""
    outer = np.abs(position) > 2.0 / 3.0 * position[-1]
    return float(esf[outer & (position < 0)].mean()), float(esf[outer & (position > 0)].mean())


def _spectrum(esf: Array) -> tuple[Array, Array]:
    """MTF of an edge profile on frequencies from 0 to 1 cycles/pixel."""
    lsf = (esf[2:] - esf[:-2]) / 2.0
    t = np.arange(lsf.size)
    center = int(np.argmax(np.convolve(lsf, np.ones(OVERSAMPLING), "same")))
    reach = max(center, lsf.size - 1 - center) + 1.0
    spectrum = np.abs(np.fft.rfft(lsf * (0.54 + 0.46 * np.cos(np.pi * (t - center) / reach)), _LENGTH))
    frequencies = np.linspace(0.0, 1.0, _LENGTH // OVERSAMPLING + 1)
    known = np.sinc(2.0 * frequencies / OVERSAMPLING) * np.sinc(frequencies / OVERSAMPLING)
    mtf = spectrum[: frequencies.size] / spectrum[0] / np.maximum(known, 1.0 / _MAX_CORRECTION)
    return frequencies, mtf


def mtf_from_kernel(kernel: Kernel, angle: float, frequencies: ArrayLike) -> Array:
    """Contrast that a kernel leaves of waves whose normal has an angle, by frequency in cycles/pixel.

    It is the modulus of the transfer function along a line::

        MTF(f) = | sum k(row, col) exp(-2 pi i f (col cos(angle) - row sin(angle))) |

    At field angle phi, `phi` gives the tangential MTF (contrast along u), `phi + pi/2` the sagittal one.
    """
    k = as_kernel(kernel)
    f = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
    along_rows, along_cols = (_waves(f * step, k.shape[0]) for step in (math.sin(angle), -math.cos(angle)))
    # over rows, then over columns: a plan for all three factors would take longer than one frequency
    return np.abs(np.einsum("fc,fc->f", along_rows @ k, along_cols))


def _waves(frequencies: Array, side: int) -> NDArray[np.complex128]:
    """exp(2 pi i f t) at each pixel t of a side, 0 in the middle; one half is the conjugate of the other."""
    upward = np.exp(2j * np.pi * np.outer(frequencies, np.arange(1, side // 2 + 1)))
    return np.concatenate([upward[:, ::-1].conj(), np.ones((frequencies.size, 1)), upward], axis=1)


def mtf50_from_kernel(kernel: Kernel, angle: float) -> float:
    """Frequency in cycles/pixel where the contrast along `angle` falls to one half, 1.0 if never."""
    f = np.linspace(0.0, 1.0, 513)  # steps of 1/512
    return crossing(f, mtf_from_kernel(kernel, angle, f), 0.5)


# --- finding the edges ---

_SIDES: Final = (128, 96, 64)  # of a window in pixels: the largest that holds an edge alone is taken
# Edges that a photo must have, along its rows and along its columns: other scenes have one or two
_LEAST_ON_A_CHART: Final = 4
_MEAN: Final = 4  # pixels along the side of a mean
_WINDOW: Final = _SIDES[-1] // _MEAN  # of the smallest crop, in means of pixels
_STRIDE: Final = _WINDOW // 4  # a quarter of a window: no edge is missed between two (chosen)
_LEAST_STEP: Final = 0.02  # of full scale
_LEAST_COHERENCE: Final = 0.9  # of the structure tensor: one straight edge and nothing else (chosen)
# ISO 12233 wants slants; along pixels and diagonals the super-sampling fails
_LEAST_SLANT, _MOST_SLANT = math.radians(2.0), math.radians(43.0)
_NARROW: Final = 0.12  # scatter of the squared gradients across the edge, in sides of a window (chosen)
_TRIED: Final = 2000  # edges at full size: more than any chart has
_FIRST: Final = 60  # edges tried of which some must be a chart's, or the photo is none (chosen for time)
_LEAST_OF_USUAL: Final = 0.25  # of the median step: a fold or a shadow on the paper is no edge of the print
_UNEXPLAINED: Final = 0.02  # of the step, beyond what noise leaves
_UNEVEN: Final = 0.03  # of the step, along the ground of one side
_OVERSHOOT: Final = 15.0  # percent: cameras sharpen
_SILENT: Final = NoiseModel(0.0, 0.0)


@dataclass(frozen=True, slots=True, eq=False)
class FoundEdge:
    """One straight edge of a chart."""

    box: Box  # (row, col, height, width) of the window in its middle that was measured
    response: EdgeResponse  # what was measured there
    ends: Array  # (2, 2): row, col of both ends as seen; corners lie half a window further out

    @property
    def middle(self) -> tuple[float, float]:
        """Middle of the box, (row, col)."""
        row, col, height, width = self.box
        return row + (height - 1) / 2.0, col + (width - 1) / 2.0


def find_edges(
    plane: NDArray[np.floating], *, noise: NoiseModel = _SILENT, clip: float = 1.0
) -> tuple[FoundEdge, ...]:
    """Find straight slanted edges with flat ground on both sides, as charts have them.

    Each is given once, by the largest box in its middle that holds nothing else; none where there are fewer
    than four, or none across the others: such a photo shows no chart.
    """
    if min(plane.shape) < _SIDES[-1]:
        return ()
    found: list[FoundEdge] = []
    with np.errstate(all="ignore"):  # light beyond what float32 can square is no edge
        segments = _segments(block_means(np.asarray(plane, dtype=np.float32), _MEAN))
    for number, ends in enumerate(segments[:_TRIED]):
        if number == _FIRST and len(found) < _LEAST_ON_A_CHART:
            return ()
        if (edge := _edge_on(plane, ends, noise, clip)) is not None:
            found.append(edge)
    usual = float(np.median([edge.response.step for edge in found])) if found else 0.0
    edges = tuple(edge for edge in found if edge.response.step > _LEAST_OF_USUAL * usual)
    upright = [abs(math.cos(edge.response.normal)) > math.sqrt(0.5) for edge in edges]
    chart = len(edges) >= _LEAST_ON_A_CHART and any(upright) and not all(upright)
    return edges if chart else ()


def _edge_on(plane: NDArray[np.floating], ends: Array, noise: NoiseModel, clip: float) -> FoundEdge | None:
    """Measure an edge between two ends in its middle, or beside it where the middle is spoilt."""
    for share in (0.5, 0.25, 0.75):
        for side in _SIDES:
            top, left = (round(at) - side // 2 for at in ends[0] + share * (ends[1] - ends[0]))
            if min(top, left) < 0 or top + side > plane.shape[0] or left + side > plane.shape[1]:
                continue
            response = _edge_of(plane[top : top + side, left : left + side], noise, clip)
            if response is not None:
                return FoundEdge((top, left, side, side), response, ends)
    return None


def _segments(means: NDArray[np.float32]) -> list[Array]:
    """Ends of edges, as runs of windows that each hold one straight edge and no more, strongest first.

    Where the squared gradients of a window have their centre of mass its edge passes, and they scatter little
    across it.
    """
    across, down = np.zeros((2, *means.shape))
    across[:, 1:-1] = (means[:, 2:] - means[:, :-2]) / 2
    down[1:-1] = (means[2:] - means[:-2]) / 2
    weight = across * across + down * down
    x, y = np.arange(means.shape[1]), np.arange(means.shape[0])[:, None]
    energy = np.maximum(_sums(weight), np.finfo(np.float64).tiny)
    xx, xy, mean_x, mean_y, var_x, cov, var_y = (
        _sums(product) / energy
        for product in (
            across * across,
            across * down,
            *(weight * part for part in (x, y, x * x, x * y, y * y)),
        )
    )
    coherence = np.hypot(2 * xx - 1, 2 * xy)
    angle = np.arctan2(2 * xy, 2 * xx - 1) / 2  # of the normal; rows count downwards
    cos, sin = np.cos(angle), np.sin(angle)
    middle_y, middle_x = _STRIDE * np.indices(energy.shape) + (_WINDOW - 1) / 2
    offset = cos * (mean_x - middle_x) + sin * (mean_y - middle_y)
    var_x, cov, var_y = var_x - mean_x**2, cov - mean_x * mean_y, var_y - mean_y**2
    scatter = cos * cos * var_x + 2 * cos * sin * cov + sin * sin * var_y
    slant = np.abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    # A step s that is spread over w means makes s² / w in each of the lines it crosses, w <= half a window.
    kept = (energy > 2 * _LEAST_STEP**2) & (coherence > _LEAST_COHERENCE)
    kept &= (slant > _LEAST_SLANT) & (slant < _MOST_SLANT)
    kept &= (scatter < (_NARROW * _WINDOW) ** 2) & (np.abs(offset) < _WINDOW / 4)
    middles = np.stack([middle_y + 0.5 + offset * sin, middle_x + 0.5 + offset * cos], axis=-1) * _MEAN
    rises = cos * _sums(across) + sin * _sums(down) >= 0.0
    upright = np.abs(cos) > math.sqrt(0.5)
    found: list[tuple[float, Array]] = []
    for kind in (upright & rises, upright & ~rises, ~upright & rises, ~upright & ~rises):
        labels, _ = ndimage.label(kind & kept, structure=np.ones((3, 3)))
        for number, where in enumerate(ndimage.find_objects(labels), start=1):
            own = labels[where] == number
            found.append((float(energy[where][own].sum()), _ends(middles[where][own])))
    return [ends for _, ends in sorted(found, key=lambda pair: -pair[0])]


def _ends(points: Array) -> Array:
    """Ends of the line through the middles of windows along one edge."""
    center = points.mean(axis=0)
    along = np.linalg.svd(points - center)[2][0] if len(points) > 1 else np.array([1.0, 0.0])
    place = (points - center) @ along
    return center + np.array([[place.min()], [place.max()]]) * along


def _sums(plane: Array) -> Array:
    """Sums over windows, a quarter of a window apart."""
    blocks = _STRIDE**2 * block_means(plane, _STRIDE)
    return sliding_window_view(blocks, (_WINDOW // _STRIDE,) * 2).sum(axis=(2, 3))


def _edge_of(window: NDArray[np.floating], noise: NoiseModel, clip: float) -> EdgeResponse | None:
    """Measure a window that holds one straight edge between two flat grounds, and nothing else."""
    crop = np.asarray(window, dtype=np.float64)
    if not np.isfinite(crop).all() or crop.max() >= 0.98 * clip or np.mean(crop <= 0.0) > 0.01:
        return None
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a fit that is not determined is no edge either
            response = slanted_edge(crop)
    except (LensModelError, ArithmeticError, ValueError, IndexError):
        return None
    return response if _holds_nothing_else(crop, response, noise) else None


def _holds_nothing_else(crop: Array, response: EdgeResponse, noise: NoiseModel) -> bool:
    """Whether an edge stands out, leans, is no wider than a third of its window, and explains it."""
    step, esf = response.step, response.esf
    known = (response.mtf50, response.overshoot, step, response.normal)
    if not all(map(math.isfinite, known)) or step < _LEAST_STEP or response.overshoot > _OVERSHOOT:
        return False
    if not _LEAST_SLANT <= math.radians(response.angle_deg) <= _MOST_SLANT:
        return False
    level = (esf - esf.min()) / step
    rising = response.esf_distance[(level > 0.15) & (level < 0.85)]  # between the overshoots
    third = esf.size // 6
    grounds = (esf[: 2 * third], esf[-2 * third :])
    uneven = max(abs(float(ground[:third].mean() - ground[third:].mean())) for ground in grounds)
    if (rising.size and float(np.ptp(rising)) > min(crop.shape) / 3) or uneven > _UNEVEN * step:
        return False
    left = _unexplained(crop, response.normal)
    scatter = float(noise.variance(np.maximum(crop, 0.0)).mean())
    return (
        float(left.var()) < (_UNEXPLAINED * step) ** 2 + 2.0 * scatter
        # noise averages out over 8 x 8 pixels, what a photo shows besides the edge does not
        and float(block_means(left, 8).var()) < (_UNEXPLAINED / 2 * step) ** 2 + 4.0 * scatter / 64
    )


def _unexplained(crop: Array, normal: float) -> Array:
    """What is left of a window after its mean profile along the normal."""
    rows, cols = np.indices(crop.shape)
    distance = cols * math.cos(normal) - rows * math.sin(normal)
    place = (distance - distance.min()) * 2
    index = np.floor(place).astype(np.intp).ravel()
    count = np.bincount(index)
    filled = count > 0
    middle, level = (
        np.bincount(index, weights=each.ravel())[filled] / count[filled] for each in (place, crop)
    )
    return crop - np.interp(place, middle, level)
