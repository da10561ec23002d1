"""Nadaraya-Watson regression over kernels in rotated local frames (paper, section 6.2, eq. 4-8).

The weight of a sample factorises into one of place and settings, common to all its pixels, and one of (u, v).
So the sum over all pixels of all samples is one of kernels::

    f(u, v) = sum_i W_i C_i(u, v) / sum_i W_i

with C_i the sample's kernel in its own radial frame. Departures from the paper: n in eq. (8) counts PSFs, not
pixels; the smoothing over (u, v) is that of the spline, because a bandwidth of pixels would widen the PSF;
unless the mode is "paper", kernels are scaled to the width of the place before averaging (`transport`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import pitch as pitches
from lensmodel.model import support
from lensmodel.model import variables as va
from lensmodel.model.answer import ModelSettings
from lensmodel.model.field.cross_validation import CrossValidation, bandwidth, cross_validate
from lensmodel.model.field.index import SampleIndex
from lensmodel.model.field.local_frame import Answers, LocalKernels
from lensmodel.model.field.neighbourhood import Neighbourhood
from lensmodel.model.field.smoothers import smoothers
from lensmodel.model.field.transport import WidthField

GROWTH: Final = 0.05
"""Growth after which all is fitted anew: eq. (8) moves bandwidths by a hundredth until then (chosen)."""

_DRIFT: Final = 0.15
"""Relative L2 error for each unit of `support` beyond the first between a question and the nearest sample
(chosen: kernels change by as much)."""

_WIDEST: Final = 255
"""Pixels along a side of the widest kernel that is made for coarser pixels to be asked for: memory."""


@dataclass(frozen=True, slots=True, eq=False)
class Regression:
    """Kernels of samples, prepared for questions.

    Parameters
    ----------
    pitch_um : float or None
        Pixel pitch that all kernels are brought to; None where none is known.
    size : int
        How many samples it was fitted to; those added since keep what was fitted.
    widths : WidthField
    local : LocalKernels
    index : SampleIndex
        Points of the samples.
    where : ndarray, shape (n, 5)
        The same in units of `support`.
    validation : CrossValidation
    expected : ndarray, shape (n,)
        Errors that the estimators expect of their samples; 0 where they expect nothing.
    photos : ndarray of str, shape (n,)
    rule, bandwidth : dict
        Bandwidths of eq. (8), and those in use.
    neighbourhood : Neighbourhood
        Which samples answer a question, and with which weights.
    """

    pitch_um: float | None
    size: int
    widths: WidthField
    local: LocalKernels
    index: SampleIndex
    where: NDArray[np.float64]
    validation: CrossValidation
    expected: NDArray[np.float64]
    photos: NDArray[np.object_]
    rule: dict[str, float]
    bandwidth: dict[str, float]
    neighbourhood: Neighbourhood

    @classmethod
    def of(cls, samples: Sequence[PsfSample], settings: ModelSettings) -> Regression:
        """Fit widths, bandwidths and robust weights.

        Raises
        ------
        NoSamplesError
            If no sample has a weight.
        """
        settings = settings.regression
        base = np.array([s.weight for s in samples])
        if not (base > 0).any():
            raise NoSamplesError(f"none of the {len(samples)} samples has a weight; include a photo again")
        smoother = smoothers.create(settings.method)
        pitch_um = pitches.usual_pitch(samples)
        common = pitches.at_pitch(samples, pitch_um)
        index = SampleIndex.of(va.points(common))
        widths = WidthField.fit(common, base) if smoother.transport else WidthField()
        local = LocalKernels.of(common, index.points, widths)
        validation = cross_validate(common, settings, local, index.points, base)
        if smoother.transport and any(flag.sample is None for flag in validation.flags):
            # a spoilt photo has bent the widths too: fit them again without it
            widths = WidthField.fit(common, validation.votes)
            local = local.rescaled(index.points, widths)
            validation = cross_validate(common, settings, local, index.points, base)
        rule = va.bandwidths(index.points)
        used = bandwidth(rule, settings, validation.choice)
        return cls(
            *(pitch_um, len(samples), widths, local, index, support.points(common), validation),
            *(_expected(samples), _photos(samples), rule, used),
            Neighbourhood(index, validation.votes, va.scales(used), smoother),
        )

    def takes(self, samples: Sequence[PsfSample]) -> bool:
        """Whether samples can join without fitting everything anew: they have room, and are few."""
        total = len(self.where) + len(samples)
        sides = [pitches.side_at(s, self.pitch_um) for s in samples]
        return total <= (1.0 + GROWTH) * self.size and max(sides) <= self.local.side

    def extended(self, samples: Sequence[PsfSample]) -> Regression:
        """Return it with more samples; widths, bandwidths and weights stay as they were fitted."""
        common = pitches.at_pitch(samples, self.pitch_um)
        points = va.points(common)
        index = self.index.extended(points)
        validation = self.validation.extended(np.array([s.weight for s in samples]))
        return replace(
            self,
            local=self.local.extended(common, points, self.widths),
            index=index,
            where=np.concatenate([self.where, support.points(common)]),
            validation=validation,
            expected=np.concatenate([self.expected, _expected(samples)]),
            photos=np.concatenate([self.photos, _photos(samples)]),
            neighbourhood=replace(self.neighbourhood, index=index, votes=validation.votes),
        )

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Return the neighbours of some places and their weights."""
        return self.neighbourhood.near(positions, settings)

    def kernels(
        self,
        near: Answers,
        positions: Sequence[FieldPosition],
        settings: LensSettings,
        size: int,
        pitch_um: float | None,
    ) -> NDArray[np.float64]:
        """Return the kernels that neighbours make, in pixels of some pitch, shape (q, size, size)."""
        widths = self.widths.over(np.array([va.point(p, settings) for p in positions]))
        angles = np.array([p.phi for p in positions])
        own, mirror = self.pitch_um, self.validation.choice.mirror
        if own is None or pitch_um is None or pitches.alike(own, pitch_um):
            return self.local.kernels(near, angles, widths, size, mirror)
        inside = min(2 * math.ceil(size / 2 * pitch_um / own) + 1, max(_WIDEST, size))
        kernels = self.local.kernels(near, angles, widths, inside, mirror)
        return np.stack([pitches.rescaled(kernel, own, pitch_um, size) for kernel in kernels])

    def error(self, near: Answers, found: support.Support) -> float:
        """Expected relative L2 error of one answer.

        With held-out errors h, of which the scatter s of neighbours is a part, m independent photos, and what
        the estimators expect t, all near the place, and the distance d to the nearest sample::

            own^2 = max(h^2 - s^2 (1 + 1/m), h^2 / 9) + s^2 / m       shared^2 = max(t^2 - s^2, t^2 / 4)
            error^2 = own^2 + shared^2 + (0.15 max(d - 1, 0))^2

        Estimators that err alike do not scatter: at least half of what they expect is taken for shared.
        """
        weight, rows = near.shares, near.rows
        _, number = np.unique(self.photos[rows].astype(str), return_inverse=True)
        independent = 1.0 / float((np.bincount(number, weight) ** 2).sum())
        held_out = float(weight @ self.validation.errors[rows] ** 2)
        scatter = min(float(weight @ self.validation.noise[rows]), held_out)
        own = max(held_out - scatter * (1.0 + 1.0 / independent), held_out / 9.0) + scatter / independent
        expected = float(weight @ self.expected[rows] ** 2)
        if len(self.where) == 1 and expected > 0.0:
            own = 0.0  # no other sample foretells it
        shared = max(expected - scatter, expected / 4.0)
        drift = _DRIFT * max(found.nearest - 1.0, 0.0)
        return min(math.sqrt(own + shared + drift * drift), 1.0)

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels."""
        return self.local.nbytes


def _expected(samples: Sequence[PsfSample]) -> NDArray[np.float64]:
    return np.array([0.0 if s.error is None else min(s.error, 1.0) for s in samples])


def _photos(samples: Sequence[PsfSample]) -> NDArray[np.object_]:
    return np.array([s.photo for s in samples], dtype=object)
