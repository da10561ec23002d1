"""Where a reference lies in a photo: a homography, and what the lens bends beyond it.

    place in the reference = H(pixel) + sum_ij c_ij X^i Y^j,   i + j <= degree

with X, Y the pixel over half the diagonal of the frame, from its middle. The polynomial takes what a
plane seen through a perfect lens does not have: distortion, and the small turns of a tripod. Of a target, the
four discs give the first homography.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Final

import numpy as np
from numpy.polynomial import polynomial
from numpy.typing import NDArray
from scipy import fft, ndimage, spatial

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import Frame, StepHook, block_means

Places = tuple[NDArray[np.float64], NDArray[np.float64]]
DEGREE: Final = 5  # radial distortion of two coefficients, and a decentred middle
_FEWEST_MATCHES: Final = 6  # points, twice as many as a polynomial of first order needs (chosen)
_TRUSTED_PX: Final = 0.1  # matches so near the field of all others pass: with less, good ones go (chosen)
CLEAR: Final = 8.0  # standard deviations of a peak: peaks of 10 000 lags of noise reach 4 to 5


@dataclass(frozen=True, slots=True, eq=False)
class Warp:
    """Pixels of a photo to places of a reference."""

    homography: NDArray[np.float64]  # (3, 3), of (row, col, 1) to the reference's (row, col, 1)
    frame: Frame  # of the photo
    # (DEGREE + 1, DEGREE + 1, 2), c_ij in reference units
    bend: NDArray[np.float64] = field(default_factory=lambda: np.zeros((DEGREE + 1, DEGREE + 1, 2)))

    def __call__(self, rows: NDArray[np.floating], cols: NDArray[np.floating]) -> Places:
        """Places of the reference that the pixels show."""
        r, c = np.asarray(rows, dtype=np.float64), np.asarray(cols, dtype=np.float64)
        y, x, below = (h[0] * r + h[1] * c + h[2] for h in self.homography)
        if not self.bend.any():
            return y / below, x / below
        down, across = polynomial.polyval2d(*self.unit(r, c), self.bend)
        return y / below + down, x / below + across

    def unit(self, rows: NDArray[np.float64], cols: NDArray[np.float64]) -> Places:
        """X and Y of the polynomial."""
        (row, col), unit = self.frame.center, self.frame.half_diagonal
        return (rows - row) / unit, (cols - col) / unit

    def scale(self, row: float, col: float) -> float:
        """How many units of the reference a pixel takes, along the axis where it takes most."""
        r, c = self(np.array([row + 0.5, row - 0.5, row, row]), np.array([col, col, col + 0.5, col - 0.5]))
        return float(np.linalg.norm([[r[0] - r[1], r[2] - r[3]], [c[0] - c[1], c[2] - c[3]]], 2))


def homography_of(from_: NDArray[np.float64], to: NDArray[np.float64]) -> NDArray[np.float64]:
    """Homography through four pairs of points `(4, 2)`."""
    rows = []
    for (r, c), (y, x) in zip(from_, to, strict=True):
        rows += [[r, c, 1, 0, 0, 0, -y * r, -y * c], [0, 0, 0, r, c, 1, -x * r, -x * c]]
    return np.append(np.linalg.solve(rows, to.ravel()), 1.0).reshape(3, 3)


def match(photo: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[tuple[float, float], float]:
    """Find how far (row, col) the picture of `photo` lies beyond that of `reference`, and how clearly.

    The cross power spectrum is divided by the reference's own amplitude, not by both: blur that
    differs between the two turns then no noise into signal. The peak is refined by a parabola.
    """
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in photo.shape))
    a, b = (fft.rfft2((picture - picture.mean()) * window) for picture in (photo, reference))
    amplitude = np.abs(b)
    cross = a * np.conj(b) / np.maximum(amplitude, 0.1 * float(np.median(amplitude)) + 1e-12)
    surface = fft.fftshift(fft.irfft2(cross, s=photo.shape))
    peak = np.unravel_index(int(surface.argmax()), surface.shape)
    shift = []
    for axis, at in enumerate(peak):
        line = np.moveaxis(surface, axis, 0)[:, peak[1 - axis]]
        before, top, after = (float(line[(at + step) % len(line)]) for step in (-1, 0, 1))
        bend = before - 2.0 * top + after
        shift.append(int(at) - len(line) // 2 + (0.5 * (before - after) / bend if bend < 0.0 else 0.0))
    return (shift[0], shift[1]), float(surface.max()) / max(float(surface.std()), 1e-12)


# `render(warp, corner, shape)`: what a window of the photo shows, without blur
Render = Callable[[Warp, tuple[int, int], tuple[int, int]], NDArray[np.floating]]


def matched(
    warp: Warp,
    render: Render,
    plane: NDArray[np.floating],
    corners: list[tuple[int, int]],
    side: int,
    degree: int,
    on_step: StepHook,
) -> Warp:
    """Bend a warp to the matches of all windows that are clear; each calls `on_step(0, 1)`."""
    found = []
    for row, col in corners:
        on_step(0, 1)
        seen, shown = plane[row : row + side, col : col + side], render(warp, (row, col), (side, side))
        shift, clarity = match(seen, shown)
        if clarity >= CLEAR:
            found.append(((row + (side - 1) / 2.0, col + (side - 1) / 2.0), shift))
    pixels, shifts = np.array(found).reshape(-1, 2, 2).transpose(1, 0, 2)
    wanted = np.stack(warp(*(pixels - shifts).T), axis=-1) - np.stack(warp(*pixels.T), axis=-1)
    # two matches for each term
    degree = max((d for d in range(degree + 1) if (d + 1) * (d + 2) <= len(pixels)), default=0)
    used = np.add.outer(np.arange(DEGREE + 1), np.arange(DEGREE + 1)) <= degree
    basis = polynomial.polyvander2d(*warp.unit(*pixels.T), [DEGREE, DEGREE])[:, used.ravel()]
    good = np.ones(len(pixels), dtype=bool)
    for _ in range(6):
        if good.sum() < max(_FEWEST_MATCHES, used.sum()):
            raise NotEnoughEvidenceError(
                f"only {int(good.sum())} of {len(corners)} windows of the photo match the reference; "
                "photograph it flat, in focus and without anything before it, a pair from a tripod"
            )
        terms = np.linalg.lstsq(basis[good], wanted[good], rcond=None)[0]
        left = np.hypot(*(wanted - basis @ terms).T) / warp.scale(*warp.frame.center)
        after = left <= max(3.0 * float(np.median(left[good])), _TRUSTED_PX)
        if (after == good).all():
            break
        good = after
    bend = warp.bend.copy()
    bend[used] += terms
    return replace(warp, bend=bend)


_LOOKED_AT: Final = 1000  # pixels along the long side: noise has turned to grey, discs are 15 across
_DARK: Final = 0.45  # of the surroundings' mean level, which is grey (chosen: discs are black)
# Area over that of the ellipse of its second moments: noise frays discs, letters have less (chosen)
_ROUND: Final = 0.85
_LEAST_PX: Final = 20  # area of a disc: below it no shape is seen (chosen)
_MOST_SHARE: Final = 0.004  # same, of the picture: a page that fills it has less than a tenth (chosen)
_CANDIDATES: Final = 14  # discs looked at for the four marks: ten others do no harm, and it is quick (chosen)
_ALIKE: Final = 4.0  # the largest disc over the smallest in area: a page seen very much aslant
_PAPER_OVER_DISC: Final = 2.0  # least ratio of their light: shadows and patterns have less (chosen)


def find_marks(plane: NDArray[np.floating]) -> NDArray[np.float64]:
    """Find the middles of the discs, in order around the page, clockwise."""
    factor = max(max(plane.shape) // _LOOKED_AT, 1)
    small = block_means(np.asarray(plane, dtype=np.float64), factor)
    scale = max(small.shape) / _LOOKED_AT
    dark = ndimage.gaussian_filter(small, 2.0 * scale) < _DARK * ndimage.gaussian_filter(small, 40.0 * scale)
    labels, _ = ndimage.label(dark)
    discs = []
    for number, box in enumerate(ndimage.find_objects(labels), start=1):
        blob = np.argwhere(labels[box] == number) + [side.start for side in box]
        if (clarity := _paper_over_disc(blob, small)) > _PAPER_OVER_DISC:
            discs.append((clarity, blob))
    clear = [blob for _, blob in sorted(discs, key=lambda disc: -disc[0])][:_CANDIDATES]
    best, most = None, 0.05 * small.size
    for four in combinations(clear, 4):
        areas = [len(blob) for blob in four]
        hull = spatial.ConvexHull([blob.mean(axis=0) for blob in four], qhull_options="QJ")
        if max(areas) <= _ALIKE * min(areas) and len(hull.vertices) == 4 and hull.volume > most:
            best, most = hull.points, hull.volume
    if best is None:
        raise NotEnoughEvidenceError(
            f"{len(clear)} corner discs of a target are seen, four are needed; the whole page must be in the "
            "photo, with its white border"
        )
    away = best - best.mean(axis=0)
    return np.asarray((best[np.argsort(np.arctan2(*away.T))] + 0.5) * factor - 0.5, dtype=np.float64)


def _paper_over_disc(blob: NDArray[np.intp], picture: NDArray[np.float64]) -> float:
    """Light around the pixels of a dark blob over that on it; 0 where it is not round or of another size."""
    area = len(blob)
    if not _LEAST_PX <= area <= _MOST_SHARE * picture.size:
        return 0.0
    ellipse = 4.0 * math.pi * math.sqrt(max(float(np.linalg.det(np.cov(blob.T, bias=True))), 0.0))
    if not _ROUND * ellipse < area < ellipse / _ROUND:
        return 0.0
    # the white square reaches twice as far as the disc
    angles, radius = np.arange(8) * math.pi / 4, 1.55 * math.sqrt(area / math.pi)
    ring = np.rint(blob.mean(axis=0) + radius * np.stack([np.sin(angles), np.cos(angles)], axis=1))
    ring = ring[((ring >= 0) & (ring < picture.shape)).all(axis=1)].astype(int)
    if len(ring) < 6:
        return 0.0
    return float(np.median(picture[tuple(ring.T)])) / max(float(np.median(picture[tuple(blob.T)])), 1e-6)
