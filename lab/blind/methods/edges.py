"""PSF from straight edges, `edges`: line spread functions in several directions, put together.

Across a straight edge a photo shows the integral of the PSF's projection onto the edge's normal. Many edges,
each sampled finer than the pixel because it is slanted, give projections at many angles, and the
kernel is the non-negative one that has these projections. Source for the idea: T. S. Cho, S. Paris,
B. K. P. Horn and W. T. Freeman, "Blur kernel estimation using the Radon transform", CVPR 2011; for the
sampling: ISO 12233, slanted edges.

It reads the width of the edges in the picture: what is soft in the scene counts as blur. The sharper
half of the edges of each direction is used.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.blind.steps.cleaning import cleaned
from lab.blind.steps.edge_patches import edge_mask
from lab.blind.steps.pyramid import Image, View
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.least_squares import nonnegative_least_squares
from lensmodel.core.psf import gaussian
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook, ignore_step
from lensmodel.estimation.estimator import PsfEstimate, usable
from lensmodel.estimation.steps.finish import finished

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
_LEAST_EDGES = 3  # fewer are chance (chosen)
_CORE_LEVEL = 0.05  # of the peak: noise in the tails has no part in a width (chosen)
_ROUND_WEIGHT = 0.5  # of a round Gaussian; a direction of many edges has 1 (chosen)
_SAMPLING_PX2 = 1.0 / 12.0 + 5.0 / 12.0 * _STEP_PX**2  # of the pixel, the bins and their differences
_LEAST_DIRECTIONS = 2  # one alone says nothing of the other axis

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EdgeProfile:
    """One edge: the PSF's projection onto its normal.

    Parameters
    ----------
    direction : int
        The normal lies at pi * direction / 24 counter-clockwise from the right.
    spread : ndarray, shape (2 n,)
        Line spread function, sum 1, centroid at 0, at (i - n + 1/2) / 4 px along the normal.
    weight : float
        Squared contrast over noise.
    """

    direction: int
    spread: Floats
    weight: float

    @property
    def width_px(self) -> float:
        """Root of the second moment over the positive part."""
        s = _places(self.spread.size)
        positive = np.maximum(self.spread, 0.0)
        return math.sqrt(float((positive * s * s).sum() / positive.sum()))


@dataclass(frozen=True, slots=True)
class Edges:
    """Kernel with the projections that straight edges show.

    min over k >= 0 of  sum_t w_t |P_t k - L_t|² + pull |k - g|²

    L_t: mean line spread function at angle t; P_t: projection of the kernel's pixels, each a unit
    square, for the edge is integrated over pixels too; g: the Gaussian of the same widths.

    Parameters
    ----------
    reach : int
        Half extent across an edge, and half side of the kernel, in pixels.
    along : int
        Half length of an edge in pixels.
    pull : float
        Towards the Gaussian of the same widths, which decides where no edge says anything.
    threshold : float
        Kernel values below this share of the peak are dropped.
    """

    reach: int = 7
    along: int = 4
    pull: float = 0.1
    threshold: float = 0.02

    name = "edges"
    version = 1

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share; see `PsfEstimator`."""
        began = time.process_time()
        kept = usable(patches, noise, size)
        found: list[EdgeProfile] = []
        for done, (patch, model) in enumerate(kept, start=1):
            found.extend(profiles(View.of(patch, model), self.reach, self.along))
            on_step(done, len(kept) + 1)
        if len(found) < _LEAST_EDGES or len({e.direction for e in found}) < _LEAST_DIRECTIONS:
            raise NotEnoughEvidenceError(
                f"{len(found)} straight edges in {len({e.direction for e in found})} directions determine no "
                "kernel; choose parts with isolated edges in several directions"
            )
        means = _sharper_half(found)
        side = 2 * min(self.reach, size // 2) + 1
        kernel = assembled(means, side, self.pull)
        on_step(len(kept) + 1, len(kept) + 1)
        covered = len(means) / _DIRECTIONS
        scatter = _scatter(found)
        return finished(
            cleaned(kernel, self.threshold),
            kept,
            size=size,
            error=math.hypot(0.3 + 0.4 * (1.0 - covered), scatter),
            diagnostics={"edges": float(len(found)), "covered": covered, "scatter": scatter},
            began=began,
        )

    def estimate_channel(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        reference: PsfEstimate,
        reference_patches: Sequence[Plane],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate another channel of the same patches; it is cheap enough to start anew."""
        return self.estimate(patches, noise, size=size, rng=rng, on_step=on_step)


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


def assembled(means: dict[int, tuple[Floats, float]], side: int, pull: float) -> Floats:
    """Solve for the kernel `(side, side)` by its projections, `direction: (spread, weight)`."""
    a, b = np.zeros((side * side,) * 2), np.zeros(side * side)
    for direction, (spread, weight) in means.items():
        matrix = projection(math.pi * direction / _DIRECTIONS, side, spread.size)
        a += weight * (matrix.T @ matrix)
        b += weight * (matrix.T @ spread)
    scale = float(np.trace(a)) / a.shape[0]
    guess = np.asarray(gaussian_of(means, side)).ravel()
    a[np.diag_indices_from(a)] += pull * scale
    b += pull * scale * guess
    return nonnegative_least_squares(a, b, guess, steps=400).reshape(side, side)


def projection(angle: float, side: int, bins: int) -> Floats:
    """Matrix `(bins, side²)`: the line spread function that each kernel pixel contributes.

    A unit square projected along an edge is a trapezoid; binning the profile and taking central
    differences widens it by boxes of one and two bins.
    """
    t = np.arange(side) - side // 2
    place = (math.cos(angle) * t[None, :] - math.sin(angle) * t[:, None]).ravel()
    wide, narrow = sorted((abs(math.cos(angle)), abs(math.sin(angle))), reverse=True)
    narrow = max(narrow, 0.02)  # an upright square has jumps, which fall between the samples below
    gap = np.abs(_places(bins)[:, None] - place[None, :])
    over = np.linspace(-1.5 * _STEP_PX, 1.5 * _STEP_PX, 7)
    weight = np.array([0.0, 0.5, 1.0, 1.0, 1.0, 0.5, 0.0])
    value = np.zeros_like(gap)
    for shift, w in zip(over, weight / weight.sum(), strict=True):
        ramp = (0.5 * (wide + narrow) - np.abs(gap + shift)) / narrow
        value += w * np.clip(ramp, 0.0, 1.0) / wide
    return value * _STEP_PX


def _sharper_half(found: Sequence[EdgeProfile]) -> dict[int, tuple[Floats, float]]:
    """Mean profile and its weight for each direction, of the sharper half of its edges."""
    means = {}
    for direction in sorted({edge.direction for edge in found}):
        edges = sorted((e for e in found if e.direction == direction), key=lambda e: e.width_px)
        chosen = edges[: -(-len(edges) // 2)]
        weights = np.array([e.weight for e in chosen])
        mean = np.average([e.spread for e in chosen], axis=0, weights=weights)
        means[direction] = (mean, 1.0 - 0.5 ** len(chosen))
    return means


def gaussian_of(means: dict[int, tuple[Floats, float]], side: int) -> Kernel:
    """Gaussian whose projections have the widths of the profiles.

    The variance along the normal n is n' C n; three numbers by least squares, drawn to a round C where
    the directions leave them open.
    """
    rows, values, weights = [], [], []
    for direction, (spread, weight) in means.items():
        angle = math.pi * direction / _DIRECTIONS
        normal = (-math.sin(angle), math.cos(angle))
        rows.append([normal[0] ** 2, 2.0 * normal[0] * normal[1], normal[1] ** 2])
        values.append(max(_core_variance(spread) - _SAMPLING_PX2, 0.02))
        weights.append(weight)
    root = np.sqrt(np.array(weights))
    mean = float(np.average(values, weights=weights))
    pull = math.sqrt(_ROUND_WEIGHT) * np.eye(3)
    a = np.vstack([root[:, None] * np.array(rows), pull])
    b = np.concatenate([root * np.array(values), pull @ np.array([mean, 0.0, mean])])
    rr, rc, cc = np.linalg.lstsq(a, b, rcond=None)[0]
    size, axes = np.linalg.eigh(np.array([[rr, rc], [rc, cc]]))
    return gaussian(side, axes @ np.diag(np.clip(size, 0.02, None)) @ axes.T)


def _core_variance(spread: Floats) -> float:
    s = _places(spread.size)
    core = np.where(spread > _CORE_LEVEL * spread.max(), spread, 0.0)
    core = core / core.sum()
    at = float((core * s).sum())
    return float((core * (s - at) ** 2).sum())


def _scatter(found: Sequence[EdgeProfile]) -> float:
    """Median relative deviation of widths within a direction: how far the edges contradict each other."""
    deviations = []
    for direction in {edge.direction for edge in found}:
        widths = np.array([e.width_px for e in found if e.direction == direction])
        deviations.extend(np.abs(widths / np.median(widths) - 1.0))
    return float(np.median(deviations))


def _places(bins: int) -> Floats:
    return np.asarray((np.arange(bins) - bins // 2 + 0.5) * _STEP_PX, dtype=np.float64)
