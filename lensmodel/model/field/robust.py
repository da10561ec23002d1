"""Which photos and samples do not fit the others, how much they count less, and why.

Leave-one-photo-out errors d_i say how badly each sample fits. A spoilt photo (defocus, shake, another
lens) spoils all its samples, so photos are judged first, by their median, then samples::

    q_i <- q_i psi((d_i - median d) / s),   psi(t) = (1 - (t / c)^2)^2 below c = 4.685, else 0

psi is Tukey's biweight; a sample that fits better than the median keeps its vote. Nothing is removed:
a sample of vote zero stays listed with its reason, and one may exclude or include photos by hand.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample, second_moments
from lensmodel.model.field.leave_one_out import HeldOut

_TUKEY = 4.685  # 95 % efficiency for normal errors (P. J. Huber, "Robust Statistics", 1981: Tukey's biweight)
_ROUNDS = 4  # of reweighting: each costs as much, and later ones change the votes less (chosen)
_MIN_PHOTOS = 3  # with two nobody knows which one is wrong
_LISTED = 0.5
"""Weight below which a photo is named: it then counts for less than half of what it claims (chosen)."""


@dataclass(frozen=True, slots=True)
class Flag:
    """A photo or sample that counts less than it claimed.

    Parameters
    ----------
    photo : str
        Photo id as in the samples.
    sample : int or None
        Row of the sample in the model; None = the whole photo.
    factor : float
        What its vote was multiplied by, 0..1.
    error : float
        Its relative L2 against the model of the other photos (median, for a photo).
    reason : str
        In plain words.
    """

    photo: str
    sample: int | None
    factor: float
    error: float
    reason: str


def factors(
    held: HeldOut, photos: NDArray[np.intp], *, r: float, phi: float, mirror: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Factors on the votes of samples.

    Returns
    -------
    by_sample, by_photo, errors : ndarray, shape (n,), (photos,), (n,)
        All ones with fewer than three photos: two that differ do not say which is wrong.
    """
    count = int(photos.max()) + 1
    by_sample, by_photo = np.ones(photos.size), np.ones(count)
    errors = held.errors(r, phi, mirror)
    if count < _MIN_PHOTOS:
        return by_sample, by_photo, errors
    plain = held.weights(r, phi)
    for _ in range(_ROUNDS):
        weight = plain * (by_sample * by_photo[photos])
        total = weight.sum(axis=1, keepdims=True)
        errors = held.errors_of(weight / np.where(total > 0, total, 1.0), mirror)
        medians = np.array([np.median(errors[photos == p]) for p in range(count)])
        by_photo = _biweight(medians, floor=0.25)
        trusted = errors[by_photo[photos] > _LISTED]
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


def flags(
    samples: Sequence[PsfSample],
    by_sample: NDArray[np.float64],
    by_photo: NDArray[np.float64],
    errors: NDArray[np.float64],
    names: Sequence[str],
) -> tuple[Flag, ...]:
    """List photos, then samples, whose votes were halved or worse."""
    flags = []
    for p, name in enumerate(names):
        rows = [i for i, s in enumerate(samples) if s.photo == name]
        if by_photo[p] < _LISTED:
            others = [i for i, s in enumerate(samples) if s.photo != name]
            reason = _reason([samples[i] for i in rows], [samples[i] for i in others])
            flags.append(Flag(name, None, float(by_photo[p]), float(np.median(errors[rows])), reason))
    whole = {flag.photo for flag in flags}
    for i, sample in enumerate(samples):
        if by_sample[i] < _LISTED and sample.photo not in whole:
            near = sorted(
                (s for s in samples if s.photo != sample.photo),
                key=lambda s, r=sample.position.r: abs(s.position.r - r),  # type: ignore[misc] # bound per round
            )[:12]
            flags.append(
                Flag(sample.photo, i, float(by_sample[i]), float(errors[i]), _reason([sample], near))
            )
    return tuple(flags)


def _reason(these: Sequence[PsfSample], others: Sequence[PsfSample]) -> str:
    """Say how kernels differ from others near them: wider, elongated all one way, sharper, or else."""
    shapes = [second_moments(s.kernel) for s in these]
    mean = np.mean(shapes, axis=0)
    usual = np.mean([second_moments(s.kernel) for s in others], axis=0) if others else mean
    ratio = math.sqrt(max(float(np.trace(mean)), 1e-6) / max(float(np.trace(usual)), 1e-6))
    excess = np.linalg.eigvalsh(mean - usual)
    if ratio > 1.15:
        if excess[1] > 4.0 * abs(excess[0]):
            return (
                f"{ratio:.1f} times as wide as the other photos and stretched one way: camera shake or motion"
            )
        return f"{ratio:.1f} times as wide as the other photos: out of focus"
    if ratio < 0.87:
        return f"{ratio:.1f} times as wide as the other photos: sharpened, or of another lens"
    return "as wide as the other photos but of another shape: perhaps another lens"
