"""Bandwidths by eq. (8) of the paper; robust weights and errors of samples by leaving one photo out.

Every answer is a linear combination f_i = sum_j w_ij C_j, so the squared error of all held-out
samples follows from the Gram matrix G = C C' alone::

    |C_i - f_i|^2 = G_ii - 2 (W G)_ii + (W G W')_ii

Samples of one photo share its shake, focus and noise: leaving out single samples would be optimistic. With a
single photo there is no other choice, and each sample is its own group.

A spoilt photo (defocus, shake, another lens) spoils all its samples, so photos are judged first, by the
median of their held-out errors d_i, then samples::

    q_i <- q_i psi((d_i - median d) / s),   psi(t) = (1 - (t / c)^2)^2 below c = 4.685, else 0

psi is Tukey's biweight; a sample that fits better than the median keeps its weight.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.model import variables as va
from lensmodel.model.answer import PAPER, ModelSettings
from lensmodel.model.local_frame import LocalKernels

FALLBACK: Final[Mapping[str, float]] = {
    "aperture_stops": 0.5,
    "wavelength_nm": 20.0,  # red and green differ by 70 nm: 0.2 percent of each other's weight
    "focal_octaves": 0.25,
    "focus_dioptres": 0.5,
}
"""Bandwidths of settings that do not vary among the samples, and upper limits of those that do."""

_FLOOR_R, _FLOOR_PHI = 0.02, 0.12  # least bandwidths: blur does not change faster over the field (chosen)
_SAME = 1e-6  # equal values have a spread of rounding errors, not of zero
_PLACE_SHARE = 0.45  # of eq. 8: the rule is for densities, a smooth regression wants less
_SCORED = 800
"""Samples whose held-out error is measured, at a cost of their square; others get the median (chosen)."""
_ONE_FOCAL_LENGTH = 0.25
"""Octaves within which focal lengths are one (chosen: over a fifth of it lenses hardly change)."""
_UNKNOWN_ERROR = 0.5  # of samples that no other one foretells (chosen: halfway to no knowledge)
_TUKEY = 4.685  # 95 % efficiency for normal errors (P. J. Huber, "Robust Statistics", 1981: Tukey's biweight)
_ROUNDS = 4  # of reweighting: each costs as much, and later ones change the weights less (chosen)
_MIN_PHOTOS = 3  # with two nobody knows which one is wrong
_SPOILT = 0.5  # factor below which a photo is spoilt: it counts for less than half of its claim (chosen)


def reference_bandwidth(sigma: float, dimensions: int, count: int) -> float:
    """Bandwidth by the normal reference rule, h = sigma (4 / ((d + 2) n))^(1 / (d + 4)), eq. (8)."""
    return sigma * (4.0 / ((dimensions + 2) * max(count, 1))) ** (1.0 / (dimensions + 4))


def bandwidths(where: NDArray[np.float64], settings: ModelSettings) -> dict[str, float]:
    """Bandwidths of points `(n, 7)` by eq. (8) and the wishes of a user.

    n counts PSF samples of one channel, not their pixels: a million pixels of one PSF say nothing
    about another place. d counts the place and those settings that vary. (u, v) have none.
    """
    n = int(np.unique(where[:, 4], return_counts=True)[1].max())
    known = {column: where[~np.isnan(where[:, column]), column] for column in (3, 5, 6)}
    spread = {va.COLUMNS[c]: float(values.std()) if values.size else 0.0 for c, values in known.items()}
    varying = {name: sigma for name, sigma in spread.items() if sigma > _SAME}
    d = 2 + len(varying)
    # the paper's own way is eq. (8) as it stands
    whole = _PLACE_SHARE if settings.mode == PAPER else 1.0
    r, phi = (
        max(_PLACE_SHARE * reference_bandwidth(sigma, d, n), floor) / whole
        for sigma, floor in ((float(where[:, 0].std()), _FLOOR_R), (math.sqrt(0.5), _FLOOR_PHI))
    )
    rule = {name: min(FALLBACK[name], reference_bandwidth(sigma, d, n)) for name, sigma in varying.items()}
    rule = {"r": settings.r or r, "phi": settings.phi or phi, **FALLBACK, **rule}
    return rule if settings.stops is None else {**rule, "aperture_stops": settings.stops}


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """What the samples say of each other."""

    weights: NDArray[np.float64]  # (n,), after robust weighting
    errors: NDArray[np.float64]  # (n,), held-out relative L2
    noise: NDArray[np.float64]  # (n,), the part of its square that is the samples' own scatter
    spoilt: bool = False  # whether a photo counts for less than half of what it claims


def cross_validate(
    samples: Sequence[PsfSample],
    settings: ModelSettings,
    local: LocalKernels,
    where: NDArray[np.float64],
    base: NDArray[np.float64],
) -> CrossValidation:
    """Weigh samples at points `where` (n, 7), of weights `base`, robustly and note their held-out errors."""
    errors, noise = np.full(len(samples), _UNKNOWN_ERROR), np.zeros(len(samples))
    rows = np.flatnonzero(base > 0)
    if len(rows) < 2:  # a single one cannot be left out
        return CrossValidation(base, errors, noise)
    if len(rows) > _SCORED:
        rows = rows[np.linspace(0, len(rows) - 1, _SCORED).round().astype(np.intp)]
    photo = np.unique([s.photo for s in samples], return_inverse=True)[1]
    held_out = HeldOut(
        local.upright(rows).reshape(len(rows), -1),
        where[rows],
        va.scales(bandwidths(where, settings)),
        base[rows],
        _held_together(photo, where[:, 5])[rows],
    )
    of_photos = np.ones(photo.max() + 1)
    known, own_photo = np.unique(photo[rows], return_inverse=True)
    by_sample, of_photos[known], errors[rows] = held_out.robust(own_photo)
    noise[rows] = np.minimum(held_out.noise(), errors[rows] ** 2)
    others = np.setdiff1d(np.arange(len(samples)), rows)
    errors[others], noise[others] = np.median(errors[rows]), np.median(noise[rows])
    if settings.mode == PAPER:
        return CrossValidation(base, errors, noise)
    weights = base * of_photos[photo]
    weights[rows] *= by_sample
    return CrossValidation(weights, errors, noise, bool((of_photos < _SPOILT).any()))


class HeldOut:
    """What samples of other groups say of each sample.

    `kernels` (n, m) are flat, at points `where` (n, 7); `scale` are bandwidths, `claims` (n,) the weights of
    the samples; those of one of `groups` (n,) are held out together.
    """

    def __init__(
        self,
        kernels: NDArray[np.floating],
        where: NDArray[np.float64],
        scale: NDArray[np.float64],
        claims: NDArray[np.float64],
        groups: NDArray[np.intp],
    ) -> None:
        kernels = np.asarray(kernels, dtype=np.float64)  # errors are small differences of these products
        self._gram = kernels @ kernels.T
        self._own = np.maximum(np.diag(self._gram), 1e-30)
        squared = (np.nan_to_num((where[:, None, :] - where[None, :, :]) / scale, nan=0.0) ** 2).sum(axis=-1)
        squared[groups[:, None] == groups[None, :]] = np.inf
        nearest = squared.min(axis=1, keepdims=True)
        weight = claims * np.exp(-0.5 * (squared - np.where(np.isfinite(nearest), nearest, 0.0)))
        self._weights = _of_sum_one(weight)  # Nadaraya-Watson weights of the others

    def errors(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Relative L2 of each sample against its weighted mean of others."""
        mean = weight @ self._gram
        squared = np.diag(self._gram) - 2 * np.diag(mean) + np.einsum("ij,ij->i", mean, weight)
        return np.where(weight.sum(axis=1) > 0, np.sqrt(np.maximum(squared, 0.0) / self._own), 1.0)

    def noise(self) -> NDArray[np.float64]:
        """Squared relative scatter of each sample's others about their weighted mean.

        It is sum_j w_j |C_j - f|^2 / (1 - sum_j w_j^2), over the sample's |C_i|^2.
        """
        weight = self._weights
        spread = weight @ np.diag(self._gram) - np.einsum("ij,ij->i", weight @ self._gram, weight)
        free = np.maximum(1.0 - (weight**2).sum(axis=1), 0.1)
        return np.asarray(np.maximum(spread, 0.0) / free / self._own)

    def robust(
        self, photos: NDArray[np.intp]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Factors on the weights of samples and of photos (0 to the last), and the held-out errors."""
        count = int(photos.max()) + 1
        by_sample, by_photo = np.ones(photos.size), np.ones(count)
        errors = self.errors(self._weights)
        for _ in range(_ROUNDS if count >= _MIN_PHOTOS else 0):
            errors = self.errors(_of_sum_one(self._weights * (by_sample * by_photo[photos])))
            medians = np.array([np.median(errors[photos == p]) for p in range(count)])
            by_photo = _biweight(medians, medians, floor=0.25)
            by_sample = _biweight(errors, errors[by_photo[photos] > _SPOILT], floor=0.35)
        return by_sample, by_photo, errors


def _of_sum_one(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    total = weight.sum(axis=1, keepdims=True)
    return np.asarray(weight / np.where(total > 0, total, 1.0))


def _biweight(
    values: NDArray[np.float64], reference: NDArray[np.float64], *, floor: float
) -> NDArray[np.float64]:
    """Tukey's weights by the median and the spread of a reference."""
    middle = float(np.median(reference))
    spread = 1.4826 * float(np.median(np.abs(reference - middle)))
    spread = max(spread, floor * middle, 0.01)  # few photos that agree by chance condemn none
    t = np.maximum(values - middle, 0.0) / (_TUKEY * spread)
    return np.asarray(np.where(t < 1.0, (1.0 - t * t) ** 2, 0.0))


def _held_together(photo: NDArray[np.intp], octaves: NDArray[np.float64]) -> NDArray[np.intp]:
    """Group samples by photo; those of a photo that is alone at its focal length are held out one by one."""
    groups = photo.copy()  # without that photo the error would be that of zooming, not of its samples
    for number in np.unique(photo):
        own = photo == number
        known = octaves[own & ~np.isnan(octaves)]
        middle = float(np.median(known)) if known.size else math.nan
        if not (~own & ~(np.abs(octaves - middle) > _ONE_FOCAL_LENGTH)).any():
            groups[own] = len(photo) + np.flatnonzero(own)
    return groups
