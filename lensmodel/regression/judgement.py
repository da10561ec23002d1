"""What samples say of each other: bandwidths, robust votes and held-out errors of a model."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.psf import PsfSample
from lensmodel.regression import kriging, robust
from lensmodel.regression import variables as va
from lensmodel.regression.answer import ModelSettings
from lensmodel.regression.canonical import CanonicalGrid
from lensmodel.regression.robust import Flag
from lensmodel.regression.smoothers import Smoother
from lensmodel.regression.store import KernelStore
from lensmodel.regression.transport import WidthField
from lensmodel.regression.validation import Choice, Held, choose

_CV_PHOTOS = 3
_CV_SAMPLES = 300
_JUDGED = 800
_STRIDE = 3
_ROTATIONAL = 10.0
_UNKNOWN_ERROR = 0.5
_TRANSPORT_ROOM = 1.35


@dataclass(frozen=True, slots=True, eq=False)
class Judgement:
    """What the samples say of each other: votes after robust weighting, held-out errors, flags."""

    votes: NDArray[np.float64]
    errors: NDArray[np.float64]
    choice: Choice
    flags: tuple[Flag, ...] = ()
    nugget: float = 1.0  # of the image frame
    image_errors: NDArray[np.float64] | None = None  # held out, of the image frame


def grid_of(samples: Sequence[PsfSample], settings: ModelSettings, smoother: Smoother) -> CanonicalGrid:
    """Grid that holds the largest kernel, with room for scaling."""
    half = max(s.kernel.shape[0] for s in samples) // 2
    room = _TRANSPORT_ROOM if smoother.transport else 1.0
    return CanonicalGrid(math.ceil(half * room), settings.oversampling)


def pixel_store(samples: Sequence[PsfSample]) -> KernelStore:
    """Kernels of the image frame, for `kriging`."""
    side = max(s.kernel.shape[0] for s in samples)
    return KernelStore(side * side).extended(kriging.pixel_rows(samples, side), len(samples))


def row_of(grid: CanonicalGrid, widths: WidthField, sample: PsfSample) -> NDArray[np.float32]:
    """Spline coefficients of a sample scaled to unit widths."""
    scale = widths.at(sample.position, sample.settings)
    return grid.coefficients(sample.kernel, sample.position.phi, scale)


def with_votes(samples: Sequence[PsfSample], votes: NDArray[np.float64]) -> list[PsfSample]:
    """Samples that vote, with their votes as weights."""
    return [s.with_weight(float(v)) for s, v in zip(samples, votes, strict=True) if v > 0]


def bandwidth(rule: dict[str, float], settings: ModelSettings, choice: Choice) -> dict[str, float]:
    """Bandwidths of a rule, factors of cross-validation and the wishes of a user."""
    found = dict(rule)
    found["r"] = settings.r or rule["r"] * choice.r
    phi = rule["phi"] * choice.phi
    if settings.rotational is not None:
        phi = rule["phi"] ** (1.0 - settings.rotational) * _ROTATIONAL**settings.rotational
    found["phi"] = settings.phi or phi
    found["aperture_stops"] = settings.stops or rule["aperture_stops"]
    return found


def judge(
    samples: tuple[PsfSample, ...],
    settings: ModelSettings,
    grid: CanonicalGrid,
    store: KernelStore,
    base: NDArray[np.float64],
    pixels: KernelStore | None,
) -> Judgement:
    """Choose bandwidths by cross-validation, weigh robustly, note held-out errors."""
    where = va.points(samples)
    rule = va.bandwidths(where)
    names, photo = np.unique([s.photo for s in samples], return_inverse=True)
    voting = np.flatnonzero(base > 0)
    several = len(np.unique(photo[voting])) >= 2
    groups = photo if several else np.arange(len(samples))

    def held(rows: NDArray[np.intp], votes: NDArray[np.float64]) -> Held:
        side = len(range(0, grid.side, _STRIDE))
        thin = store.rows[rows].reshape(len(rows), grid.side, grid.side)[:, ::_STRIDE, ::_STRIDE]
        scale = va.scales(bandwidth(rule, settings, Choice()))
        return Held.of(thin.reshape(len(rows), -1), side, where[rows], scale, votes[rows], groups[rows])

    green = voting[where[voting, 4] == where[voting[len(voting) // 2], 4]]
    choice = Choice(mirror=settings.mirror or 0.0)
    automatic = len(np.unique(photo[voting])) >= _CV_PHOTOS

    def chosen(votes: NDArray[np.float64]) -> Choice:
        if not automatic:
            return choice
        found = choose(
            held(_thinned(green, _CV_SAMPLES), votes),
            r=settings.r is None,
            phi=settings.phi is None and settings.rotational is None,
            mirror=settings.mirror is None,
        )
        return found if settings.mirror is None else replace(found, mirror=settings.mirror)

    judged = _thinned(voting, _JUDGED)
    votes, errors = base.copy(), np.full(len(samples), _UNKNOWN_ERROR)
    if len(judged) < 2:
        return Judgement(votes, errors, choice)
    choice = chosen(votes)
    prepared = held(judged, base)
    _, local = np.unique(photo[judged], return_inverse=True)
    known = names[np.unique(photo[judged])]
    by_sample, by_photo, found = robust.factors(
        prepared, local, r=choice.r, phi=choice.phi, mirror=choice.mirror
    )
    flags: tuple[Flag, ...] = ()
    if settings.robust and several:
        own = {str(name): factor for name, factor in zip(known, by_photo, strict=True)}
        votes = base * np.array([own.get(s.photo, 1.0) for s in samples])
        votes[judged] *= by_sample
        flags = robust.flags(
            [samples[i] for i in judged], by_sample, by_photo, found, [str(n) for n in known]
        )
        flags = tuple(f if f.sample is None else replace(f, sample=int(judged[f.sample])) for f in flags)
        if not (votes > 0).any():
            votes, flags = base.copy(), ()
        if flags:
            choice = chosen(votes)
    errors[:] = float(np.median(found))
    errors[judged] = found
    if pixels is None:
        return Judgement(votes, errors, choice, flags)
    trusted = judged[votes[judged] > 0]
    vectors = np.array([kriging.field_vector(samples[i].position) for i in trusted])
    nugget, seen = kriging.held_out_errors(
        pixels.rows[trusted],
        vectors,
        where[trusted],
        votes[trusted],
        va.scales(bandwidth(rule, settings, choice)),
        groups[trusted],
    )
    image_errors = np.full(len(samples), float(np.median(seen)))
    image_errors[trusted] = seen
    return Judgement(votes, errors, choice, flags, nugget, image_errors)


def _thinned(rows: NDArray[np.intp], most: int) -> NDArray[np.intp]:
    if len(rows) <= most:
        return rows
    return rows[np.linspace(0, len(rows) - 1, most).round().astype(np.intp)]
