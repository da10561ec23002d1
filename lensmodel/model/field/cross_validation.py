"""What samples say of each other: bandwidths, robust votes and held-out errors of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import WAVELENGTH_NM
from lensmodel.model import variables as va
from lensmodel.model.answer import PAPER, ModelSettings
from lensmodel.model.field import robust
from lensmodel.model.field.leave_one_out import Choice, HeldOut, choose_factors
from lensmodel.model.field.local_frame import LocalKernels
from lensmodel.model.field.robust import Flag

_CV_PHOTOS = 3
"""Photos from which on leaving one out tells of bandwidths: of two, each would be foretold by one alone
(chosen)."""
_CV_SAMPLES = 300  # that the search looks at: its cost grows with their square (chosen)
_SCORED = 800
"""Samples whose held-out error is measured, for the same reason; the others get the median (chosen)."""
ONE_FOCAL_LENGTH = 0.25
"""Octaves within which focal lengths are one (chosen: over a fifth of it lenses hardly change)."""
_ROTATIONAL = 10.0  # chords of the circle: so wide that phi does not count
_UNKNOWN_ERROR = 0.5  # of samples that no other one foretells (chosen: halfway to no knowledge)
_FEWEST = 2  # one sample cannot be left out


@dataclass(frozen=True, slots=True, eq=False)
class CrossValidation:
    """What the samples say of each other.

    Parameters
    ----------
    votes, errors, noise : ndarray, shape (n,)
        Votes after robust weighting; held-out relative L2; the part of its square that is the samples'
        own scatter.
    choice : Choice
    flags : tuple of Flag
    """

    votes: NDArray[np.float64]
    errors: NDArray[np.float64]
    noise: NDArray[np.float64]
    choice: Choice
    flags: tuple[Flag, ...] = ()

    @property
    def usual(self) -> float:
        """Mean squared held-out error of the whole field."""
        return float(np.mean(self.errors**2))

    def extended(self, votes: NDArray[np.float64]) -> CrossValidation:
        """Return it with samples that were not scored: the usual errors, the votes that they claim."""

        def longer(values: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.concatenate([values, np.full(len(votes), float(np.median(values)))])

        return replace(
            self,
            votes=np.concatenate([self.votes, votes]),
            errors=longer(self.errors),
            noise=longer(self.noise),
        )


def bandwidth(rule: dict[str, float], settings: ModelSettings, choice: Choice) -> dict[str, float]:
    """Bandwidths of a rule, factors of cross-validation and the wishes of a user."""
    bandwidths = rule = va.support_widths(rule) if settings.mode == PAPER else dict(rule)
    bandwidths["r"] = settings.r or rule["r"] * choice.r
    phi = rule["phi"] * choice.phi
    if settings.rotational is not None:
        phi = rule["phi"] ** (1.0 - settings.rotational) * _ROTATIONAL**settings.rotational
    bandwidths["phi"] = settings.phi or phi
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
    """Choose bandwidths by cross-validation, weigh robustly, note held-out errors.

    Parameters
    ----------
    samples : sequence of PsfSample
    settings : ModelSettings
    local : LocalKernels
        Their kernels.
    where : ndarray, shape (n, 7)
        Their points.
    base : ndarray, shape (n,)
        Votes that they claim; those of 0 take no part.
    """
    rule = va.bandwidths(where)
    names, photo = np.unique([s.photo for s in samples], return_inverse=True)
    voting = np.flatnonzero(base > 0)
    several = len(np.unique(photo[voting])) >= 2
    groups = held_together(samples, photo)

    def held(rows: NDArray[np.intp], votes: NDArray[np.float64]) -> HeldOut:
        kernels = local.upright(rows)
        scale = va.scales(bandwidth(rule, settings, Choice()))
        flat = kernels.reshape(len(rows), -1)
        return HeldOut.of(flat, kernels.shape[1], where[rows], scale, votes[rows], groups[rows])

    green = voting[where[voting, 4] == _judging_channel(where[voting, 4])]
    choice = Choice(mirror=settings.mirror or 0.0)
    automatic = settings.mode != PAPER and len(np.unique(photo[voting])) >= _CV_PHOTOS

    def chosen(votes: NDArray[np.float64]) -> Choice:
        if not automatic:
            return choice
        factors = choose_factors(
            held(_thinned(green, _CV_SAMPLES), votes),
            r=settings.r is None,
            phi=settings.phi is None and settings.rotational is None,
            mirror=settings.mirror is None,
        )
        return factors if settings.mirror is None else replace(factors, mirror=settings.mirror)

    scored = _thinned(voting, _SCORED)
    votes, errors = base.copy(), np.full(len(samples), _UNKNOWN_ERROR)
    noise = np.zeros(len(samples))
    if len(scored) < _FEWEST:
        return CrossValidation(votes, errors, noise, choice)
    choice = chosen(votes)
    prepared = held(scored, base)
    _, own_photo = np.unique(photo[scored], return_inverse=True)
    known = names[np.unique(photo[scored])]
    by_sample, by_photo, held_out = robust.factors(
        prepared, own_photo, r=choice.r, phi=choice.phi, mirror=choice.mirror
    )
    flags: tuple[Flag, ...] = ()
    if settings.robust and several:
        own = {str(name): factor for name, factor in zip(known, by_photo, strict=True)}
        votes = base * np.array([own.get(s.photo, 1.0) for s in samples])
        votes[scored] *= by_sample
        flags = robust.flags(
            [samples[i] for i in scored], by_sample, by_photo, held_out, [str(n) for n in known]
        )
        flags = tuple(f if f.sample is None else replace(f, sample=int(scored[f.sample])) for f in flags)
        if not (votes > 0).any():
            votes, flags = base.copy(), ()
        if flags:
            choice = chosen(votes)
    scatter = np.minimum(prepared.noise(prepared.weights(choice.r, choice.phi)), held_out**2)
    errors[:], noise[:] = float(np.median(held_out)), float(np.median(scatter))
    errors[scored], noise[scored] = held_out, scatter
    return CrossValidation(votes, errors, noise, choice, flags)


def _judging_channel(wavelengths: NDArray[np.float64]) -> float:
    """Green, which has the least noise; without any, the channel of the most samples."""
    known, counts = np.unique(wavelengths, return_counts=True)
    green = WAVELENGTH_NM["g"]
    return green if green in known else float(known[counts.argmax()])


def _thinned(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.intp)]
