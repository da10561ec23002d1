"""What is made of samples before the first question: kernels, widths, bandwidths, votes, estimates."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings, StepHook, ignore_step
from lensmodel.model import pitch as pitches
from lensmodel.model import variables as va
from lensmodel.model.answer import BOTH, MICROMETRE, ModelSettings
from lensmodel.model.far_light import FarLight, bounds_of
from lensmodel.model.field.cross_validation import CrossValidation, bandwidth, cross_validate, held_together
from lensmodel.model.field.index import SampleIndex
from lensmodel.model.field.local_frame import LocalKernels
from lensmodel.model.field.smoothers import smoothers
from lensmodel.model.field.transport import WidthField
from lensmodel.model.wavefront.physical_mean import Physics
from lensmodel.model.wavefront.zoom import End, ends_of, nearest
from lensmodel.optics.wavefront import Wavefront

INCREMENT: Final = 0.05
"""Growth after which all is fitted anew: eq. (8) moves bandwidths by a hundredth until then (chosen)."""
GROWTH: Final = 1.0
"""The same for answers that only bridge the time until a whole fit is there: with twice the samples
bandwidths would be about a tenth narrower (chosen)."""
_MOSTLY = 0.5  # an end that answers by more than a half gives the fit that is shown (by definition)


@dataclass(frozen=True, slots=True, eq=False)
class Roster:
    """Numbers of photos by name, and the photo of each sample, shape (n,)."""

    numbers: dict[str, int]
    photo: NDArray[np.intp]

    @classmethod
    def of(cls, samples: Sequence[PsfSample]) -> Roster:
        """Number the photos in the order of their first samples."""
        return cls({}, np.empty(0, dtype=np.intp)).extended(samples)

    def extended(self, samples: Sequence[PsfSample]) -> Roster:
        """Return it with more samples."""
        numbers = dict(self.numbers)
        own = [numbers.setdefault(s.photo, len(numbers)) for s in samples]
        return Roster(numbers, np.concatenate([self.photo, np.array(own, dtype=np.intp)]))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """A model's samples, prepared for questions.

    Parameters
    ----------
    pixel : float or None
        Pixel, in the unit of the settings, that all kernels are brought to; None where none is known.
    size : int
        How many samples it was fitted to; those added since keep what was fitted.
    widths : WidthField
    local : LocalKernels
    index : SampleIndex
        Points of the samples.
    roster : Roster
    validation : CrossValidation
    expected : ndarray, shape (n,)
        Squared errors that the estimators expect of their samples; 0 where they expect nothing.
    has_spectrum : ndarray of bool, shape (n,)
        Which samples carry the spectrum of their patch.
    rule, bandwidth : dict
        Bandwidths of eq. (8), and those in use.
    physical : Physics or None
        None until `warmed`, or if it takes no part.
    ends : tuple of End
        Of a zoom: focal lengths that answer by a wavefront of their own.
    darkest : ndarray, shape (n,)
        Bounds of far light that samples carry; NaN where one carries none.
    heard : tuple of PsfSample
        Of a photo that is to be corrected: they bound far light too, and say nothing else here.
    former : tuple of Wavefront
        Of fits to fewer samples: where `warmed` begins, besides all other beginnings.
    mode : str
        Which mode answers.
    unit : str
        That of the settings.
    """

    pixel: float | None
    size: int
    widths: WidthField
    local: LocalKernels
    index: SampleIndex
    roster: Roster
    validation: CrossValidation
    expected: NDArray[np.float64]
    has_spectrum: NDArray[np.bool_]
    rule: dict[str, float]
    bandwidth: dict[str, float]
    darkest: NDArray[np.float64]
    heard: tuple[PsfSample, ...] = ()
    physical: Physics | None = None
    mode: str = BOTH
    unit: str = MICROMETRE
    ends: tuple[End, ...] = ()
    former: tuple[Wavefront, ...] = ()

    @classmethod
    def of(cls, samples: Sequence[PsfSample], settings: ModelSettings) -> Fit:
        """Fit everything but the wavefront, which `warmed` adds.

        Raises
        ------
        NoSamplesError
            If there are none, or none may vote.
        UnknownMethodError
            If `settings.method` is in no registry.
        """
        settings = settings.regression
        if not samples:
            raise NoSamplesError("the lens has no PSF samples yet; calibrate it with a photo first")
        base = _claimed(samples, settings)
        if not (base > 0).any():
            raise NoSamplesError(f"none of the {len(samples)} samples may vote; include a photo again")
        smoother = smoothers.create(settings.method)
        pixel = pitches.usual_pixel(samples, settings.unit)
        common = pitches.at_pixel(samples, pixel, settings.unit)
        index, roster = SampleIndex.of(va.points(common)), Roster.of(common)
        where = index.points
        widths = WidthField.fit(common, base) if smoother.transport else WidthField()
        local = LocalKernels.of(common, where, widths)
        validation = cross_validate(common, settings, local, where, base)
        if smoother.transport and any(flag.sample is None for flag in validation.flags):
            # a spoilt photo has bent the widths too: fit them again without its voice
            widths = WidthField.fit(common, validation.votes)
            local = local.rescaled(where, widths)
            validation = cross_validate(common, settings, local, where, base)
        rule = va.bandwidths(where)
        used = bandwidth(rule, settings, validation.choice)
        return cls(
            *(pixel, len(samples), widths, local, index, roster, validation),
            *(expected_errors(samples), with_spectra(samples), rule, used, bounds_of(samples)),
            mode=settings.mode,
            unit=settings.unit,
        )

    def warmed(self, samples: Sequence[PsfSample], on_step: StepHook = ignore_step) -> Fit:
        """Return it with the wavefront of its samples; the steps of each end of a zoom begin anew."""
        groups = held_together(samples, self.roster.photo)
        common, scale = pitches.at_pixel(samples, self.pixel, self.unit), va.scales(self.bandwidth)
        votes = self.validation.votes
        physical = Physics.fit(common, votes, groups, scale, on_step, self.former)
        ends = () if physical is None else ends_of(common, votes, groups, scale, physical, on_step)
        return replace(self, physical=physical, ends=ends)

    def end_at(self, settings: LensSettings) -> End | None:
        """The end of a zoom that has the larger say at settings, if one has."""
        end, share = nearest(self.ends, settings)
        return None if share < _MOSTLY else end

    def begun_with(self, earlier: Fit) -> Fit:
        """Return it with the wavefront of a fit to fewer samples as one more beginning of its own."""
        if earlier.pixel != self.pixel:
            return self
        physical = earlier.physical
        if physical is None or not physical.agreed:
            return replace(self, former=earlier.former)
        return replace(self, former=(physical.front,))

    def physical_at(self, settings: LensSettings) -> Physics | None:
        """The wavefront that has the larger say at settings."""
        end = self.end_at(settings)
        return self.physical if end is None else end.physical

    def far_light(self) -> FarLight:
        """What photos that vote allow of far light; the one that is heard says nothing without them."""
        heard = self.heard
        if heard and _is_one_of(heard, self.index.points, self.darkest):
            heard = ()
        bounds = np.concatenate([self.darkest, bounds_of(heard)])
        speaks = np.isfinite(bounds)
        speaks[: len(self.darkest)] &= self.validation.votes > 0.0
        points = np.concatenate([self.index.points, va.points(heard)])
        photos = np.concatenate([self.roster.photo, np.full(len(heard), len(self.roster.numbers))])
        return FarLight(points[speaks], bounds[speaks], photos[speaks], va.scales(self.bandwidth))

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels."""
        return self.local.nbytes

    def takes(self, samples: Sequence[PsfSample], increment: float) -> bool:
        """Whether samples can join without fitting everything anew: they have room, and are few."""
        total = len(self.roster.photo) + len(samples)
        sides = [pitches.side_at(s, self.pixel, self.unit) for s in samples]
        return total <= (1.0 + increment) * self.size and max(sides) <= self.local.side

    def extended(self, samples: Sequence[PsfSample], settings: ModelSettings) -> Fit:
        """Return it with more samples; widths, bandwidths and other estimates stay as they were fitted."""
        common = pitches.at_pixel(samples, self.pixel, self.unit)
        where = va.points(common)
        return replace(
            self,
            local=self.local.extended(common, where, self.widths),
            index=self.index.extended(where),
            roster=self.roster.extended(common),
            validation=self.validation.extended(_claimed(samples, settings)),
            expected=np.concatenate([self.expected, expected_errors(samples)]),
            has_spectrum=np.concatenate([self.has_spectrum, with_spectra(samples)]),
            darkest=np.concatenate([self.darkest, bounds_of(samples)]),
        )


def _is_one_of(
    patches: Sequence[PsfSample], points: NDArray[np.float64], darkest: NDArray[np.float64]
) -> bool:
    """Whether patches show what samples of a model show already, or samples tell nothing of far light."""
    known = {
        (round(r, 6), round(dark, 6)) for r, dark in zip(points[:, 0], darkest, strict=True) if dark >= 0.0
    }
    return not known or any(
        (round(patch.position.r, 6), round(patch.darkest, 6)) in known
        for patch in patches
        if patch.darkest is not None
    )


def expected_errors(samples: Sequence[PsfSample]) -> NDArray[np.float64]:
    """Squared errors that the estimators expect, shape (n,)."""
    return np.array([0.0 if s.error is None else min(s.error, 1.0) ** 2 for s in samples])


def with_spectra(samples: Sequence[PsfSample]) -> NDArray[np.bool_]:
    """Which samples carry the spectrum of their patch, shape (n,)."""
    return np.array([s.spectrum is not None for s in samples], dtype=np.bool_)


def _claimed(samples: Sequence[PsfSample], settings: ModelSettings) -> NDArray[np.float64]:
    return np.array([0.0 if s.photo in settings.excluded else s.weight for s in samples])
