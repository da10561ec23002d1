"""Straight slanted edges of a chart, found without being told where they are.

First on a grid, in means of 4 x 4 pixels: windows whose structure tensor J says that all gradients
point one way, and not along the grid,

    coherence = sqrt((Jxx - Jyy)² + 4 Jxy²) / (Jxx + Jyy),

and whose gradients lie on one line. Such windows form runs, one along each edge. Then, strongest first, in
the middle of each run at full size: unclipped, flat on both sides, and explained by its own edge profile to
a few percent of the step. Photos of anything but a chart hardly ever have such windows.

Source of the structure tensor: J. Bigun, G. H. Granlund, "Optimal orientation detection of linear
symmetry", ICCV 1987.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import LensModelError
from lensmodel.core.geometry import block_means
from lensmodel.core.types import NoiseModel
from lensmodel.quality.mtf import Box, EdgeResponse, slanted_edge

SIDES: Final = (128, 96, 64)
"""Sides of a window in pixels: the largest that holds the edge and nothing else is taken."""

LEAST_ON_A_CHART: Final = 4
"""Edges that a photo must have, along its rows and along its columns: other scenes have one or two."""

_MEAN: Final = 4  # pixels along the side of a mean
_WINDOW: Final = SIDES[-1] // _MEAN  # of the smallest crop, in means of pixels
_STRIDE: Final = _WINDOW // 4  # a quarter of a window: no edge is missed between two (chosen)
_LEAST_STEP: Final = 0.02  # of full scale
_LEAST_COHERENCE: Final = 0.9  # of the structure tensor: one straight edge and nothing else (chosen)
# ISO 12233 wants slants; along pixels and diagonals the super-sampling fails
_LEAST_SLANT, _MOST_SLANT = math.radians(2.0), math.radians(43.0)
_NARROW: Final = 0.2  # scatter of the gradients across the edge, in sides of a window
_BESIDE: Final = 0.05  # of the squared gradients, further from the edge than a quarter of a window
_MOST: Final = 1 << 16  # windows of the grid that are looked at more closely
_CHUNK: Final = 4096  # of them at once, for memory
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
    # (row, col), of the straight part that was seen; corners lie up to half a window further out
    ends: tuple[tuple[float, float], tuple[float, float]]

    @property
    def middle(self) -> tuple[float, float]:
        """Middle of the box, (row, col)."""
        row, col, height, width = self.box
        return row + (height - 1) / 2.0, col + (width - 1) / 2.0


@dataclass(frozen=True, slots=True, eq=False)
class _Segment:
    """Windows along one edge: its middle, its unit direction, (row, col), and half its length, pixels."""

    middle: NDArray[np.float64]
    along: NDArray[np.float64]
    half: float

    def at(self, share: float) -> tuple[float, float]:
        """The point at a share of the half length from the middle."""
        row, col = (self.middle + share * self.half * self.along).tolist()
        return row, col


def find_edges(
    plane: NDArray[np.floating], *, noise: NoiseModel = _SILENT, clip: float = 1.0
) -> tuple[FoundEdge, ...]:
    """Find straight slanted edges with flat ground on both sides, as charts have them.

    Each is given once, by the largest box in its middle that holds nothing else; none where there are fewer
    than four, or none across the others: such a photo shows no chart.
    """
    if min(plane.shape) < SIDES[-1]:
        return ()
    found: list[FoundEdge] = []
    with np.errstate(all="ignore"):  # light beyond what float32 can square is no edge
        segments = _segments(block_means(np.asarray(plane, dtype=np.float32), _MEAN))
    for number, segment in enumerate(segments[:_TRIED]):
        if number == _FIRST and len(found) < LEAST_ON_A_CHART:
            return ()
        if (edge := _edge_on(plane, segment, noise, clip)) is not None:
            found.append(edge)
    usual = float(np.median([edge.response.step for edge in found])) if found else 0.0
    edges = tuple(edge for edge in found if edge.response.step > _LEAST_OF_USUAL * usual)
    upright = [abs(math.cos(edge.response.normal)) > math.sqrt(0.5) for edge in edges]
    chart = len(edges) >= LEAST_ON_A_CHART and any(upright) and not all(upright)
    return edges if chart else ()


def _edge_on(
    plane: NDArray[np.floating], segment: _Segment, noise: NoiseModel, clip: float
) -> FoundEdge | None:
    """Measure an edge in its middle, or beside it where the middle is spoilt."""
    for share in (0.0, -0.5, 0.5):
        row, col = segment.at(share)
        for side in SIDES:
            top, left = round(row) - side // 2, round(col) - side // 2
            if min(top, left) < 0 or top + side > plane.shape[0] or left + side > plane.shape[1]:
                continue
            response = _edge_of(plane[top : top + side, left : left + side], noise, clip)
            if response is not None:
                return FoundEdge((top, left, side, side), response, (segment.at(-1.0), segment.at(1.0)))
    return None


def _segments(means: NDArray[np.float32]) -> list[_Segment]:
    """Edges as runs of windows that each hold one straight edge and nothing else, strongest first."""
    across = np.zeros_like(means)
    down = np.zeros_like(means)
    across[:, 1:-1] = (means[:, 2:] - means[:, :-2]) / 2
    down[1:-1] = (means[2:] - means[:-2]) / 2
    xx, yy, xy = (_sums(product) for product in (across * across, down * down, across * down))
    energy = xx + yy
    coherence = np.hypot(xx - yy, 2 * xy) / np.maximum(energy, np.finfo(np.float32).tiny)
    angle = np.arctan2(2 * xy, xx - yy) / 2  # of the normal; rows count downwards
    slant = np.abs((angle + np.pi / 4) % (np.pi / 2) - np.pi / 4)
    # A step s that is spread over w means makes s² / w in each of the lines it crosses, w <= half a window.
    strong = energy > 2 * _LEAST_STEP**2
    good = strong & (coherence > _LEAST_COHERENCE) & (slant > _LEAST_SLANT) & (slant < _MOST_SLANT)
    order = np.flatnonzero(good)
    order = order[np.argsort(-energy.ravel()[order], kind="stable")][:_MOST]
    middles = np.full((*energy.shape, 2), np.nan)
    rising = np.zeros(energy.shape, dtype=np.int8)
    for start in range(0, order.size, _CHUNK):
        part = order[start : start + _CHUNK]
        index = np.unravel_index(part, energy.shape)
        kept, middle, sign = _on_one_line(across, down, index, angle.ravel()[part])
        kind = np.where(np.abs(np.cos(angle.ravel()[part])) > math.sqrt(0.5), 1, 2) * sign
        rising[index[0][kept], index[1][kept]] = kind[kept]
        middles[index[0][kept], index[1][kept]] = middle[kept]
    found: list[tuple[float, _Segment]] = []
    for each in (-2, -1, 1, 2):
        labels, _ = ndimage.label(rising == each, structure=np.ones((3, 3)))
        for number, where in enumerate(ndimage.find_objects(labels), start=1):
            own = labels[where] == number
            found.append((float(energy[where][own].sum()), _segment(middles[where][own])))
    return [segment for _, segment in sorted(found, key=lambda pair: -pair[0])]


def _on_one_line(
    across: NDArray[np.float32],
    down: NDArray[np.float32],
    index: tuple[NDArray[np.intp], ...],
    normal: NDArray[np.float32],
) -> tuple[NDArray[np.bool_], NDArray[np.float64], NDArray[np.intp]]:
    """Whether the gradients of windows lie on one line, where it passes their middles, and its sign."""
    rows, cols = (i * _STRIDE for i in index)
    views = [sliding_window_view(g, (_WINDOW, _WINDOW))[rows, cols] for g in (across, down)]
    weight = np.square(views[0]) + np.square(views[1])
    place = np.arange(_WINDOW, dtype=np.float32) - (_WINDOW - 1) / 2
    cos, sin = np.cos(normal), np.sin(normal)
    distance = cos[:, None, None] * place + sin[:, None, None] * place[:, None]
    total = weight.sum(axis=(1, 2))
    offset = (weight * distance).sum(axis=(1, 2)) / total
    across_it = np.abs(distance - offset[:, None, None])
    scatter = np.sqrt((weight * np.square(across_it)).sum(axis=(1, 2)) / total)
    beside = np.where(across_it > _WINDOW / 4, weight, 0.0).sum(axis=(1, 2)) / total
    kept = (scatter < _NARROW * _WINDOW) & (np.abs(offset) < _WINDOW / 4) & (beside < _BESIDE)
    middle = np.stack([rows + _WINDOW / 2 + offset * sin, cols + _WINDOW / 2 + offset * cos], axis=1) * _MEAN
    slope = cos * views[0].sum(axis=(1, 2)) + sin * views[1].sum(axis=(1, 2))
    return kept, middle, np.where(slope >= 0.0, 1, -1)


def _segment(points: NDArray[np.float64]) -> _Segment:
    """Line through the middles of windows along one edge."""
    center = points.mean(axis=0)
    along = np.linalg.svd(points - center)[2][0] if len(points) > 1 else np.array([1.0, 0.0])
    place = (points - center) @ along
    low, high = float(place.min()), float(place.max())
    return _Segment(center + (low + high) / 2.0 * along, along, (high - low) / 2.0)


def _sums(plane: NDArray[np.float32]) -> NDArray[np.float32]:
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


def _holds_nothing_else(crop: NDArray[np.float64], response: EdgeResponse, noise: NoiseModel) -> bool:
    """Whether an edge stands out, leans, is no wider than a third of its window, and explains it."""
    step, esf = response.step, response.esf
    known = (response.mtf50, response.overshoot, response.undershoot, step, response.normal)
    if not all(map(math.isfinite, known)) or step < _LEAST_STEP:
        return False
    slant = math.radians(response.angle_deg)
    if not _LEAST_SLANT <= slant <= _MOST_SLANT or max(response.overshoot, response.undershoot) > _OVERSHOOT:
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


def _unexplained(crop: NDArray[np.float64], normal: float) -> NDArray[np.float64]:
    """What is left of a window after its mean profile along the normal."""
    rows, cols = np.indices(crop.shape)
    distance = cols * math.cos(normal) - rows * math.sin(normal)
    place = (distance - distance.min()) * 2
    index = np.floor(place).astype(np.intp)
    count = np.bincount(index.ravel(), minlength=index.max() + 2)
    middle = np.bincount(index.ravel(), weights=place.ravel(), minlength=count.size)
    total = np.bincount(index.ravel(), weights=crop.ravel(), minlength=count.size)
    filled = count > 0
    return crop - np.interp(place, middle[filled] / count[filled], total[filled] / count[filled])
