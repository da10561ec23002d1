"""Lateral colour: how far red and blue images lie from the green one, from the photo itself; its removal."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import correlation_peak, whole_peak
from lensmodel.core.types import Channel, Frame, Plane, Planes, block_means

Polynomial = tuple[float, float, float, float]
IDENTITY: Polynomial = (0.0, 0.0, 0.0, 1.0)  # r -> r
_CELLS = 10  # cells per side that each give a few points: corners must not be outvoted by the middle
_POINTS = 5  # of each block of the frame: its strongest corners (chosen)
_WINDOW = 48  # pixels that are correlated: more than any lateral colour, of one shift (chosen)
_SEARCH = 8  # largest shift looked for, pixels
_MIN_CORRELATION = 0.8  # of two channels: below, colours differ and edges do not match (chosen)
_MIN_POINTS = 30  # that a polynomial is fitted to: some seven for each term, a few may be wrong (chosen)
_LARGEST = 0.1  # of each term, relative to the radius (chosen): lenses stay below a hundredth
_BAND = 1024  # rows at once: memory (chosen)
_TAPER = np.outer(np.hanning(_WINDOW + 1)[:-1], np.hanning(_WINDOW + 1)[:-1])


@dataclass(frozen=True, slots=True)
class LateralColour:
    """Radial displacement of red and blue against green, in the polynomial of tca_correct.

    A point whose green image lies at radius r has its red (blue) image at::

        r_src = r (v + c r + b r² + a r³)
    """

    red: Polynomial  # (a, b, c, v), with r in half diagonals; (0, 0, 0, 1) is no displacement
    blue: Polynomial
    half_diagonal: float  # half diagonal of the frame in pixels
    red_points: int = 0  # of the photo on which the estimate rests; with fewer than 30 nothing is claimed
    blue_points: int = 0

    def __post_init__(self) -> None:
        finite = all(map(math.isfinite, (*self.red, *self.blue, self.half_diagonal)))
        scale = max(abs(self.red[3] - 1.0), abs(self.blue[3] - 1.0))
        if not finite or self.half_diagonal <= 0.0 or scale > _LARGEST + 1e-9:
            raise InvalidInputError(f"lateral colour needs finite terms, a size, and v near 1, got {self}")

    def displacement(self, r: float, channel: Channel) -> float:
        """Pixels outwards by which a channel's image lies beyond the green one at radius `r`."""
        a, b, c, v = {"r": self.red, "g": IDENTITY, "b": self.blue}[channel]
        return float(r * ((v - 1.0) + c * r + b * r**2 + a * r**3) * self.half_diagonal)

    def counted_in(self, half_diagonal: float) -> LateralColour:
        """Return the same displacement of the same pixels, with r in another half diagonal."""
        k = half_diagonal / self.half_diagonal
        red, blue = ((a * k**3, b * k**2, c * k, v) for a, b, c, v in (self.red, self.blue))
        return replace(self, red=red, blue=blue, half_diagonal=half_diagonal)


def estimate_lateral(planes: Planes, frame: Frame, *, clip: float | Sequence[float] = 1.0) -> LateralColour:
    """Estimate lateral colour from corners of the photo, by cross-correlation of band-passed windows.

    The radial part of the shifts is fitted by Huber-weighted least squares; the Bayesian information
    criterion chooses the number of terms, or none.
    """
    full, half = 0.98 * np.broadcast_to(clip, 3), _WINDOW // 2 + _SEARCH  # with a margin for the band-pass
    found: dict[int, list[tuple[float, float]]] = {0: [], 2: []}  # radius and outward shift of red and blue
    for row, col in _points(planes[1]):
        window = planes[:, max(row - half, 0) : row + half, max(col - half, 0) : col + half]
        if window.shape[1:] != (2 * half, 2 * half) or (window.max(axis=(1, 2)) >= full).any():
            continue
        position, green = frame.position(row, col), _banded(window[1])
        for index, points in found.items():
            if (shift := _shift(_banded(window[index]), green)) is not None:
                outwards = shift[1] * math.cos(position.phi) - shift[0] * math.sin(position.phi)
                points.append((position.r, outwards))
    columns = (np.reshape(points, (-1, 2)).T for points in found.values())
    red, blue = (_fit(r, shift, frame.half_diagonal) for r, shift in columns)
    return LateralColour(red, blue, frame.half_diagonal, len(found[0]), len(found[2]))


def resample(planes: Planes, frame: Frame, lateral: LateralColour) -> Planes:
    """Move red and blue onto green by one interpolation with cubic B-splines, which softens a little."""
    out = np.array(planes, dtype=np.float32)
    row_c, col_c = frame.center
    cols = np.arange(frame.width) - col_c
    for index, (a, b, c, v) in ((0, lateral.red), (2, lateral.blue)):
        if (a, b, c, v) == IDENTITY:
            continue
        spline = ndimage.spline_filter(planes[index], order=3, output=np.float32, mode="mirror")
        for top in range(0, frame.height, _BAND):
            rows = np.arange(top, min(top + _BAND, frame.height)) - row_c
            r = np.hypot(rows[:, None], cols[None, :]) / frame.half_diagonal
            ratio = v + r * (c + r * (b + r * a))
            where = np.stack([rows[:, None] * ratio + row_c, cols[None, :] * ratio + col_c])
            out[index, top : top + len(rows)] = ndimage.map_coordinates(
                spline, where, order=3, prefilter=False, mode="mirror"
            )
    return out


def _points(green: Plane) -> Iterator[tuple[int, int]]:
    """Pixels with structure in both directions, spread over the cells of the frame."""
    # A corner is found as well on a coarser grid, at a fraction of the cost.
    bin_by = max(1, min(green.shape) // 1000)
    # the root evens noise and contrast in shadows and lights
    coarse = np.sqrt(np.maximum(block_means(green, bin_by), 0.0))
    rows, cols = coarse.shape
    r, c = (ndimage.gaussian_filter(coarse, 1.0, order=order) for order in ((1, 0), (0, 1)))
    rr, cc, rc = (ndimage.gaussian_filter(product, 4.0) for product in (r * r, c * c, r * c))
    weaker = (rr + cc) / 2.0 - np.sqrt(((rr - cc) / 2.0) ** 2 + rc**2)
    apart = max(_WINDOW // (2 * bin_by), 3)
    peak = (weaker == ndimage.maximum_filter(weaker, size=2 * apart + 1)) & (weaker > 1e-7)
    for i, j in np.ndindex(_CELLS, _CELLS):
        top, left = i * rows // _CELLS, j * cols // _CELLS
        part = (slice(top, (i + 1) * rows // _CELLS), slice(left, (j + 1) * cols // _CELLS))
        peaks = np.argwhere(peak[part])
        strength = weaker[part][tuple(peaks.T)]
        for row, col in peaks[np.argsort(-strength, kind="stable")[:_POINTS]]:
            yield int((top + row) * bin_by), int((left + col) * bin_by)


def _banded(window: NDArray[np.float32]) -> NDArray[np.float64]:
    """Difference of Gaussians: neither noise nor slow shading may pull the peak."""
    wide = window.astype(np.float64)
    return np.asarray(ndimage.gaussian_filter(wide, 1.0) - ndimage.gaussian_filter(wide, 4.0))


def _shift(moved: NDArray[np.float64], reference: NDArray[np.float64]) -> tuple[float, float] | None:
    """Shift `(row, col)` of `moved` against `reference`; None where they do not look alike."""
    inner = slice(_SEARCH, _SEARCH + _WINDOW)
    still, whole = fft.fft2(tapered := reference[inner, inner] * _TAPER), (0, 0)
    for tries_left in (2, 1, 0):  # the window follows the whole-pixel shift: the taper cuts both the same
        rows, cols = (slice(_SEARCH + step, _SEARCH + step + _WINDOW) for step in whole)
        cut = moved[rows, cols] * _TAPER
        cross = fft.fft2(cut) * np.conj(still)
        step = whole_peak(cross)
        if step == (0, 0) or not tries_left:
            break
        whole = (whole[0] + step[0], whole[1] + step[1])
        if max(map(abs, whole)) >= _SEARCH:
            return None
    likeness = float((cut * tapered).sum() / math.sqrt((cut**2).sum() * (tapered**2).sum() + 1e-30))
    part, _ = correlation_peak(cross, (0, 0))
    if likeness < _MIN_CORRELATION or max(map(abs, part)) > 1.0:
        return None
    return whole[0] + part[0], whole[1] + part[1]


def _fit(r: NDArray[np.float64], shift: NDArray[np.float64], half_diagonal: float) -> Polynomial:
    """Fit shift = half_diagonal ((v - 1) r + c r² + b r³), as many terms as the points support."""
    if r.size < _MIN_POINTS:
        return IDENTITY
    best, best_score = np.zeros(0), np.inf
    for terms in range(4):
        solution, cost = _huber(half_diagonal * r[:, None] ** np.arange(1, terms + 1), shift)
        score = r.size * math.log(cost) + (terms + 1) * math.log(r.size)
        if score < best_score:
            best, best_score = solution, score
    v, c, b = (float(term) for term in np.pad(best, (0, 3 - best.size)))
    return (0.0, b, c, 1.0 + v)


def _huber(columns: NDArray[np.float64], shift: NDArray[np.float64]) -> tuple[NDArray[np.float64], float]:
    """Iteratively reweighted least squares; returns the terms and the mean robust cost."""
    solution: NDArray[np.float64] = np.zeros(columns.shape[1])
    residual = shift
    for _ in range(20):
        # The floor keeps perfect data from dividing by zero: shifts are not known below 0.002 px.
        scale = max(1.4826 * float(np.median(np.abs(residual))), 2e-3)
        root = np.sqrt(np.minimum(1.0, 1.345 * scale / np.maximum(np.abs(residual), 1e-12)))
        asked = np.linalg.lstsq(columns * root[:, None], shift * root, rcond=None)[0]
        # few pixels and noise may ask for more than any lens does
        solution = np.clip(asked, -_LARGEST, _LARGEST)
        residual = shift - columns @ solution
    size = np.minimum(np.abs(residual), 3.0 * scale)  # gross outliers count once, not squared
    return solution, float(np.mean(size**2)) + 1e-8
