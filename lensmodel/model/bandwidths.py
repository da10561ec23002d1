"""Bandwidths by eq. (8) of the paper, cross-validation that finds factors on them, and robust weights.

One photo is left out at a time: its samples share its shake, focus and noise, and leaving out single ones
would be optimistic. Every answer is a linear combination f_i = sum_j w_ij C_j, so the squared error of all
held-out samples follows from the Gram matrix G = C C' alone, and trying another bandwidth touches no kernel::

    |C_i - f_i|^2 = G_ii - 2 (W G)_ii + (W G W')_ii

An outlying photo (defocus, shake, another lens) spoils all its samples, so photos are judged first, by the
median of their held-out errors d_i, then samples, by Tukey's biweight; one that fits better than the median
keeps its weight::

    q_i <- q_i psi((d_i - median d) / s),   psi(t) = (1 - (t / c)^2)^2 below c = 4.685, else 0
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import WAVELENGTH_NM
from lensmodel.model.query import PAPER, Array

# In the columns of `query.point`, bandwidths of settings that do not vary among the samples, and upper limits
# of those that do; with 20 nm, red and green, 70 nm apart, have 0.2 percent of each other's weight
_FALLBACK = np.array([math.nan, math.nan, math.nan, 0.5, 20.0, 0.25, 0.5])
_FLOOR_R, _FLOOR_PHI = 0.02, 0.12  # least bandwidths: blur does not change faster over the field (chosen)
_SAME = 1e-6  # equal values have a spread of rounding errors, not of zero
_PLACE_SHARE = 0.45  # of eq. 8: the rule is for densities, a smooth regression wants less

_MULTIPLES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)  # of the rule; errors hardly differ in between (chosen)
_PHI_MULTIPLES = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0, 20.0)  # 20 means rotational symmetry (chosen)
_CAP = 1.5  # relative errors beyond count no more than this: one outlier chooses nothing (chosen)
_AS_GOOD, _NEGLIGIBLE = 1.01, 1e-3  # errors nearer than this are equal: their difference is noise (chosen)
_CV_PHOTOS = 3  # from which leaving one out tells of bandwidths: of two, one would foretell one (chosen)
_CV_SAMPLES = 300  # that the search looks at: its cost grows with their square (chosen)
_SCORED = 800  # samples whose held-out error is measured; the others get the median (chosen: cost)
_ONE_FOCAL_LENGTH = 0.25  # octaves (chosen: over a fifth of it lenses hardly change)
_UNKNOWN_ERROR = 0.5  # of samples that no other one foretells (chosen: halfway to no knowledge)
_FEWEST = 2  # one sample cannot be left out
_TUKEY = 4.685  # 95 % efficiency for normal errors (P. J. Huber, "Robust Statistics", 1981: Tukey's biweight)
_ROUNDS = 4  # of reweighting: each costs as much, and later ones change the weights less (chosen)
_MIN_PHOTOS = 3  # with two nobody knows which one is wrong
_OUTLYING = 0.5  # factor below which a photo is an outlier: it has less than half of its weight (chosen)


def reference_bandwidth(sigma: float, dimensions: int, count: int) -> float:
    """Bandwidth by the normal reference rule, h = sigma (4 / ((d + 2) n))^(1 / (d + 4)), eq. (8)."""
    return sigma * (4.0 / ((dimensions + 2) * max(count, 1))) ** (1.0 / (dimensions + 4))


def bandwidths(where: Array, mode: str, factors: tuple[float, float] = (1.0, 1.0)) -> Array:
    """Bandwidths of the columns of points `(n, 7)` by eq. (8), and factors on r and phi.

    n counts PSF samples of one channel, not their pixels: a million pixels of one PSF say nothing
    about another place. d counts the place and those settings that vary. (u, v) have none.
    """
    n = int(np.unique(where[:, 4], return_counts=True)[1].max())
    known = {column: where[~np.isnan(where[:, column]), column] for column in (3, 5, 6)}
    varying = {c: float(values.std()) for c, values in known.items() if values.size and values.std() > _SAME}
    d = 2 + len(varying)
    share = 1.0 if mode == PAPER else _PLACE_SHARE  # the paper's own way is eq. (8) as it stands
    scale = _FALLBACK.copy()
    scale[0] = factors[0] * max(share * reference_bandwidth(float(where[:, 0].std()), d, n), _FLOOR_R)
    scale[1:3] = factors[1] * max(share * reference_bandwidth(math.sqrt(0.5), d, n), _FLOOR_PHI)
    for column, sigma in varying.items():
        scale[column] = min(scale[column], reference_bandwidth(sigma, d, n))
    return scale


class HeldOut:
    """Samples prepared for cross-validation: what those of other groups say of each.

    `rows` (n, m) are kernels as flat rows of a square grid, at points `where` (n, 7); `scale` are bandwidths,
    `prior` (n,) the weights of the samples as they come; those of one of `groups` (n,) are held out together.
    """

    def __init__(
        self, rows: NDArray[np.floating], where: Array, scale: Array, prior: Array, groups: NDArray[np.intp]
    ) -> None:
        rows = np.asarray(rows, dtype=np.float64)  # errors are small differences of these products
        gap = np.nan_to_num((where[:, None, :] - where[None, :, :]) / scale, nan=0.0) ** 2
        self.prior, self._gram = prior, rows @ rows.T
        self._own = np.maximum(np.diag(self._gram), 1e-30)
        self._place, self._turn = gap[..., 0], gap[..., 1] + gap[..., 2]
        self._others = np.where(groups[:, None] == groups[None, :], np.inf, gap[..., 3:].sum(axis=-1))

    def weights(self, factors: tuple[float, float], robust: Array | float = 1.0) -> Array:
        """Held-out Nadaraya-Watson weights at multiples of the bandwidths in r and phi, rows of sum 1."""
        squared = self._place / factors[0] ** 2 + self._turn / factors[1] ** 2 + self._others
        nearest = squared.min(axis=1, keepdims=True)
        weight = self.prior * np.exp(-0.5 * (squared - np.where(np.isfinite(nearest), nearest, 0.0))) * robust
        total = weight.sum(axis=1, keepdims=True)
        return np.asarray(weight / np.where(total > 0, total, 1.0))

    def errors(self, weight: Array) -> Array:
        """Relative L2 of each sample against its weighted mean of others."""
        mean = weight @ self._gram
        squared = np.diag(self._gram) - 2 * np.diag(mean) + np.einsum("ij,ij->i", mean, weight)
        return np.where(weight.sum(axis=1) > 0, np.sqrt(np.maximum(squared, 0.0) / self._own), 1.0)

    def noise(self, weight: Array) -> Array:
        """Squared relative scatter of each sample's others about their weighted mean.

        From the weights of `weights`: sum_j w_j |C_j - f|^2 / (1 - sum_j w_j^2), over the sample's |C_i|^2.
        """
        spread = weight @ np.diag(self._gram) - np.einsum("ij,ij->i", weight @ self._gram, weight)
        free = np.maximum(1.0 - (weight**2).sum(axis=1), 0.1)
        return np.asarray(np.maximum(spread, 0.0) / free / self._own)

    def best_factors(self) -> tuple[float, float]:
        """Search the factors on r and phi, by turns, for the least mean held-out error by weight."""

        def best(options: list[tuple[float, float]]) -> tuple[float, float]:
            errors = [np.minimum(self.errors(self.weights(option)), _CAP) for option in options]
            scores = np.average(errors, axis=1, weights=np.maximum(self.prior, 1e-9))
            # the least reach among those that are as good: far neighbours cost time and assume a symmetry
            return options[int((scores <= scores.min() * _AS_GOOD + _NEGLIGIBLE).argmax())]

        r, phi = 1.0, 1.0
        for _ in range(2):
            before = r, phi
            r, phi = best([(factor, phi) for factor in _MULTIPLES])
            r, phi = best([(r, factor) for factor in _PHI_MULTIPLES])
            if (r, phi) == before:
                break
        return r, phi

    def robust(self, photos: NDArray[np.intp], factors: tuple[float, float]) -> tuple[Array, Array, Array]:
        """Factors on the weights of samples and of photos (0 to the last), and the held-out errors."""
        count = int(photos.max()) + 1
        by_sample, by_photo = np.ones(photos.size), np.ones(count)
        errors = self.errors(self.weights(factors))
        for _ in range(_ROUNDS if count >= _MIN_PHOTOS else 0):
            errors = self.errors(self.weights(factors, by_sample * by_photo[photos]))
            medians = np.array([np.median(errors[photos == p]) for p in range(count)])
            by_photo = _biweight(medians, medians, floor=0.25)
            by_sample = _biweight(errors, errors[by_photo[photos] > _OUTLYING], floor=0.35)
        return by_sample, by_photo, errors


def _biweight(values: Array, reference: Array, *, floor: float) -> Array:
    """Tukey's weights by the median and the spread of a reference."""
    middle = float(np.median(reference))
    spread = 1.4826 * float(np.median(np.abs(reference - middle)))
    spread = max(spread, floor * middle, 0.01)  # few photos that agree by chance condemn none
    t = np.maximum(values - middle, 0.0) / (_TUKEY * spread)
    return np.asarray(np.where(t < 1.0, (1.0 - t * t) ** 2, 0.0))


def cross_validate(
    samples: Sequence[PsfSample],
    mode: str,
    upright: Callable[[NDArray[np.intp]], Array],
    where: Array,
    base: Array,
) -> tuple[Array, Array, Array, tuple[float, float]]:
    """Choose bandwidths by cross-validation, weigh samples robustly; `upright` gives the kernels of rows.

    Returns (n,) weights, held-out relative L2, and the part of its square that is the samples' own scatter;
    and the factors on the bandwidths in r and phi.
    """
    photo = np.unique([s.photo for s in samples], return_inverse=True)[1]
    groups, scale = _held_together(photo, where[:, 5]), bandwidths(where, mode)
    counting = np.flatnonzero(base > 0)
    scored = thinned(counting, _SCORED)
    errors, noise = np.full(len(samples), _UNKNOWN_ERROR), np.zeros(len(samples))
    weights = base.copy()
    if len(scored) < _FEWEST:
        return weights, errors, noise, (1.0, 1.0)

    def held(rows: NDArray[np.intp], prior: Array) -> HeldOut:
        return HeldOut(upright(rows).reshape(len(rows), -1), where[rows], scale, prior[rows], groups[rows])

    def searched(prior: Array) -> tuple[float, float]:
        if mode == PAPER or len(np.unique(photo[counting])) < _CV_PHOTOS:
            return 1.0, 1.0
        green = counting[where[counting, 4] == WAVELENGTH_NM["g"]]  # it has the least noise
        return held(thinned(green if green.size else counting, _CV_SAMPLES), prior).best_factors()

    factors, prepared = searched(base), held(scored, base)
    known, own_photo = np.unique(photo[scored], return_inverse=True)
    by_sample, by_photo, held_out = prepared.robust(own_photo, factors)
    if mode != PAPER:
        of_photos = np.ones(photo.max() + 1)
        of_photos[known] = by_photo
        weights *= of_photos[photo]
        weights[scored] *= by_sample
        if min(by_photo.min(), by_sample.min()) < _OUTLYING:  # outliers chose as well
            factors = searched(weights)
    scatter = np.minimum(prepared.noise(prepared.weights(factors)), held_out**2)
    errors[:], noise[:] = float(np.median(held_out)), float(np.median(scatter))
    errors[scored], noise[scored] = held_out, scatter
    return weights, errors, noise, factors


def _held_together(photo: NDArray[np.intp], octaves: Array) -> NDArray[np.intp]:
    """Group samples by photo; those of a photo that is alone at its focal length are held out one by one."""
    groups = photo.copy()  # without that photo the error would be that of zooming, not of its samples
    for number in np.unique(photo):
        own = photo == number
        known = octaves[own & ~np.isnan(octaves)]
        middle = float(np.median(known)) if known.size else math.nan
        if not (~own & ~(np.abs(octaves - middle) > _ONE_FOCAL_LENGTH)).any():
            groups[own] = len(photo) + np.flatnonzero(own)
    return groups


def thinned(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    """Rows, or as many of them as are wanted at most, evenly apart."""
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.intp)]
