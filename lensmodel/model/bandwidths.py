"""Bandwidths by eq. (8) of the paper and by leaving one photo out; with that robust weights, held-out errors.

Every answer is a linear combination f_i = sum_j w_ij C_j, so the squared error of all held-out
samples follows from the Gram matrix G = C C' alone::

    |C_i - f_i|^2 = G_ii - 2 (W G)_ii + (W G W')_ii

Trying another bandwidth costs products of n x n matrices and touches no kernel. Samples of one
photo share its shake, focus and noise: leaving out single samples would be optimistic. With a
single photo there is no other choice, and each sample is its own group.

A spoilt photo (defocus, shake, another lens) spoils all its samples, so photos are judged first, by the
median of their held-out errors d_i, then samples::

    q_i <- q_i psi((d_i - median d) / s),   psi(t) = (1 - (t / c)^2)^2 below c = 4.685, else 0

psi is Tukey's biweight; a sample that fits better than the median keeps its weight.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import WAVELENGTH_NM
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

MULTIPLES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Of the bandwidth by the rule: in steps of a root of two, in which errors hardly differ (chosen)."""
PHI_MULTIPLES = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0, 20.0)
"""The same around the centre; 20 means rotational symmetry, and 4 is halfway to it (chosen)."""
_CAP = 1.5  # relative errors beyond count no more than this: one outlier chooses nothing (chosen)
_AS_GOOD, _NEGLIGIBLE = 1.01, 1e-3  # errors nearer than this are equal: their difference is noise (chosen)
_CV_PHOTOS = 3
"""Photos from which on leaving one out tells of bandwidths: of two, one would foretell one (chosen)."""
_CV_SAMPLES = 300  # that the search looks at: its cost grows with their square (chosen)
_SCORED = 800
"""Samples whose held-out error is measured, for the same reason; the others get the median (chosen)."""
ONE_FOCAL_LENGTH = 0.25
"""Octaves within which focal lengths are one (chosen: over a fifth of it lenses hardly change)."""
_UNKNOWN_ERROR = 0.5  # of samples that no other one foretells (chosen: halfway to no knowledge)
_FEWEST = 2  # one sample cannot be left out
_TUKEY = 4.685  # 95 % efficiency for normal errors (P. J. Huber, "Robust Statistics", 1981: Tukey's biweight)
_ROUNDS = 4  # of reweighting: each costs as much, and later ones change the weights less (chosen)
_MIN_PHOTOS = 3  # with two nobody knows which one is wrong
_SPOILT = 0.5  # factor below which a photo is spoilt: it counts for less than half of its claim (chosen)


def reference_bandwidth(sigma: float, dimensions: int, count: int) -> float:
    """Bandwidth by the normal reference rule, h = sigma (4 / ((d + 2) n))^(1 / (d + 4)), eq. (8)."""
    return sigma * (4.0 / ((dimensions + 2) * max(count, 1))) ** (1.0 / (dimensions + 4))


def by_rule(where: NDArray[np.float64]) -> dict[str, float]:
    """Bandwidths of place and settings by eq. (8), apart from those of (u, v).

    n counts PSF samples of one channel, not their pixels: a million pixels of one PSF say nothing
    about another place. d counts the place and those settings that vary.
    """
    _, counts = np.unique(where[:, 4], return_counts=True)
    varying = [3, 5, 6]
    spread = {column: float(np.nanstd(_known(where[:, column]))) for column in varying}
    d = 2 + sum(value > _SAME for value in spread.values())
    n = int(counts.max())
    bandwidths = {
        "r": max(_PLACE_SHARE * reference_bandwidth(float(where[:, 0].std()), d, n), _FLOOR_R),
        "phi": max(_PLACE_SHARE * reference_bandwidth(math.sqrt(0.5), d, n), _FLOOR_PHI),
        **FALLBACK,
    }
    for column, sigma in spread.items():
        name = va.COLUMNS[column]
        if sigma > _SAME:
            bandwidths[name] = min(FALLBACK[name], reference_bandwidth(sigma, d, n))
    return bandwidths


def _of_support(widths: Mapping[str, float]) -> dict[str, float]:
    """Bandwidths of eq. (8) itself: by them one tells near from far, whatever smoothing is best."""
    return {**widths, "r": widths["r"] / _PLACE_SHARE, "phi": widths["phi"] / _PLACE_SHARE}


def _known(values: NDArray[np.float64]) -> NDArray[np.float64]:
    known = values[~np.isnan(values)]
    return known if known.size else np.zeros(1)


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Samples prepared for cross-validation."""

    gram: NDArray[np.float64]  # (n, n), products <C_i, C_j>
    place: NDArray[np.float64]  # (n, n), squared distances in r, in phi and in the settings, in bandwidths
    turn: NDArray[np.float64]
    others: NDArray[np.float64]
    claims: NDArray[np.float64]  # (n,)
    groups: NDArray[np.intp]  # (n,), samples that are held out together

    @classmethod
    def of(
        cls,
        rows: NDArray[np.floating],
        where: NDArray[np.float64],
        scale: NDArray[np.float64],
        claims: NDArray[np.float64],
        groups: NDArray[np.intp],
    ) -> HeldOut:
        """Prepare kernels given as flat rows of a square grid, at points `where` (n, 7)."""
        rows = np.asarray(rows, dtype=np.float64)  # errors are small differences of these products
        gap = np.nan_to_num((where[:, None, :] - where[None, :, :]) / scale, nan=0.0) ** 2
        return cls(
            gram=rows @ rows.T,
            place=gap[..., 0],
            turn=gap[..., 1] + gap[..., 2],
            others=gap[..., 3:].sum(axis=-1),
            claims=claims,
            groups=groups,
        )

    def errors(self, r: float = 1.0, phi: float = 1.0) -> NDArray[np.float64]:
        """Relative L2 of each sample against the model of the other groups."""
        return self.errors_of(self.weights(r, phi))

    def weights(self, r: float = 1.0, phi: float = 1.0) -> NDArray[np.float64]:
        """Held-out Nadaraya-Watson weights, rows of sum 1."""
        squared = self.place / r**2 + self.turn / phi**2 + self.others
        squared = np.where(self.groups[:, None] == self.groups[None, :], np.inf, squared)
        nearest = squared.min(axis=1, keepdims=True)
        weight = self.claims * np.exp(-0.5 * (squared - np.where(np.isfinite(nearest), nearest, 0.0)))
        total = weight.sum(axis=1, keepdims=True)
        return np.asarray(weight / np.where(total > 0, total, 1.0))

    def errors_of(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Relative L2 of each sample against its weighted mean of others."""
        own = np.diag(self.gram)
        mean = weight @ self.gram
        squared = own - 2 * np.diag(mean) + np.einsum("ij,ij->i", mean, weight)
        relative = np.sqrt(np.maximum(squared, 0.0) / np.maximum(own, 1e-30))
        return np.where(weight.sum(axis=1) > 0, relative, 1.0)

    def noise(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Squared relative scatter of each sample's others about their weighted mean.

        From the weights of `weights`: sum_j w_j |C_j - f|^2 / (1 - sum_j w_j^2), over the sample's |C_i|^2.
        """
        own = np.diag(self.gram)
        spread = weight @ own - np.einsum("ij,ij->i", weight @ self.gram, weight)
        free = np.maximum(1.0 - (weight**2).sum(axis=1), 0.1)
        return np.asarray(np.maximum(spread, 0.0) / free / np.maximum(own, 1e-30))

    def score(self, errors: NDArray[np.float64]) -> float:
        """Mean error by weight; gross errors count at most 1.5."""
        return float(np.average(np.minimum(errors, _CAP), weights=np.maximum(self.claims, 1e-9)))


@dataclass(frozen=True, slots=True)
class Choice:
    """Factors on the bandwidths in r and phi that cross-validation chose."""

    r: float = 1.0
    phi: float = 1.0
    error: float = 1.0


def choose_factors(held: HeldOut, *, r: bool = True, phi: bool = True) -> Choice:
    """Search the factors, each only where it is free, for the least held-out error."""

    def best(options: Iterable[Choice]) -> Choice:
        # the least reach among those that are as good: far neighbours cost time and trust in a symmetry
        tried = list(options)
        least = min(choice.error for choice in tried)
        return next(choice for choice in tried if choice.error <= least * _AS_GOOD + _NEGLIGIBLE)

    def at(r_: float, phi_: float) -> Choice:
        return Choice(r_, phi_, held.score(held.errors(r_, phi_)))

    chosen = at(1.0, 1.0)
    for _ in range(2):
        before = chosen
        if r:
            chosen = best(at(factor, chosen.phi) for factor in MULTIPLES)
        if phi:
            chosen = best(at(chosen.r, factor) for factor in PHI_MULTIPLES)
        if (chosen.r, chosen.phi) == (before.r, before.phi):
            break
    return chosen


def robust_factors(
    held: HeldOut, photos: NDArray[np.intp], choice: Choice
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Factors on the weights of samples and of photos, and the held-out errors."""
    count = int(photos.max()) + 1
    by_sample, by_photo = np.ones(photos.size), np.ones(count)
    plain = held.weights(choice.r, choice.phi)
    errors = held.errors_of(plain)
    for _ in range(_ROUNDS if count >= _MIN_PHOTOS else 0):
        weight = plain * (by_sample * by_photo[photos])
        total = weight.sum(axis=1, keepdims=True)
        errors = held.errors_of(weight / np.where(total > 0, total, 1.0))
        medians = np.array([np.median(errors[photos == p]) for p in range(count)])
        by_photo = _biweight(medians, floor=0.25)
        trusted = errors[by_photo[photos] > _SPOILT]
        by_sample = _biweight(errors, reference=trusted if trusted.size else errors, floor=0.35)
    return by_sample, by_photo, errors


def _biweight(
    values: NDArray[np.float64], *, floor: float, reference: NDArray[np.float64] | None = None
) -> NDArray[np.float64]:
    base = values if reference is None else reference
    middle = float(np.median(base))
    spread = 1.4826 * float(np.median(np.abs(base - middle)))
    spread = max(spread, floor * middle, 0.01)  # few photos that agree by chance condemn none
    t = np.maximum(values - middle, 0.0) / (_TUKEY * spread)
    return np.asarray(np.where(t < 1.0, (1.0 - t * t) ** 2, 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """What the samples say of each other."""

    # (n,), weights after robust weighting; held-out relative L2; the part of its square that is the samples'
    # own scatter
    weights: NDArray[np.float64]
    errors: NDArray[np.float64]
    noise: NDArray[np.float64]
    choice: Choice
    spoilt: bool = False  # whether a photo counts for less than half of what it claims


def bandwidth(rule: dict[str, float], settings: ModelSettings, choice: Choice) -> dict[str, float]:
    """Bandwidths of a rule, factors of cross-validation and the wishes of a user."""
    bandwidths = rule = _of_support(rule) if settings.mode == PAPER else dict(rule)
    bandwidths["r"] = settings.r or rule["r"] * choice.r
    bandwidths["phi"] = settings.phi or rule["phi"] * choice.phi
    bandwidths["aperture_stops"] = settings.stops or rule["aperture_stops"]
    return bandwidths


def held_together(samples: Sequence[PsfSample], photo: NDArray[np.intp]) -> NDArray[np.intp]:
    """Group samples by photo; those of a photo that is alone at its focal length are held out one by one.

    Without that photo nothing would be known of the focal length: that says how a lens changes when one
    zooms, not how well its samples agree.
    """
    groups = np.array(photo)
    octaves = np.array([math.log2(s.settings.focal_mm) if s.settings.focal_mm else math.nan for s in samples])
    for number in np.unique(photo):
        own = photo == number
        apart = (
            np.abs(octaves[~own] - np.nanmedian(octaves[own])) if (~np.isnan(octaves[own])).any() else None
        )
        alone = not (~own).any() if apart is None else bool((apart > ONE_FOCAL_LENGTH).all())
        if alone:
            groups[own] = len(samples) + np.flatnonzero(own)
    return groups


def cross_validate(
    samples: Sequence[PsfSample],
    settings: ModelSettings,
    local: LocalKernels,
    where: NDArray[np.float64],
    base: NDArray[np.float64],
) -> CrossValidation:
    """Choose bandwidths by cross-validation, weigh robustly, note held-out errors."""
    rule = by_rule(where)
    names, photo = np.unique([s.photo for s in samples], return_inverse=True)
    counting = np.flatnonzero(base > 0)
    several = len(np.unique(photo[counting])) >= 2
    groups = held_together(samples, photo)

    def held(rows: NDArray[np.intp], weights: NDArray[np.float64]) -> HeldOut:
        kernels = local.upright(rows)
        scale = va.scales(bandwidth(rule, settings, Choice()))
        return HeldOut.of(kernels.reshape(len(rows), -1), where[rows], scale, weights[rows], groups[rows])

    green = counting[where[counting, 4] == _judging_channel(where[counting, 4])]
    choice, paper = Choice(), settings.mode == PAPER
    automatic = not paper and len(np.unique(photo[counting])) >= _CV_PHOTOS

    def chosen(weights: NDArray[np.float64]) -> Choice:
        if not automatic:
            return choice
        few = held(_thinned(green, _CV_SAMPLES), weights)
        return choose_factors(few, r=settings.r is None, phi=settings.phi is None)

    scored = _thinned(counting, _SCORED)
    weights, errors = base.copy(), np.full(len(samples), _UNKNOWN_ERROR)
    noise = np.zeros(len(samples))
    if len(scored) < _FEWEST:
        return CrossValidation(weights, errors, noise, choice)
    choice = chosen(weights)
    prepared = held(scored, base)
    _, own_photo = np.unique(photo[scored], return_inverse=True)
    known = names[np.unique(photo[scored])]
    by_sample, by_photo, held_out = robust_factors(prepared, own_photo, choice)
    spoilt = False
    if not paper and several:
        own = {str(name): factor for name, factor in zip(known, by_photo, strict=True)}
        weighed = base * np.array([own.get(s.photo, 1.0) for s in samples])
        weighed[scored] *= by_sample
        if (weighed > 0).any():
            weights, spoilt = weighed, bool((by_photo < _SPOILT).any())
        if spoilt or bool((by_sample < _SPOILT).any()):
            choice = chosen(weights)
    scatter = np.minimum(prepared.noise(prepared.weights(choice.r, choice.phi)), held_out**2)
    errors[:], noise[:] = float(np.median(held_out)), float(np.median(scatter))
    errors[scored], noise[scored] = held_out, scatter
    return CrossValidation(weights, errors, noise, choice, spoilt)


def _judging_channel(wavelengths: NDArray[np.float64]) -> float:
    """Green, which has the least noise; without any, the channel of the most samples."""
    known, counts = np.unique(wavelengths, return_counts=True)
    green = WAVELENGTH_NM["g"]
    return green if green in known else float(known[counts.argmax()])


def _thinned(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.intp)]
