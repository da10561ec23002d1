"""The four discs of a target in a photo."""

from __future__ import annotations

import math
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import NotEnoughEvidenceError

_LOOKED_AT: Final = 1000  # pixels along the long side: noise has turned to grey, discs are 15 across
# Of the surroundings' mean level, which is grey as the noise is (chosen: discs are black)
_DARK: Final = 0.45
_ROUND: Final = 0.85
"""Area over that of the ellipse of the same second moments, 1 of an ellipse: noise frays discs, letters and
corners have less (chosen)."""
_LEAST_PX: Final = 20  # area of a disc: below it no shape is seen (chosen)
_MOST_SHARE: Final = 0.004  # same, of the picture: a page that fills it has less than a tenth (chosen)
_CANDIDATES: Final = 14
"""Clearest discs that are looked at for the four marks: ten others in the picture do no harm, and their
thousand choices of four are still quick (chosen)."""
_ALIKE: Final = 4.0  # the largest disc over the smallest in area: a page seen very much aslant
_PAPER_OVER_DISC: Final = 2.0
"""Least ratio of the light of paper and print: far more on any print, less on shadows and patterns
(chosen)."""


def find_marks(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    """Find the middles of the discs, in order around the page, clockwise.

    Parameters
    ----------
    plane : ndarray, shape (H, W)
        Linear light.

    Returns
    -------
    ndarray, shape (4, 2)
        (row, col); which of them is the page's top left is not known yet.

    Raises
    ------
    NotEnoughEvidenceError
        If there are not four of them.
    """
    factor = max(max(plane.shape) // _LOOKED_AT, 1)
    rows, cols = (n // factor for n in plane.shape)
    small = np.asarray(plane[: rows * factor, : cols * factor], dtype=np.float64)
    small = small.reshape(rows, factor, cols, factor).mean(axis=(1, 3))
    scale = max(small.shape) / _LOOKED_AT
    smooth = ndimage.gaussian_filter(small, 2.0 * scale)
    around = ndimage.gaussian_filter(small, 40.0 * scale)
    labels, count = ndimage.label(smooth < _DARK * around)
    discs = []
    for number, box in enumerate(ndimage.find_objects(labels, count), start=1):
        disc = _disc(labels[box] == number, small, box)
        if disc is not None:
            discs.append(disc)
    discs = sorted(discs, key=lambda disc: -disc[3])[:_CANDIDATES]
    best: tuple[float, list[tuple[float, float, float, float]]] | None = None
    for four in combinations(discs, 4):
        areas = [disc[2] for disc in four]
        quad = _clockwise(np.array([disc[:2] for disc in four]))
        if max(areas) > _ALIKE * min(areas) or not _convex(quad):
            continue
        size = _area(quad)
        if best is None or size > best[0]:
            best = size, list(four)
    if best is None or best[0] < 0.05 * small.size:
        raise NotEnoughEvidenceError(
            f"{len(discs)} corner discs of a target are seen, four are needed; the whole page must be in the "
            "photo, with its white border"
        )
    quad = _clockwise(np.array([disc[:2] for disc in best[1]]))
    return np.asarray((quad + 0.5) * factor - 0.5, dtype=np.float64)


def _disc(
    inside: NDArray[np.bool_], picture: NDArray[np.float64], box: tuple[slice, slice]
) -> tuple[float, float, float, float] | None:
    """Middle, area and clarity of a dark blob that is round and lies on white; else None."""
    area = float(inside.sum())
    if area < _LEAST_PX or area > _MOST_SHARE * picture.size:
        return None
    rows, cols = np.nonzero(inside)
    spread = np.cov(np.stack([rows, cols]), bias=True)
    ellipse = 4.0 * math.pi * math.sqrt(max(float(np.linalg.det(spread)), 0.0))
    if ellipse <= 0.0 or not _ROUND < area / ellipse < 1.0 / _ROUND:
        return None
    row, col = box[0].start + float(rows.mean()), box[1].start + float(cols.mean())
    radius = math.sqrt(area / math.pi)
    # the white square reaches twice as far as the disc
    away = np.arange(8) * math.pi / 4
    ring_r = np.rint(row + 1.55 * radius * np.sin(away)).astype(int)
    ring_c = np.rint(col + 1.55 * radius * np.cos(away)).astype(int)
    inner = (ring_r >= 0) & (ring_r < picture.shape[0]) & (ring_c >= 0) & (ring_c < picture.shape[1])
    if inner.sum() < 6:
        return None
    paper = float(np.median(picture[ring_r[inner], ring_c[inner]]))
    dark = float(np.median(picture[rows + box[0].start, cols + box[1].start]))
    clarity = paper / max(dark, 1e-6)
    return (row, col, area, clarity) if clarity > _PAPER_OVER_DISC else None


def _clockwise(points: NDArray[np.float64]) -> NDArray[np.float64]:
    middle = points.mean(axis=0)
    order = np.argsort(np.arctan2(points[:, 0] - middle[0], points[:, 1] - middle[1]))
    return np.asarray(points[order])


def _convex(quad: NDArray[np.float64]) -> bool:
    turns = []
    for i in range(4):
        a, b, c = quad[i], quad[(i + 1) % 4], quad[(i + 2) % 4]
        u, v = b - a, c - b
        turns.append(u[0] * v[1] - u[1] * v[0])
    return bool(np.all(np.array(turns) > 0) or np.all(np.array(turns) < 0))


def _area(quad: NDArray[np.float64]) -> float:
    r, c = quad.T
    return 0.5 * abs(float(np.dot(r, np.roll(c, -1)) - np.dot(c, np.roll(r, -1))))
