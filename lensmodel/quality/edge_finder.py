"""Straight slanted edges of a chart, found without being told where they are.

First on a grid, in means of 4 x 4 pixels: windows whose structure tensor J says that all gradients
point one way, and not along the grid,

    coherence = sqrt((Jxx - Jyy)² + 4 Jxy²) / (Jxx + Jyy),

and whose gradients lie on one line. Then, strongest first, at full size: unclipped, flat on both
sides, and explained by its own edge profile to a few percent of the step. Photos of anything but a
chart hardly ever have such windows.

Source of the structure tensor: J. Bigun, G. H. Granlund, "Optimal orientation detection of linear
symmetry", ICCV 1987.
"""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from lensmodel.core.errors import LensModelError
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.types import ZONES, EdgeGain, NoiseModel, Zone
from lensmodel.quality.charts import Box
from lensmodel.quality.edge import EdgeResponse, slanted_edge

logger = logging.getLogger(__name__)

SIDES: Final = (64, 96, 128)
"""Sides of a window in pixels: the largest that holds the edge and nothing else is taken."""

LEAST_EDGES: Final = 2
"""Edges that a zone must have: one says little."""

LEAST_ON_A_CHART: Final = 4
"""Edges that a photo must have, along its rows and along its columns: other scenes have one or two."""

_MEAN: Final = 4  # pixels along the side of a mean
_WINDOW: Final = SIDES[0] // _MEAN  # of the smallest crop, in means of pixels
_STRIDE: Final = _WINDOW // 4  # a quarter of a window: no edge is missed between two (chosen)
_STRIP: Final = 1024  # rows at once: no copy of the frame is made
_LEAST_STEP: Final = 0.02  # of full scale
_LEAST_COHERENCE: Final = 0.9  # of the structure tensor: one straight edge and nothing else (chosen)
# ISO 12233 wants slants; along pixels and diagonals the super-sampling fails
_LEAST_SLANT, _MOST_SLANT = math.radians(2.0), math.radians(43.0)
_NARROW: Final = 0.2  # scatter of the gradients across the edge, in sides of a window
_BESIDE: Final = 0.05  # of the squared gradients, further from the edge than a quarter of a window
_MOST: Final = 4096  # windows of the grid that are looked at more closely
_APART: Final = SIDES[0] // 2  # pixels between windows tried at full size
_ENOUGH, _TRIED = 12, 40  # edges wanted and windows tried at full size, in a zone
_UNEXPLAINED: Final = 0.02  # of the step, beyond what noise leaves
_UNEVEN: Final = 0.03  # of the step, along the ground of one side
_OVERSHOOT: Final = 15.0  # percent: cameras sharpen
_SILENT: Final = NoiseModel(0.0, 0.0)


def find_edges(
    plane: NDArray[np.floating],
    frame: Frame | None = None,
    *,
    origin: tuple[int, int] = (0, 0),
    noise: NoiseModel = _SILENT,
    clip: float = 1.0,
) -> tuple[Box, ...]:
    """Find straight slanted edges with flat ground on both sides, as charts have them.

    Parameters
    ----------
    plane : ndarray, shape (H, W)
        Linear light, finite; may be memory-mapped. It is read once, a strip at a time.
    frame : Frame, optional
        The whole frame, where `plane` is a part of it.
    origin : tuple of int
        Row and column of the frame at which `plane` begins.
    noise : NoiseModel
        Of the plane: so much the grounds may scatter.
    clip : float
        From this level on light is not measured.

    Returns
    -------
    tuple of (row, col, height, width)
        Boxes in pixels of `plane`, not overlapping, at most 12 in a zone of the frame. None where there
        are fewer than four, or none across the others: such a photo shows no chart.
    """
    if min(plane.shape) < SIDES[0]:
        return ()
    frame = frame or Frame(*plane.shape)
    taken: list[Box] = []
    upright: list[bool] = []
    tried: dict[tuple[int, int], tuple[int, int]] = {}
    accepted, looked = dict.fromkeys(ZONES, 0), dict.fromkeys(ZONES, 0)
    with np.errstate(all="ignore"):  # light beyond what float32 can square is no edge
        candidates = _candidates(_means(plane))
    for row, col in candidates:
        zone = zone_of(frame.position(origin[0] + row, origin[1] + col).r)
        if accepted[zone] == _ENOUGH or looked[zone] == _TRIED or _near(row, col, tried):
            continue
        looked[zone] += 1
        tried[row // _APART, col // _APART] = row, col
        best: tuple[Box, EdgeResponse] | None = None
        for side in SIDES:
            box = (row - side // 2, col - side // 2, side, side)
            if not _inside(box, plane.shape) or _meets(box, taken):
                break
            response = _edge_of(plane, box, noise, clip)
            if response is None:
                break
            best = box, response
        if best is not None:
            taken.append(best[0])
            upright.append(abs(math.cos(best[1].normal)) > math.sqrt(0.5))
            accepted[zone] += 1
    chart = len(taken) >= LEAST_ON_A_CHART and any(upright) and not all(upright)
    return tuple(taken) if chart else ()


def edge_gains(
    before: NDArray[np.floating],
    after: NDArray[np.floating],
    frame: Frame | None = None,
    *,
    origin: tuple[int, int] = (0, 0),
    noise: NoiseModel = _SILENT,
    clip: float = 1.0,
) -> dict[Zone, EdgeGain]:
    """Sharpness of a chart's edges before and after a correction, by zone of the frame.

    The edges are those that `find_edges` finds before the correction.
    """
    boxes = find_edges(before, frame, origin=origin, noise=noise, clip=clip)
    if not boxes:
        return {}
    frame = frame or Frame(*before.shape)
    rows: dict[Zone, list[tuple[float, float, float, float]]] = {zone: [] for zone in ZONES}
    for box in boxes:
        old, new = _measured(before, box), _measured(after, box)
        if old is None or new is None or old.mtf50 <= 0.0:
            continue
        middle = (origin[0] + box[0] + box[2] / 2, origin[1] + box[1] + box[3] / 2)
        ratio = new.mtf50 / old.mtf50
        rows[zone_of(frame.position(*middle).r)].append((old.mtf50, new.mtf50, ratio, new.overshoot))
    return {
        zone: EdgeGain(len(seen), *(float(value) for value in np.median(seen, axis=0)))
        for zone, seen in rows.items()
        if len(seen) >= LEAST_EDGES
    }


def _near(row: int, col: int, tried: Mapping[tuple[int, int], tuple[int, int]]) -> bool:
    """Whether a window as good as this one was tried."""
    cell = row // _APART, col // _APART
    for down in (-1, 0, 1):
        for right in (-1, 0, 1):
            other = tried.get((cell[0] + down, cell[1] + right))
            if other is not None and max(abs(row - other[0]), abs(col - other[1])) < _APART:
                return True
    return False


def _measured(plane: NDArray[np.floating], box: Box) -> EdgeResponse | None:
    row, col, height, width = box
    try:
        with np.errstate(all="ignore"), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a fit that is not determined is no edge either
            response = slanted_edge(plane[row : row + height, col : col + width])
    except (LensModelError, ArithmeticError, ValueError, IndexError) as error:
        logger.debug("no edge in box %s: %s", box, error)
        return None
    known = (response.mtf50, response.overshoot, response.undershoot, response.step, response.normal)
    return response if all(map(math.isfinite, known)) else None


def _means(plane: NDArray[np.floating]) -> NDArray[np.float32]:
    """Means of 4 x 4 pixels; what is left over at the end of a side is left out."""
    rows, cols = plane.shape[0] // _MEAN, plane.shape[1] // _MEAN
    out = np.empty((rows, cols), dtype=np.float32)
    for top in range(0, rows, _STRIP // _MEAN):
        bottom = min(top + _STRIP // _MEAN, rows)
        part = np.asarray(plane[top * _MEAN : bottom * _MEAN, : cols * _MEAN], dtype=np.float32)
        lines = part.reshape(bottom - top, _MEAN, cols * _MEAN).sum(axis=1)
        out[top:bottom] = sum(lines[:, shift::_MEAN] for shift in range(_MEAN))
    out /= _MEAN * _MEAN
    return out


def _candidates(means: NDArray[np.float32]) -> list[tuple[int, int]]:
    """Middles of windows that may hold an edge, as (row, col) in pixels, strongest first."""
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
    if order.size == 0:
        return []
    rows, cols = (index * _STRIDE for index in np.unravel_index(order, energy.shape))
    normal = angle.ravel()[order]
    views = [sliding_window_view(g, (_WINDOW, _WINDOW))[rows, cols] for g in (across, down)]
    weight = np.square(views[0]) + np.square(views[1])
    place = np.arange(_WINDOW, dtype=np.float32) - (_WINDOW - 1) / 2
    distance = np.cos(normal)[:, None, None] * place + np.sin(normal)[:, None, None] * place[:, None]
    total = weight.sum(axis=(1, 2))
    offset = (weight * distance).sum(axis=(1, 2)) / total
    scatter = np.sqrt((weight * np.square(distance - offset[:, None, None])).sum(axis=(1, 2)) / total)
    across_it = np.abs(distance - offset[:, None, None])
    beside = np.where(across_it > _WINDOW / 4, weight, 0.0).sum(axis=(1, 2)) / total
    one_line = (scatter < _NARROW * _WINDOW) & (np.abs(offset) < _WINDOW / 4) & (beside < _BESIDE)
    # The window is moved so that the edge runs through its middle.
    middle_row = (rows + _WINDOW / 2 + offset * np.sin(normal)) * _MEAN
    middle_col = (cols + _WINDOW / 2 + offset * np.cos(normal)) * _MEAN
    return [(round(r), round(c)) for r, c in zip(middle_row[one_line], middle_col[one_line], strict=True)]


def _sums(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums over windows, a quarter of a window apart."""
    rows, cols = (length // _STRIDE for length in plane.shape)
    blocks = plane[: rows * _STRIDE, : cols * _STRIDE].reshape(rows, _STRIDE, cols, _STRIDE).sum(axis=(1, 3))
    parts = _WINDOW // _STRIDE
    return np.asarray(sliding_window_view(blocks, (parts, parts)).sum(axis=(2, 3)), dtype=np.float32)


def _inside(box: Box, shape: tuple[int, ...]) -> bool:
    row, col, height, width = box
    return row >= 0 and col >= 0 and row + height <= shape[0] and col + width <= shape[1]


def _meets(box: Box, others: Sequence[Box]) -> bool:
    row, col, height, width = box
    return any(r < row + height and row < r + h and c < col + width and col < c + w for r, c, h, w in others)


def _edge_of(plane: NDArray[np.floating], box: Box, noise: NoiseModel, clip: float) -> EdgeResponse | None:
    """Measure a window that holds one straight edge between two flat grounds, and nothing else."""
    row, col, height, width = box
    crop = np.asarray(plane[row : row + height, col : col + width], dtype=np.float64)
    if not np.isfinite(crop).all() or crop.max() >= 0.98 * clip or np.mean(crop <= 0.0) > 0.01:
        return None
    response = _measured(plane, box)
    if response is None or response.step < _LEAST_STEP:
        return None
    slant = math.radians(response.angle_deg)
    if not _LEAST_SLANT <= slant <= _MOST_SLANT or max(response.overshoot, response.undershoot) > _OVERSHOOT:
        return None
    step = response.step
    level = (response.esf - response.esf.min()) / step
    rising = response.esf_distance[(level > 0.15) & (level < 0.85)]  # between the overshoots
    if rising.size and float(np.ptp(rising)) > min(height, width) / 3:
        return None
    third = response.esf.size // 6
    for ground in (response.esf[: 2 * third], response.esf[-2 * third :]):
        halves = ground[:third].mean() - ground[third:].mean()
        if abs(float(halves)) > _UNEVEN * step:
            return None
    left = _unexplained(crop, response.normal)
    scatter = float(noise.variance(np.maximum(crop, 0.0)).mean())
    explained = (
        float(left.var()) < (_UNEXPLAINED * step) ** 2 + 2.0 * scatter
        # noise averages out over 8 x 8 pixels, what a photo shows besides the edge does not
        and float(_coarse(left).var()) < (_UNEXPLAINED / 2 * step) ** 2 + 4.0 * scatter / 64
    )
    return response if explained else None


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


def _coarse(plane: NDArray[np.float64]) -> NDArray[np.float64]:
    rows, cols = plane.shape[0] // 8, plane.shape[1] // 8
    return plane[: rows * 8, : cols * 8].reshape(rows, 8, cols, 8).mean(axis=(1, 3))
