"""The ends of a zoom: focal lengths at which enough samples were taken to be trusted alone.

One wavefront whose terms follow straight lines over the focal length (`wavefront`) lets few samples at one
end lean on many at the other. It must not cost those many anything: where the samples of one focal length are
not foretold clearly better with the help of the others, a wavefront of their own answers there. Its say falls
off as a Gaussian of the distance in octaves.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, distance
from lensmodel.core.types import LensSettings, StepHook, ignore_step
from lensmodel.model.wavefront.from_kernels import MIN_SAMPLES, ONE_FOCAL_LENGTH, focal_range, refined
from lensmodel.model.wavefront.physical_mean import Physics
from lensmodel.optics.wavefront import Wavefront

_REACH_OCTAVES, _SILENT = 0.15, 1e-3
"""Gaussian width of an end's say: a tenth of a focal length, over which a zoom changes little; and a say that
is none, since it changes nothing that is seen (chosen)."""
_HALVES = 2  # of the samples, each foretold by the other (chosen: the fewest fits)
_CLEARLY = 0.9  # of the error alone: others must help by a tenth (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class End:
    """One focal length of a zoom.

    Parameters
    ----------
    octaves : float
        log2 of the focal length in mm.
    physical : Physics
        Fitted to the samples of this focal length alone.
    """

    octaves: float
    physical: Physics

    def __post_init__(self) -> None:
        if not math.isfinite(self.octaves):
            raise InvalidInputError(f"a focal length must be finite octaves, got {self.octaves}")

    def share(self, settings: LensSettings) -> float:
        """Say in a question, 0..1; none where the focal length is unknown."""
        if settings.focal_mm is None:
            return 0.0
        gap = (math.log2(settings.focal_mm) - self.octaves) / _REACH_OCTAVES
        share = math.exp(-0.5 * gap * gap)
        return 0.0 if share < _SILENT else (1.0 if share > 1.0 - _SILENT else share)


def nearest(ends: Sequence[End], settings: LensSettings) -> tuple[End | None, float]:
    """The end that has the largest say in a question, and that; None if none has any."""
    shares = [(end.share(settings), number) for number, end in enumerate(ends)]
    share, number = max(shares, default=(0.0, 0))
    return (ends[number], share) if share > 0.0 else (None, 0.0)


def ends_of(
    samples: Sequence[PsfSample],
    votes: NDArray[np.float64],
    groups: NDArray[np.intp],
    scale: NDArray[np.float64],
    shared: Physics,
    on_step: StepHook = ignore_step,
) -> tuple[End, ...]:
    """Find the focal lengths that answer by themselves.

    Parameters
    ----------
    samples : sequence of PsfSample
        All of the lens, of one pixel pitch.
    votes, groups, scale
        As of `Physics.fit`.
    shared : Physics
        Fitted to all of them.
    on_step : StepHook
        Called as by `Physics.fit`, anew for each focal length.
    """
    if shared.front.slopes is None:
        return ()
    ends = []
    for rows in _one_by_one(samples, votes):
        own = Physics.fit(samples, _only(rows, votes), groups, scale, on_step)
        if own is None:
            continue
        voting = [samples[i].with_weight(float(votes[i])) for i in np.flatnonzero(votes > 0).tolist()]
        octaves = np.array([_octaves(s) for s in voting])
        here = float(np.median([_octaves(samples[i]) for i in rows.tolist()]))
        inside = np.abs(octaves - here) <= ONE_FOCAL_LENGTH / 2.0
        if own.agreed or not _better_together(own.front, shared.front, voting, inside):
            ends.append(End(here, own))
    return tuple(ends)


def _octaves(sample: PsfSample) -> float:
    focal = sample.settings.focal_mm
    return math.nan if focal is None else math.log2(focal)


def _only(rows: NDArray[np.intp], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    kept = np.zeros(len(votes))
    kept[rows] = votes[rows]
    return kept


def _one_by_one(samples: Sequence[PsfSample], votes: NDArray[np.float64]) -> list[NDArray[np.intp]]:
    """Rows of single focal lengths that are enough for a wavefront of their own."""
    octaves = np.array([_octaves(s) for s in samples])
    rows = np.flatnonzero((votes > 0) & np.isfinite(octaves))
    rows = rows[np.argsort(octaves[rows], kind="stable")]
    breaks = np.flatnonzero(np.diff(octaves[rows]) > ONE_FOCAL_LENGTH / 2.0) + 1
    return [
        np.sort(group)
        for group in np.split(rows, breaks)
        if len(group) >= MIN_SAMPLES and focal_range([samples[i] for i in group.tolist()]) <= ONE_FOCAL_LENGTH
    ]


def _better_together(
    own: Wavefront, shared: Wavefront, samples: Sequence[PsfSample], inside: NDArray[np.bool_]
) -> bool:
    """Whether halves of the samples of one focal length are foretold better with those of all others."""
    here = sorted(
        np.flatnonzero(inside).tolist(), key=lambda i: (samples[i].position.r, samples[i].position.phi)
    )
    others = [s for s, one in zip(samples, inside, strict=True) if not one]
    alone = together = 0.0
    for held in range(_HALVES):
        asked = [samples[i] for k, i in enumerate(here) if k % _HALVES == held]
        seen = [samples[i] for k, i in enumerate(here) if k % _HALVES != held]
        alone += _missed(refined(own, seen), asked)
        together += _missed(refined(shared, [*seen, *others]), asked)
    return together < _CLEARLY * alone


def _missed(front: Wavefront, asked: Sequence[PsfSample]) -> float:
    """Sum of the relative L2 of samples against a wavefront."""
    return sum(
        s.weight * distance(front.kernel(s.position, s.settings, s.kernel.shape[0]), s.kernel).rel_l2
        for s in asked
    )
