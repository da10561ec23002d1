"""Nadaraya-Watson regression over kernels in rotated local frames (paper, section 6.2, eq. 4-8).

The weight of a sample factorises into one of place and settings, common to all its pixels, and one of (u, v).
So the sum over all pixels of all samples is one of kernels::

    f(u, v) = sum_i W_i C_i(u, v) / sum_i W_i,     W_i = q_i exp(-d_i^2 / 2)

with C_i the sample's kernel in its own radial frame, d_i its distance in bandwidths (`query`), q_i its
weight, for the samples near the question in a kd-tree (paper, section 6.3). Departures from the paper: n in
eq. (8) counts PSFs, not pixels; the smoothing over (u, v) is that of the spline, because a bandwidth of
pixels would widen the PSF; unless the mode is "paper", kernels are scaled to the width of the place first: a
mean of kernels of different widths is too wide where the blur grows outwards. The logarithms of the root mean
square widths along u and v follow a polynomial of the place::

    log s = b0 + b1 r^2 + b2 r^4 + b3 x + b4 y + b5 x r^2 + b6 y r^2 + b7 (x^2 - y^2) + b8 x y + settings

(third-order theory: coma grows as r, astigmatism and field curvature as r^2; a decentred copy adds odd terms
in x and y). So sample i is seen from the question through the map of pixel offsets::

    M_i = L_i' S_i S^-1 L,      L = [[-sin phi, cos phi], [-cos phi, -sin phi]],   S = diag(s_u, s_v)

A sample is stored once, in its own frame, as a cubic spline S_i on a grid twice as fine as the pixel, and
resampled once, at the pixels q of an answer (`spline_sums`)::

    f(q) = sum_i w_i |M_i| S_i(M_i (q - shift)),    S(p) = sum_k c_k B3(p_r - k_r) B3(p_c - k_c)

Source: M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing Magazine
16, 1999.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import scipy  # `spatial` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

from lensmodel.core.errors import NoSamplesError
from lensmodel.core.numerics import jit, on_simplex
from lensmodel.core.psf import PsfSample, resized, second_moments
from lensmodel.core.types import WAVELENGTH_NM, FieldPosition, LensSettings
from lensmodel.model import camera_bodies, query
from lensmodel.model.bandwidths import bandwidths, cross_validate, thinned
from lensmodel.model.query import PAPER, Array, Part

_KNOWN: Final = [0, 1, 2, 4]  # variables that are never unknown: place and wavelength
_REACH: Final = 5.0  # bandwidths: a Gaussian has fallen to 4e-6 there
_DROPPED: Final = 3e-5  # samples that together weigh less are left out (chosen: below single precision)
_FEW: Final = 8  # neighbours at least, however far: a mean of fewer is no better than its worst (chosen)

_DRIFT: Final = 0.15  # relative L2 for each unit beyond the first to the nearest sample (chosen)
# the same for each unit beyond the outermost sample (chosen: the median of drawn lenses wide open changes by
# .53 to .62 over a unit outwards; no command repeats it)
_OUTWARD: Final = 0.5
_WIDEST: Final = 255  # pixels: side of the widest kernel that is made for coarser pixels: memory


class Neighbourhood:
    """Samples by their points (n, 7) of `query` and weights (n,), 0 for those that take no part.

    A kd-tree holds the variables that every sample and question knows; `scale` (7,) are bandwidths.
    """

    def __init__(self, points: Array, weights: Array, scale: Array) -> None:
        self.points, self.weights, self.scale = points, weights, scale
        self._tree = scipy.spatial.cKDTree((points / scale)[:, _KNOWN])

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Weigh the samples near each of some places."""
        chosen = [self._weighed(query.point(position, settings)) for position in positions]
        return Answers(
            np.concatenate([rows for rows, _ in chosen]),
            np.concatenate([weights for _, weights in chosen]),
            np.array([len(rows) for rows, _ in chosen]),
        )

    def _weighed(self, asked: Array) -> tuple[NDArray[np.intp], Array]:
        """Rows and weights of sum 1 for one question, the least first (eq. 4 and 7)."""
        rows = self.within(asked, _REACH)
        squared = query.squared_distances(self.points[rows], asked, self.scale)
        near = np.flatnonzero((squared <= _REACH**2) & (self.weights[rows] > 0.0))
        if len(near) < _FEW:  # the nearest few, however far
            rows = np.arange(len(self.points))
            squared = query.squared_distances(self.points, asked, self.scale)
            squared[self.weights <= 0.0] = np.inf
            near = np.argsort(squared, kind="stable")[: min(_FEW, np.count_nonzero(self.weights > 0.0))]
        rows, squared = rows[near], squared[near]
        weight = self.weights[rows] * np.exp(-0.5 * (squared - squared.min()))
        order = np.argsort(weight, kind="stable")
        kept = order[np.cumsum(weight[order]) > _DROPPED * weight.sum()]
        return rows[kept], weight[kept] / weight[kept].sum()

    def within(self, asked: Array, reach: float) -> NDArray[np.intp]:
        """Rows within `reach` bandwidths of a point, but for settings."""
        inside = self._tree.query_ball_point((asked / self.scale)[_KNOWN], reach)
        return np.sort(np.asarray(inside, dtype=np.intp))


class Regression:
    """Kernels of samples, prepared for questions; `NoSamplesError` if no sample has a weight."""

    def __init__(self, samples: Sequence[PsfSample], mode: str) -> None:
        base = np.array([s.weight for s in samples])
        if not (base > 0).any():
            raise NoSamplesError(f"none of the {len(samples)} samples has a weight; include a photo again")
        self.samples = samples
        self._pitch_um = camera_bodies.usual_pitch(samples)  # that all kernels are brought to, or None
        common = camera_bodies.at_pitch(samples, self._pitch_um)
        points = query.points(common)
        self._widths = WidthField() if mode == PAPER else WidthField.fit(common, base)
        self._local = LocalKernels.of(common, points, self._widths)
        weights, self._held_out, self._scatter, factors = cross_validate(
            common, mode, self._local.upright, points, base
        )
        self._where = query.in_units(points)
        # what the estimators expect of their samples; 0 where they expect nothing
        self._expected = np.array([0.0 if s.error is None else min(s.error, 1.0) for s in samples])
        self._photos = np.array([s.photo for s in samples])
        self.nbytes = self._local.splines.nbytes
        self._around = Neighbourhood(points, weights, bandwidths(points, mode, factors))

    def ask(self, position: FieldPosition, settings: LensSettings, size: int, pitch_um: float | None) -> Part:
        """Answer at a place, in pixels of some pitch."""
        near = self._around.near([position], settings)
        where, asked = self._where[near.rows], query.in_units(query.point(position, settings))
        nearest, outermost = query.nearest(where, asked), float(np.hypot(where[:, 0], where[:, 1]).max())
        error = self._error(near, nearest, max(math.hypot(*asked[:2]) - outermost, 0.0))
        kernel = self.kernels([position], settings, size, pitch_um)[0]
        return Part(kernel, error, near.weights, self._photos[near.rows], nearest)

    def kernels(
        self, positions: Sequence[FieldPosition], settings: LensSettings, size: int, pitch_um: float | None
    ) -> Array:
        """Return the kernels of many places, shape (q, size, size)."""
        near = self._around.near(positions, settings)
        widths = self._widths.over(np.array([query.point(p, settings) for p in positions]))
        angles = np.array([p.phi for p in positions])
        own = self._pitch_um
        if own is None or pitch_um is None or camera_bodies.alike(own, pitch_um):
            return self._local.kernels(near, angles, widths, size)
        inside = min(2 * math.ceil(size / 2 * pitch_um / own) + 1, max(_WIDEST, size))
        kernels = self._local.kernels(near, angles, widths, inside)
        return np.stack([camera_bodies.rescaled(kernel, own, pitch_um, size) for kernel in kernels])

    def _error(self, near: Answers, nearest: float, outward: float) -> float:
        """Expected relative L2 error of one answer.

        With held-out errors h, of which the scatter s of neighbours is a part, m independent photos, what the
        estimators expect t, all near the place, the distance d to the nearest sample and o outward from all::

            own^2 = max(h^2 - s^2 (1 + 1/m), h^2 / 9) + s^2 / m       shared^2 = max(t^2 - s^2, t^2 / 4)
            error^2 = own^2 + shared^2 + (0.15 max(d - 1, 0))^2 + (0.5 o)^2

        Estimators that err alike do not scatter: at least half of what they expect is taken for shared.
        """
        weight, rows = near.weights, near.rows
        _, number = np.unique(self._photos[rows], return_inverse=True)
        independent = 1.0 / float((np.bincount(number, weight) ** 2).sum())
        held_out = float(weight @ self._held_out[rows] ** 2)
        scatter = min(float(weight @ self._scatter[rows]), held_out)
        own = max(held_out - scatter * (1.0 + 1.0 / independent), held_out / 9.0) + scatter / independent
        expected = float(weight @ self._expected[rows] ** 2)
        if len(self._where) == 1 and expected > 0.0:
            own = 0.0  # no other sample foretells it
        shared = max(expected - scatter, expected / 4.0)
        drift = math.hypot(_DRIFT * max(nearest - 1.0, 0.0), _OUTWARD * outward)
        return min(math.sqrt(own + shared + drift * drift), 1.0)


# --- kernels in their local frames ---------------------------------------------------------------

# Of 1, r, r^2, then the rest: weak, only against too few samples (chosen)
_PLACE_RIDGE = np.array([1e-6, 1e-3, 1e-2, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05])
_SETTING_RIDGE = 0.05  # of the settings: with none, two apertures would scale kernels at will (chosen)
_RANGE = (0.45, 2.5)  # factors by which a kernel is scaled at most: beyond, its shape is another one (chosen)
_HUBER = 0.15  # of a logarithm of the width: the scatter of estimates (chosen)
_MIN_SAMPLES = 6  # below, widths are carried nowhere: the fit over the field has more terms (chosen)
_MOST = 3000  # samples: the cost of the fit grows with them (chosen)
_ROUNDS = 4  # of reweighting: each costs as much, and later ones change less (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class WidthField:
    """Widths (s_u, s_v) of the PSF over the field, relative to a reference width of the model."""

    slopes: Array | None = None  # (m, 2), of log s_u and log s_v; None = one width everywhere
    reference: float = 0.0  # logarithm of the width that counts as 1
    stops: float = 0.0  # origins of the settings, where terms of them are zero
    focal: float = 0.0

    def over(self, where: Array) -> Array:
        """Widths along u and v at points `(n, 7)` of `query`, over the reference width, shape (n, 2)."""
        if self.slopes is None:
            return np.ones((len(where), 2))
        # no matrix product: how that rounds hangs on how many places are asked for at once
        logarithms = (self._features(where)[:, :, None] * self.slopes).sum(axis=1)
        return np.clip(np.exp(logarithms - self.reference), *_RANGE)

    def _features(self, where: Array) -> Array:
        r2 = where[:, 0] ** 2
        x, y = query.vectors(where).T
        stops, focal = where[:, 3] - self.stops, where[:, 5] - self.focal
        stops[np.isnan(stops)] = focal[np.isnan(focal)] = 0.0
        wave = (where[:, 4] - WAVELENGTH_NM["g"]) / 100.0
        place = [np.ones_like(r2), r2, r2 * r2, x, y, x * r2, y * r2, x * x - y * y, x * y]
        return np.stack(
            [*place, stops, stops * stops, stops * r2, focal, focal * r2, wave, wave * wave], axis=1
        )

    @classmethod
    def fit(cls, samples: Sequence[PsfSample], weights: Array) -> WidthField:
        """Fit the widths of weighted samples by Huber's weights; one width everywhere below six samples."""
        rows = thinned(np.flatnonzero(weights > 0), _MOST)
        if len(rows) < _MIN_SAMPLES:
            return cls()
        samples = [samples[int(i)] for i in rows]
        where = query.points(samples)
        known = (column[~np.isnan(column)] for column in (where[:, 3], where[:, 5]))
        stops, focal = (float(np.median(column)) if column.size else 0.0 for column in known)
        origin = cls(stops=stops, focal=focal)
        design = origin._features(where)
        target = np.array([_log_widths(s) for s in samples])
        weight = np.maximum(weights[rows], 1e-3)
        extra = design.shape[1] - len(_PLACE_RIDGE)
        ridge = np.diag(np.concatenate([_PLACE_RIDGE, np.full(extra, _SETTING_RIDGE)])) * weight.mean()
        robust = np.ones(len(samples))
        slopes = np.zeros((design.shape[1], 2))
        for _ in range(_ROUNDS):
            weighted = design * (weight * robust)[:, None]
            slopes = np.linalg.solve(design.T @ weighted + ridge, weighted.T @ target)
            miss = np.abs(target - design @ slopes).max(axis=1)
            robust = np.minimum(1.0, _HUBER / np.maximum(miss, 1e-12))
        seen = design @ slopes
        reference = float((seen.min() + seen.max()) / 2.0)  # as far from the narrowest as from the widest
        return cls(slopes, reference, stops, focal)


def _log_widths(sample: PsfSample) -> tuple[float, float]:
    """Logarithms of the root mean square widths along u and v, pixels."""
    (rr, rc), (_, cc) = second_moments(sample.kernel)
    c, s = np.cos(sample.position.phi), np.sin(sample.position.phi)
    # u points to (-sin, cos) and v to (-cos, -sin) in (row, col)
    uu = s * s * rr - 2 * s * c * rc + c * c * cc
    vv = c * c * rr + 2 * s * c * rc + s * s * cc
    return float(0.5 * np.log(max(uu, 0.04))), float(0.5 * np.log(max(vv, 0.04)))


_FINER = 2  # coefficients for each pixel along an axis (chosen); 1 where memory is short
_MOST_BYTES = 1 << 29  # beyond, kernels are kept no finer than their pixels

# Degrees of the spline that fills the finer grid (chosen): a cubic one would be off by .7 % of the peak of a
# Gaussian of 1.1 px turned by 45 degrees; kernels up to the Nyquist frequency ripple with a high one
_SMOOTH, _NARROW = 7, 3
_ALIASED = (0.05, 0.2)  # contrast at the Nyquist frequency: below, above
_MARGIN = 8  # pixels: the spline's response has fallen to 3e-5 there
_RIM = 3  # coefficients around the grid, zeros: so far out a spline is not zero yet
_LIGHT = 1e-6  # of the peak: fainter pixels do not widen the spline
_SPLINE_REACH = 2.0 * 2.0**0.5  # of a coefficient, along the diagonal
_CENTRED_PX = 1e-3  # pixels: a thousandth moves no figure that is reported
_STEPS = 6  # of centring at most: each lowers what is left many times over (chosen)
_ROOM = 1.35  # side over that of an answer, for kernels scaled down to it: few are by more (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Which samples answer which questions, with which weights."""

    rows: NDArray[np.intp]  # (m,), samples, one question after the other
    weights: Array  # (m,), sum 1 in each question
    counts: NDArray[np.intp]  # (questions,), samples of each

    def part(self, questions: NDArray[np.intp]) -> Answers:
        """Return those to some of the questions, which are in ascending order."""
        kept = np.repeat(np.isin(np.arange(len(self.counts)), questions), self.counts)
        return Answers(self.rows[kept], self.weights[kept], self.counts[questions])


@dataclass(frozen=True, slots=True, eq=False)
class LocalKernels:
    """Splines of the samples with the frames that they belong to."""

    side: int  # odd side of the stored kernels
    splines: NDArray[np.float32]  # (n, (finer (side - 1) + 1 + 2 rims)^2), coefficients
    angles: Array  # (n,), phi of the places in radians
    radii: Array  # (n,), of the light in steps of the grid
    widths: Array  # (n, 2), scales (s_u, s_v) of the places
    finer: int  # coefficients for each pixel along an axis

    @classmethod
    def of(cls, samples: Sequence[PsfSample], where: Array, field: WidthField) -> LocalKernels:
        """Keep samples at points `where` (n, 7)."""
        side = max(s.kernel.shape[0] for s in samples)
        finer = _FINER if 4 * (_FINER * (side - 1) + 1) ** 2 * len(samples) <= _MOST_BYTES else 1
        stored = np.empty((len(samples), (finer * (side - 1) + 1 + 2 * _RIM) ** 2), dtype=np.float32)
        radii = np.empty(len(samples))
        for i, sample in enumerate(samples):
            spline = coefficients(resized(sample.kernel, side), finer)
            lit = np.argwhere(np.abs(spline) > _LIGHT * np.abs(spline).max()) - spline.shape[0] // 2
            stored[i], radii[i] = np.pad(spline, _RIM).ravel(), np.hypot(*lit.T).max() + _SPLINE_REACH
        angles = np.array([s.position.phi for s in samples])
        return cls(side, stored, angles, radii, field.over(where), finer)

    def kernels(self, answers: Answers, angles: Array, widths: Array, size: int) -> Array:
        """Means of the neighbours at places of `angles` (q,) and `widths` (q, 2), shape (q, size, size).

        Centring moves the points at which the splines are read: kernels are not resampled again.
        """
        shifts = np.zeros((len(angles), 2))
        light = np.empty((len(angles), size, size))
        t = np.arange(size, dtype=np.float64) - size // 2
        left = np.arange(len(angles))
        for _ in range(_STEPS):
            kernels = self._sums(answers.part(left), angles[left], widths[left], shifts[left], size)
            kernels = without_negatives(kernels.reshape(len(left), -1)).reshape(kernels.shape)
            light[left] = kernels
            total = kernels.sum(axis=(1, 2))
            row, col = kernels.sum(axis=2) @ t / total, kernels.sum(axis=1) @ t / total
            shifts[left] -= np.stack([row, col], axis=1)
            left = left[np.hypot(row, col) >= _CENTRED_PX]
            if not left.size:
                break
        return np.asarray(light / light.sum(axis=(1, 2), keepdims=True))

    def upright(self, rows: NDArray[np.intp]) -> Array:
        """Kernels at phi = 0 and unit width, rows towards -v, columns towards u, shape (m, side, side)."""
        count, side = len(rows), 2 * int(np.ceil(self.side // 2 * _ROOM)) + 1
        single = Answers(rows, np.ones(count), np.ones(count, dtype=np.intp))
        return self._sums(single, np.zeros(count), np.ones((count, 2)), np.zeros((count, 2)), side)

    def _sums(self, answers: Answers, angles: Array, widths: Array, shifts: Array, size: int) -> Array:
        """Weighted sums of the samples of each answer, which may be negative and off the centre."""
        rows, asked = answers.rows, np.repeat(np.arange(len(angles)), answers.counts)
        scale = self.widths[rows] / widths[asked]
        maps = _frames(self.angles[rows]).mT @ ((scale * self.finer)[:, :, None] * _frames(angles[asked]))
        factors = answers.weights * scale[:, 0] * scale[:, 1]
        starts = np.concatenate([[0], np.cumsum(answers.counts)])
        out = np.zeros((len(angles), size, size))
        spline_sums(self.splines, self.radii, rows, factors, maps, starts, shifts, out)
        return out


def without_negatives(values: Array) -> Array:
    """The nearest values that are not negative and have the same sum, of each row of (q, n).

    Clipping alone would keep the crests of a spline's ripples round a sharp kernel and drop their troughs.
    """
    lowered = values.copy()
    for row in np.flatnonzero((values.min(axis=1) < 0.0) & (values.max(axis=1) > 0.0)):
        total = float(values[row].sum())
        lowered[row] = on_simplex(values[row], total if total > 0.0 else float(values[row].max()))
    return lowered


def _frames(angles: Array) -> Array:
    """L of each angle: from (row, col) to (u, v), shape (n, 2, 2)."""
    c, s = np.cos(angles), np.sin(angles)
    return np.stack([np.stack([-s, c], axis=-1), np.stack([-c, -s], axis=-1)], axis=-2)


def coefficients(kernel: NDArray[np.floating], finer: int) -> Array:
    """Coefficients of the spline through the pixels of a kernel, `(k, k)` to `(finer (k - 1) + 1,) * 2`."""
    turns = 1.0 - 2.0 * (np.arange(kernel.shape[0]) % 2)
    contrast = max(abs(float(turns @ kernel.sum(axis=axis))) for axis in (0, 1)) / float(kernel.sum())
    narrow = float(np.interp(contrast, _ALIASED, (0.0, 1.0)))
    spline = np.zeros(())
    for share, degree in ((1.0 - narrow, _SMOOTH), (narrow, _NARROW)):
        if share > 0.0:
            refining = _refining(kernel.shape[0], degree, finer)
            spline = spline + share * (refining @ kernel @ refining.T)
    return np.asarray(spline)


@lru_cache(maxsize=16)
def _refining(side: int, degree: int, finer: int) -> Array:
    """Matrix from the pixels of an axis to the coefficients of the finer grid, zeros around both."""
    half = side // 2
    fine = np.arange(-half * finer, half * finer + 1)
    pixels = np.pad(np.eye(side), ((_MARGIN, _MARGIN), (0, 0)))
    through = scipy.interpolate.make_interp_spline(
        np.arange(-half - _MARGIN, half + _MARGIN + 1), pixels, k=degree
    )
    sampling = (4.0 * np.eye(fine.size) + np.eye(fine.size, k=1) + np.eye(fine.size, k=-1)) / 6.0
    return np.asarray(np.linalg.inv(sampling) @ through(fine / finer))


# Of the cubic B-spline (M. Unser, IEEE Signal Processing Magazine 16, 1999, eq. 4), in single precision.
_ONE, _HALF = np.float32(1.0), np.float32(0.5)
_SIXTH, _TWO_THIRDS = np.float32(1.0 / 6.0), np.float32(2.0 / 3.0)


@jit
def _inside(a: float, b: float, c: float, size: int) -> tuple[int, int]:
    """Integers j in 0..size with a j^2 + 2 b j + c <= 0, as first and last + 1."""
    root = b * b - a * c
    if root < 0.0:
        return 0, 0
    root = math.sqrt(root)
    first, last = math.ceil((-b - root) / a), math.floor((-b + root) / a)
    return max(first, 0), min(last + 1, size)


@jit
def _weights(t: np.float32) -> tuple[np.float32, np.float32, np.float32, np.float32]:
    """Weights of the four coefficients round a point that lies `t` beyond the second."""
    rest = _ONE - t
    first, last = rest * rest * rest * _SIXTH, t * t * t * _SIXTH
    second = _TWO_THIRDS - t * t * (_ONE - _HALF * t)
    return first, second, _ONE - first - second - last, last


@jit
def _value(spline: NDArray[np.float32], side: int, y: float, x: float) -> np.float32:
    """Value of a spline at (y, x); 0 where not all of its coefficients lie on the grid."""
    if not (1.0 <= y < side - 2 and 1.0 <= x < side - 2):
        return np.float32(0.0)
    row, col = int(y), int(x)
    v0, v1, v2, v3 = _weights(np.float32(y - row))
    h0, h1, h2, h3 = _weights(np.float32(x - col))
    p = (row - 1) * side + col - 1
    q, r, o = p + side, p + 2 * side, p + 3 * side
    return (
        v0 * (h0 * spline[p] + h1 * spline[p + 1] + h2 * spline[p + 2] + h3 * spline[p + 3])
        + v1 * (h0 * spline[q] + h1 * spline[q + 1] + h2 * spline[q + 2] + h3 * spline[q + 3])
        + v2 * (h0 * spline[r] + h1 * spline[r + 1] + h2 * spline[r + 2] + h3 * spline[r + 3])
        + v3 * (h0 * spline[o] + h1 * spline[o + 1] + h2 * spline[o + 2] + h3 * spline[o + 3])
    )


@jit
def spline_sums(
    rows: NDArray[np.float32],
    radii: Array,
    chosen: NDArray[np.intp],
    weights: Array,
    maps: Array,
    starts: NDArray[np.intp],
    shifts: Array,
    out: Array,
) -> None:
    """Add weighted sums of splines, read through affine maps, to `out` (answers, size, size).

    `chosen` (m,) are the samples that are read, one answer after the other from `starts` on, with their
    `weights`, which include the determinants of the `maps` (m, 2, 2), from (row, col) offsets of the answer
    in pixels to those of the sample in steps of its grid; each answer is moved by its `shifts` in pixels.
    """
    side, size = round(math.sqrt(rows.shape[1])), out.shape[1]
    half, middle = side // 2, size // 2
    for answer in range(out.shape[0]):
        left = -middle - shifts[answer, 1]
        for k in range(starts[answer], starts[answer + 1]):
            row, weight = chosen[k], weights[k]
            spline, reach = rows[row], radii[row]
            dy, dx = maps[k, 0, 1], maps[k, 1, 1]
            for i in range(size):
                down = i - middle - shifts[answer, 0]
                y = maps[k, 0, 0] * down + dy * left
                x = maps[k, 1, 0] * down + dx * left
                first, last = _inside(dy * dy + dx * dx, y * dy + x * dx, y * y + x * x - reach * reach, size)
                y, x = y + half, x + half
                for j in range(first, last):
                    out[answer, i, j] += weight * _value(spline, side, y + j * dy, x + j * dx)
