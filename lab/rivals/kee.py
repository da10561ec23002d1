"""A smooth parametric field of Gaussians, `kee`.

Source: E. Kee, S. Paris, S. Chen and J. Wang, "Modeling and removing spatially-varying optical blur",
ICCP 2011. The PSF of each colour is a Gaussian whose covariance is a polynomial of the place in the
frame. They fit it to a printed pattern; here it is fitted blindly, to the straight edges of photos.

Across an edge with unit normal n at place p the line spread function has the variance::

    s² = n' C(p) n + s0²,        C(p) = sum_j C_j m_j(p),    m_j monomials of degree <= d

which is linear in the C_j: one least-squares problem for all edges of a photo.

Departures from the paper:

1. Edges of a scene are soft by themselves, and always make blur look wider: of the residuals those of
   wider edges count less (an expectile), and what the edges of sharp photographs have is taken off.
2. Terms beyond the constant are drawn to zero where edges are few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.blind.steps.edge_patches import edge_mask
from lab.blind.steps.pyramid import Image, View
from lab.rivals.rival import PhotoWindow, polynomial, powers, windows_of
from lensmodel.core import psf
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel
from lensmodel.photo import LinearPhoto

_DIRECTIONS = 24  # of normals in half a turn: 7.5 degrees apart (chosen)
_STEP_PX = 0.25  # bins of a profile: four a pixel, as ISO 12233
_TENSOR_PX = 2.0  # over which the structure tensor is averaged (chosen)
_COHERENT = 0.85  # of the tensor: corners and texture have less (chosen)
_CONTRAST_IN_NOISE = 12.0  # of a step: its slopes stand out of the noise then (chosen)
_FLAT_SHARE = 0.06  # of the step, by which its sides may vary (chosen)
_WIDE_SHARE = 0.45  # of the reach; a ramp that fills the window has 0.58
_SCATTER_SHARE = 0.06  # of the step, by which values may leave the profile (chosen)
_EDGE_SHARE = 0.08  # of the pixels, the strongest, are looked at (chosen)
_STRIDE_PX = 4  # a crest is the steepest place so far around (chosen)
_STRAIGHTENINGS = 3  # Gauss-Newton steps, each of 0.1 rad at most (chosen)
_CORE_LEVEL = 0.05  # of the peak (chosen): what lies below is left out, noise would widen the variance
_SAMPLING_PX2 = 1.0 / 12.0 + 5.0 / 12.0 * _STEP_PX**2  # of the pixel, the bins and their differences
_LEAST_EDGES = 12  # of a colour (chosen): two for each of six monomials
_ROUNDS = 12  # of reweighted least squares (chosen)
_LEAST_PX2, _MOST_PX2 = 0.01, 36.0  # bounds of a variance (chosen): standard deviations of 0.1 and 6 pixels

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GaussianField:
    """Gaussians whose covariance is a polynomial of the place."""

    # (terms, 3), C_j as (row row, row col, col col) in px², in the order of `powers`; x to the right and y
    # upwards in half diagonals
    terms: dict[Channel, Floats]
    degree: int  # d of the source

    def covariance(self, position: FieldPosition, channel: Channel) -> Floats:
        """C(p), its eigenvalues kept positive."""
        x, y = position.r * math.cos(position.phi), position.r * math.sin(position.phi)
        rr, rc, cc = polynomial(np.array(x), np.array(y), self.degree) @ self.terms[channel]
        sizes, axes = np.linalg.eigh(np.array([[rr, rc], [rc, cc]]))
        return np.asarray(axes @ np.diag(np.clip(sizes, _LEAST_PX2, _MOST_PX2)) @ axes.T)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the Gaussian of a place; see `PsfField`."""
        return psf.gaussian(size, self.covariance(position, channel))


@dataclass(frozen=True, slots=True)
class Kee:
    """Field of Gaussians from straight edges."""

    degree: int = 2  # Of the polynomial. Four would hold what third-order aberrations do, and followed noise.
    expectile: float = 0.02  # weight of edges wider than the fit, against those that are narrower
    softness_px2: float = 0.6  # variance that the edges of sharp photographs have
    pull: float = 0.2  # weight of drawing a term to zero, in edges
    reach: int = 9  # half extent of an edge across and along, pixels
    along: int = 4

    name = "kee"
    source = "Kee et al. 2011 (field of Gaussians, fitted to the edges of the photo)"

    def field(self, photos: Sequence[LinearPhoto]) -> GaussianField:
        """Fit the field; see `Rival`."""
        windows = windows_of(photos)
        return GaussianField(
            {channel: self._fitted(windows, i) for i, channel in enumerate(CHANNELS)}, self.degree
        )

    def _fitted(self, windows: Sequence[PhotoWindow], channel: int) -> Floats:
        places: list[tuple[float, float]] = []
        edges: list[EdgeProfile] = []
        for window in windows:
            view = View.of(window.plane(channel), window.noise[channel])
            found = profiles(view, self.reach, self.along)
            r, phi = window.position.r, window.position.phi
            places += [(r * math.cos(phi), r * math.sin(phi))] * len(found)
            edges += found
        if len(edges) < _LEAST_EDGES:
            raise NotEnoughEvidenceError(
                f"{len(edges)} straight edges determine no field of Gaussians; use photos with more of them"
            )
        angle = np.array([edge.direction for edge in edges]) * (math.pi / _DIRECTIONS)
        variance = np.array([core_variance(edge.spread) for edge in edges])
        variance -= _SAMPLING_PX2 + self.softness_px2
        return self.solved(np.array(places), angle, variance)

    def solved(self, places: Floats, angle: Floats, variance: Floats) -> Floats:
        """Fit the polynomial.

        Parameters
        ----------
        places : ndarray, shape (n, 2)
            x and y in half diagonals.
        angle : ndarray, shape (n,)
            Of the edge's normal, counter-clockwise from the right, radians.
        variance : ndarray, shape (n,)
            Along the normal, px², of the blur alone.

        Returns
        -------
        ndarray, shape (terms, 3)
            Entries (row row, row col, col col) of each C_j.
        """
        row, col = -np.sin(angle), np.cos(angle)
        along = np.stack([row * row, 2.0 * row * col, col * col], axis=-1)
        terms = polynomial(places[:, 0], places[:, 1], self.degree)
        design = (terms[:, :, None] * along[:, None, :]).reshape(len(angle), -1)
        order = np.repeat([i + j for i, j in powers(self.degree)], 3)
        pull = np.diag(np.where(order > 0, self.pull, 1e-6))
        weights = np.ones(len(angle))
        solution = np.zeros(design.shape[1])
        for _ in range(_ROUNDS):
            weighted = design * weights[:, None]
            solution = np.linalg.solve(weighted.T @ design + pull, weighted.T @ variance)
            residual = variance - design @ solution
            # far outliers, edges that are no edges, count by their distance and not by its square
            scale = 1.5 * float(np.median(np.abs(residual))) + 1e-9
            robust = 1.0 / np.maximum(np.abs(residual) / scale, 1.0)
            weights = robust * np.where(residual > 0, self.expectile, 1.0 - self.expectile)
        return np.asarray(solution.reshape(-1, 3))


def core_variance(spread: Floats) -> float:
    """Variance in px² of a line spread function above a twentieth of its peak."""
    s = _places(spread.size)
    core = np.where(spread > _CORE_LEVEL * spread.max(), spread, 0.0)
    core = core / core.sum()
    middle = float((core * s).sum())
    return float((core * (s - middle) ** 2).sum())


# --- profiles of straight edges ---


@dataclass(frozen=True, slots=True, eq=False)
class EdgeProfile:
    """One edge: the PSF's projection onto its normal."""

    direction: int  # the normal lies at pi * direction / 24 counter-clockwise from the right
    # (2 n,), line spread function, sum 1, centroid at 0, at (i - n + 1/2) / 4 px along the normal
    spread: Floats
    weight: float  # squared contrast over noise

    @property
    def width_px(self) -> float:
        """Root of the second moment over the positive part."""
        s = _places(self.spread.size)
        positive = np.maximum(self.spread, 0.0)
        return math.sqrt(float((positive * s * s).sum() / positive.sum()))


def profiles(view: View, reach: int, along: int) -> list[EdgeProfile]:
    """Line spread functions of the straight, isolated edges of a patch.

    Each edge is read as far out as its sides stay flat, at least half of `reach`.
    """
    y = view.y
    smooth = ndimage.gaussian_filter(y, 1.0)
    down, across = np.gradient(smooth)
    rr, cc, rc = (
        ndimage.gaussian_filter(a * b, _TENSOR_PX)
        for a, b in ((down, down), (across, across), (down, across))
    )
    angle = 0.5 * np.arctan2(-2.0 * rc, cc - rr)  # of the normal, counter-clockwise: rows grow downwards
    coherence = np.hypot(cc - rr, 2.0 * rc) / np.maximum(rr + cc, 1e-12)
    rim = math.ceil(math.hypot(reach, along)) + 1
    mask = edge_mask(smooth, _EDGE_SHARE) & (coherence > _COHERENT)
    mask[:rim], mask[-rim:], mask[:, :rim], mask[:, -rim:] = False, False, False, False
    slope = np.where(mask, np.hypot(down, across), 0.0)
    crest = mask & (slope == ndimage.maximum_filter(slope, 2 * _STRIDE_PX + 1))
    box = np.arange(-rim, rim + 1)
    found = []
    for row, col in zip(*np.nonzero(crest), strict=True):
        window = y[row - rim : row + rim + 1, col - rim : col + rim + 1]
        for near in range(reach, reach // 2, -1):
            one = _profile(window, box, float(angle[row, col]), (near, reach), along, view.noise)
            if one is not None:
                found.append(one)
                break
    return found


def _profile(
    window: Image,
    box: NDArray[np.intp],
    angle: float,
    reach: tuple[int, int],
    along: int,
    noise: float,
) -> EdgeProfile | None:
    """Profile across one edge, or None where it is not a straight step between flat sides.

    Read up to the first of `reach`, padded with zeros to the second.
    """
    s = math.cos(angle) * box[None, :] - math.sin(angle) * box[:, None]
    t = math.sin(angle) * box[None, :] + math.cos(angle) * box[:, None]
    near = (np.abs(s) < reach[0]) & (np.abs(t) <= along)
    n = int(reach[0] / _STEP_PX)
    values, place, beside = window[near], s[near], t[near]
    profile = _binned(place, values, n)
    for _ in range(_STRAIGHTENINGS):
        lean, bend = _course(place, beside, values, profile)
        place = place - lean * beside - bend * beside**2
        angle -= lean  # the normal leans against the edge
        profile = _binned(place, values, n)
    direction = round(angle / math.pi * _DIRECTIONS)
    if abs(direction) > _DIRECTIONS // 2:
        return None  # vertical to the last digit: its other half counts it
    side = max(n // 3, 2)
    dark, bright = profile[:side], profile[-side:]
    step = float(bright.mean() - dark.mean())
    if abs(step) < _CONTRAST_IN_NOISE * max(noise, 1e-6):
        return None
    allowed = _FLAT_SHARE * abs(step) + noise
    if max(float(dark.std()), float(bright.std())) > allowed:
        return None
    within = values - np.interp(place, _places(2 * n), profile)
    if float(within.std()) > _SCATTER_SHARE * abs(step) + 1.5 * noise:
        return None
    spread = np.gradient(profile) / step
    if direction < 0:
        spread = spread[::-1]  # directions go from 0 to 23: the same edge, seen along the opposite normal
    spread = np.pad(spread, int(reach[1] / _STEP_PX) - n)
    found = _centred(direction % _DIRECTIONS, spread, (step / max(noise, 1e-3)) ** 2)
    return None if found is None or found.width_px > _WIDE_SHARE * reach[0] else found


def _binned(place: Floats, values: Floats, n: int) -> Floats:
    """Mean of values in `2 n` bins of a quarter pixel; empty ones are interpolated."""
    bins = np.clip(np.floor(place / _STEP_PX).astype(np.intp) + n, 0, 2 * n - 1)
    count = np.bincount(bins, minlength=2 * n)
    filled = count > 0
    centre = np.bincount(bins, weights=place, minlength=2 * n)[filled] / count[filled]
    mean = np.bincount(bins, weights=values, minlength=2 * n)[filled] / count[filled]
    return np.interp(_places(2 * n), centre, mean)


def _course(place: Floats, beside: Floats, values: Floats, profile: Floats) -> tuple[float, float]:
    """Where the edge runs: s = lean t + bend t², by one Gauss-Newton step on the profile's residuals."""
    s = _places(profile.size)
    slope = np.interp(place, s, np.gradient(profile) / _STEP_PX)
    residual = values - np.interp(place, s, profile)
    basis = np.stack([-slope, -slope * beside, -slope * beside**2], axis=1)
    _, lean, bend = np.linalg.lstsq(basis, residual, rcond=None)[0]
    return float(np.clip(lean, -0.1, 0.1)), float(np.clip(bend, -0.02, 0.02))


def _centred(direction: int, spread: Floats, weight: float) -> EdgeProfile | None:
    """Normalise a profile and move its centroid to 0; the tails beyond its ends are cut."""
    s = _places(spread.size)
    level = 0.1 * float(spread.max())
    core = np.where(spread > level, spread, 0.0)
    if not core.sum() > 0:
        return None
    for _ in range(3):
        at = float((core * s).sum() / core.sum())
        near = np.abs(s - at) < 0.6 * float(s[-1])
        core = np.where(near & (spread > level), spread, 0.0)
        if not core.sum() > 0:
            return None
    moved = np.interp(s + at, s, spread, left=0.0, right=0.0)
    total = float(moved.sum())
    return EdgeProfile(direction, moved / total, weight) if total > 0 else None


def _places(bins: int) -> Floats:
    return np.asarray((np.arange(bins) - bins // 2 + 0.5) * _STEP_PX, dtype=np.float64)
