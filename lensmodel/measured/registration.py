"""Where a reference lies in a photo: a homography, and what the lens bends beyond it.

    place in the reference = H(pixel) + sum_ij c_ij X^i Y^j,   i + j <= degree

with X, Y the pixel over half the diagonal of the frame, from its middle. The polynomial takes what a
plane seen through a perfect lens does not have: distortion, and the small turns of a tripod. Of a target, the
four discs give the first homography.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage, spatial

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.geometry import Frame

Places = tuple[NDArray[np.float64], NDArray[np.float64]]
# Radial distortion up to the fifth power of the radius: two coefficients and a decentred middle
DEGREE: Final = 5
_FEWEST_MATCHES: Final = 6  # points, twice as many as a polynomial of first order needs (chosen)
# Matches that lie so far from the smooth field of all others are wrong, those within a tenth pass in any
# case: less would drop good ones where nearly all are (chosen)
_TRUSTED_PX: Final = 1.0


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Pixels of a photo to places of a reference."""

    homography: NDArray[np.float64]  # (3, 3), of (row, col, 1) to the reference's (row, col, 1)
    bend: NDArray[np.float64]  # (terms, 2), polynomial in reference units
    frame: Frame  # of the photo

    @classmethod
    def of_homography(cls, homography: NDArray[np.float64], frame: Frame) -> Warp:
        """Return a warp without a bend."""
        return cls(homography, np.zeros((len(_powers(DEGREE)), 2)), frame)

    def __call__(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> Places:
        """Places of the reference that the pixels show."""
        r, c = np.asarray(rows, dtype=np.float64), np.asarray(cols, dtype=np.float64)
        h = self.homography
        below = h[2, 0] * r + h[2, 1] * c + h[2, 2]
        out = [(h[i, 0] * r + h[i, 1] * c + h[i, 2]) / below for i in range(2)]
        if self.bend.any():
            for value, terms in zip(self._basis(r, c), self.bend, strict=True):
                out = [axis + term * value for axis, term in zip(out, terms, strict=True)]
        return out[0], out[1]

    def _basis(self, rows: NDArray[np.float64], cols: NDArray[np.float64]) -> Iterator[NDArray[np.float64]]:
        """X^i Y^j for each of `_powers(DEGREE)`, one after the other."""
        middle, unit = self.frame.center, self.frame.half_diagonal
        x, y = ((place - m) / unit for place, m in zip((rows, cols), middle, strict=True))
        raised: list[list[NDArray[np.float64]]] = [[np.ones_like(axis)] for axis in (x, y)]
        for axis, powers in zip((x, y), raised, strict=True):
            for _ in range(DEGREE):
                powers.append(powers[-1] * axis)  # several times as fast as axis**k
        return (raised[0][i] * raised[1][j] for i, j in _powers(DEGREE))

    def scale(self, row: float, col: float) -> float:
        """How many units of the reference a pixel takes, along the axis where it takes most."""
        r, c = self(np.array([row + 0.5, row - 0.5, row, row]), np.array([col, col, col + 0.5, col - 0.5]))
        derivative = [[r[0] - r[1], r[2] - r[3]], [c[0] - c[1], c[2] - c[3]]]
        return float(np.linalg.norm(derivative, 2))

    def moved(self, pixels: NDArray[np.float64], shifts: NDArray[np.float64], degree: int) -> Warp:
        """Bend the warp so that the reference shows up `shifts` further in the photo at `pixels`."""
        wanted = np.stack(self(*(pixels - shifts).T), axis=-1) - np.stack(self(*pixels.T), axis=-1)
        powers = _powers(DEGREE)
        used = [i for i, power in enumerate(powers) if sum(power) <= degree]
        basis = np.stack(list(self._basis(*pixels.T)), axis=-1)[:, used]
        unit = self.scale(*self.frame.center)
        good = np.ones(len(pixels), dtype=bool)
        terms = np.zeros((len(used), 2))
        for _ in range(6):
            if good.sum() < max(_FEWEST_MATCHES, len(used)):
                raise NotEnoughEvidenceError(
                    f"only {int(good.sum())} places of the photo match the reference; photograph it flat, "
                    "in focus and without anything before it"
                )
            terms = np.asarray(np.linalg.lstsq(basis[good], wanted[good], rcond=None)[0])
            left = np.hypot(*(wanted - basis @ terms).T) / unit
            limit = max(3.0 * float(np.median(left[good])), 0.1 * _TRUSTED_PX)
            after = left <= limit
            if (after == good).all():
                break
            good = after
        bend = self.bend.copy()
        bend[used] += terms
        return replace(self, bend=bend)


def _powers(degree: int) -> list[tuple[int, int]]:
    return [(i, n - i) for n in range(degree + 1) for i in range(n + 1)]


def homography_of(from_: NDArray[np.float64], to: NDArray[np.float64]) -> NDArray[np.float64]:
    """Homography through four or more pairs of points `(n, 2)`, by the direct linear transform."""
    scale = np.abs(from_).max(), np.abs(to).max()
    rows = []
    for (r, c), (y, x) in zip(from_ / scale[0], to / scale[1], strict=True):
        rows.append([r, c, 1, 0, 0, 0, -y * r, -y * c, -y])
        rows.append([0, 0, 0, r, c, 1, -x * r, -x * c, -x])
    h = np.linalg.svd(np.asarray(rows))[2][-1].reshape(3, 3)
    h = np.diag([scale[1], scale[1], 1.0]) @ h @ np.diag([1 / scale[0], 1 / scale[0], 1.0])
    return np.asarray(h / h[2, 2])


@dataclass(frozen=True, slots=True)
class Match:
    """Where one picture lies in another: the shift (row, col) and how far its peak stands out."""

    shift: tuple[float, float]
    clarity: float


def match(photo: NDArray[np.floating], reference: NDArray[np.floating]) -> Match:
    """Find how far the picture of `photo` lies beyond that of `reference`, in pixels.

    The cross power spectrum is divided by the reference's own amplitude, not by both: blur that
    differs between the two turns then no noise into signal. The peak is refined by a parabola.
    """
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in photo.shape))
    a = fft.rfft2((photo - photo.mean()) * window)
    b = fft.rfft2((reference - reference.mean()) * window)
    amplitude = np.abs(b)
    cross = a * np.conj(b) / np.maximum(amplitude, 0.1 * float(np.median(amplitude)) + 1e-12)
    surface = fft.irfft2(cross, s=photo.shape)
    peak = np.unravel_index(int(surface.argmax()), surface.shape)
    shift = []
    for axis, at in enumerate(peak):
        length = surface.shape[axis]
        index = list(peak)
        values = []
        for step in (-1, 0, 1):
            index[axis] = (at + step) % length
            values.append(float(surface[tuple(index)]))
        below = values[0] - 2.0 * values[1] + values[2]
        part = 0.0 if below >= 0 else 0.5 * (values[0] - values[2]) / below
        shift.append((at + length // 2) % length - length // 2 + part)
    clarity = float(surface.max()) / max(float(surface.std()), 1e-12)
    return Match((shift[0], shift[1]), clarity)


# `render(warp, corner, shape)`: what a window of the photo shows, without blur
Render = Callable[[Warp, tuple[int, int], tuple[int, int]], NDArray[np.floating]]


def matched(
    warp: Warp,
    render: Render,
    plane: NDArray[np.floating],
    corners: list[tuple[int, int]],
    side: int,
    *,
    least_clarity: float,
    degree: int,
) -> Warp:
    """Bend a warp to the matches of all windows that are clear."""
    pixels, shifts = [], []
    for row, col in corners:
        shown = render(warp, (row, col), (side, side))
        matching = match(plane[row : row + side, col : col + side], shown)
        if matching.clarity >= least_clarity:
            pixels.append((row + (side - 1) / 2.0, col + (side - 1) / 2.0))
            shifts.append(matching.shift)
    if len(pixels) < _FEWEST_MATCHES:
        raise NotEnoughEvidenceError(
            f"only {len(pixels)} of {len(corners)} windows of the photo match the reference; photograph it "
            "flat, in focus and without anything before it"
        )
    most = max(d for d in range(degree + 1) if len(_powers(d)) * 2 <= max(len(pixels), 2))
    return warp.moved(np.array(pixels), np.array(shifts), most)


_LOOKED_AT: Final = 1000  # pixels along the long side: noise has turned to grey, discs are 15 across
# Of the surroundings' mean level, which is grey as the noise is (chosen: discs are black)
_DARK: Final = 0.45
# Area over that of the ellipse of the same second moments, 1 of an ellipse: noise frays discs, letters and
# corners have less (chosen)
_ROUND: Final = 0.85
_LEAST_PX: Final = 20  # area of a disc: below it no shape is seen (chosen)
_MOST_SHARE: Final = 0.004  # same, of the picture: a page that fills it has less than a tenth (chosen)
# Clearest discs that are looked at for the four marks: ten others in the picture do no harm, and their
# thousand choices of four are still quick (chosen)
_CANDIDATES: Final = 14
_ALIKE: Final = 4.0  # the largest disc over the smallest in area: a page seen very much aslant
# Least ratio of the light of paper and print: far more on any print, less on shadows and patterns (chosen)
_PAPER_OVER_DISC: Final = 2.0


def find_marks(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    """Find the middles of the discs, in order around the page, clockwise."""
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
    best: tuple[float, NDArray[np.float64]] | None = None
    for four in combinations(discs, 4):
        areas = [disc[2] for disc in four]
        hull = spatial.ConvexHull([disc[:2] for disc in four], qhull_options="QJ")
        if max(areas) > _ALIKE * min(areas) or len(hull.vertices) < 4:
            continue
        if best is None or hull.volume > best[0]:
            best = hull.volume, _clockwise(hull.points)
    if best is None or best[0] < 0.05 * small.size:
        raise NotEnoughEvidenceError(
            f"{len(discs)} corner discs of a target are seen, four are needed; the whole page must be in the "
            "photo, with its white border"
        )
    return np.asarray((best[1] + 0.5) * factor - 0.5, dtype=np.float64)


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
