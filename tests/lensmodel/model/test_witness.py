"""Patches speak against kernels that do not fit them, where they do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, as_kernel, delta, gaussian, otf, rms_width
from lensmodel.core.spectrum import RING_LIMITS, RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import Channel, FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings, WitnessedField
from lensmodel.model.trust.witness import NARROWINGS

SETTINGS = LensSettings(aperture=2.0)
NOISE = 1e-6
RIGHT, LEFT = FieldPosition(0.5, 0.0), FieldPosition(0.5, math.pi)
Width = Callable[[FieldPosition], float]


def seen(width: float, rng: np.random.Generator) -> PatchSpectrum:
    """Spectrum of a scene that falls off by a power law, behind a Gaussian."""
    edge = np.geomspace(*RING_LIMITS, RINGS + 1)
    modulus = np.sqrt(edge[1:] * edge[:-1])[:, None] * np.ones(SECTORS)
    scene = 1e-2 * (modulus / 0.1) ** -rng.normal(2.1, 0.2) * np.exp(0.2 * rng.standard_normal(modulus.shape))
    power = scene * np.exp(-((2 * math.pi * width * modulus) ** 2)) + NOISE
    return PatchSpectrum(power.astype(np.float32), NOISE)


def patches(true: float, estimated: Width, *, count: int = 30, photo: str = "photo") -> list[PsfSample]:
    """Patches behind a Gaussian, and what was estimated of it."""
    rng = np.random.default_rng(3)
    places = [
        FieldPosition(float(0.95 * math.sqrt((i + 0.5) / count)), math.remainder(2.4 * i, 2 * math.pi))
        for i in range(count)
    ]
    return [
        PsfSample(
            gaussian(31, estimated(place) ** 2 * np.eye(2)),
            place,
            SETTINGS,
            0.5,
            photo,
            spectrum=seen(true, rng),
        )
        for place in places
    ]


@cache
def model(true: float, estimated: float) -> LensModel:
    return LensModel.fit(patches(true, lambda _: estimated))


@cache
def believed(known: LensModel, own: tuple[PsfSample, ...] = ()) -> WitnessedField:
    return WitnessedField.of(known, SETTINGS, own)


@cache
def mute(true: float, estimated: float, *, error: float | None = 0.3) -> LensModel:
    """A model whose patches have no spectra."""
    known = patches(true, lambda _: estimated)
    return LensModel.fit([replace(s, spectrum=None, error=error) for s in known])


@cache
def here(true: float) -> tuple[PsfSample, ...]:
    """Patches of the photo that is to be corrected."""
    return tuple(replace(s, kernel=delta(31), photo="here") for s in patches(true, lambda _: 1.0))


def width_at(field: WitnessedField, place: FieldPosition, channel: Channel = "g") -> float:
    return rms_width(field.kernel_at(place, channel, 31))


class Comet:
    """A field of one kernel with a tail to the right."""

    kernel = as_kernel(
        np.asarray(gaussian(31, np.eye(2))) + np.roll(gaussian(31, 4.0 * np.eye(2)), 4, axis=1)
    )

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        return self.kernel


@pytest.mark.parametrize("place", [RIGHT, LEFT])
def test_right_kernels_hardly_change(place: FieldPosition) -> None:
    known = model(1.4, 1.4)

    assert width_at(believed(known), place) > 0.93 * 1.4


def test_kernels_too_wide_are_narrowed_and_expected_to_be_wrong() -> None:
    field = believed(model(1.0, 1.6))

    assert field.witness.shares(RIGHT)[0, 0] < 0.05
    assert 0.5 * 1.6 < width_at(field, RIGHT) < 0.8 * 1.6
    assert field.belief_at(RIGHT, "g", 31).error > 0.5


def test_objection_stays_where_the_patches_object() -> None:
    known = patches(1.0, lambda place: 1.6 if abs(place.phi) < 0.8 else 1.0, count=60)
    witness = believed(LensModel.fit(known)).witness

    assert witness.shares(FieldPosition(0.9, 0.0))[0, 0] < 0.02
    assert witness.shares(FieldPosition(0.9, math.pi))[0, 0] > 0.1


def test_wavefront_is_heard_as_a_second_opinion_where_patches_fit_it(
    short_search: None,
) -> None:
    known = LensModel.fit(patches(1.0, lambda _: 1.6, count=12))
    field = believed(known.warmed())

    assert field.witness.shares(RIGHT).shape == (2, len(NARROWINGS))
    alone = believed(known)
    assert alone.witness.shares(RIGHT).shape == (1, len(NARROWINGS))
    kernels, wavefront = field.witness.shares(RIGHT)
    assert wavefront.sum() > 2.0 * kernels.sum()

    # no patch told on which side the tails of the wavefront's kernels lie: either is as likely
    assert field.turned == pytest.approx(0.5)
    belief = replace(field, fields=[field.fields[0], Comet()]).belief_at(RIGHT, "g", 31)
    lopsided, left = (np.abs(k - k[::-1, ::-1]).sum() for k in (Comet.kernel, belief.kernel))
    assert left < 0.05 * lopsided
    assert belief.error > 0.3


def test_patches_of_the_photo_speak_where_those_of_the_lens_cannot() -> None:
    known = mute(1.0, 1.6)

    assert width_at(believed(known, here(1.0)), RIGHT) < 0.8 * 1.6
    alone, heard = (believed(known, own).witness.shares(RIGHT)[0, 0] for own in ((), here(1.0)))
    assert heard < 0.5 * alone


def test_measured_kernels_are_believed_where_nobody_speaks() -> None:
    assert width_at(believed(mute(1.0, 1.6, error=0.03)), RIGHT) == pytest.approx(1.6, rel=0.02)


@pytest.mark.parametrize("error", [0.2, 0.3, 0.6])
def test_blind_kernels_stay_one_of_several_where_nobody_speaks(error: float) -> None:
    belief = believed(mute(1.0, 1.6, error=error)).belief_at(RIGHT, "g", 31)

    assert 0.6 * 1.6 < rms_width(belief.kernel) < 0.95 * 1.6
    assert belief.error >= error
    # at the finest detail more is left than behind the kernel, which no correction raises from nothing
    assert abs(otf(belief.kernel, (64, 64))[0, -1]) > 10.0 * abs(
        otf(gaussian(31, 1.6**2 * np.eye(2)), (64, 64))[0, -1]
    )


def test_where_nobody_speaks_the_error_is_that_of_the_samples_or_the_usual_one() -> None:
    said, unsaid = (believed(mute(1.0, 1.6, error=e)).belief_at(RIGHT, "g", 31) for e in (0.05, None))

    assert said.error < 0.2
    assert unsaid.error >= 0.4


def test_one_patch_alone_does_not_overrule_a_model() -> None:
    one = replace(here(1.0)[0], position=RIGHT)
    first, all_ = (believed(mute(1.0, 1.6), (one,) * count).witness.shares(RIGHT)[0, 0] for count in (1, 8))

    assert first > 4.0 * all_


def test_the_more_photos_speak_the_surer() -> None:
    """One photo may show a soft scene everywhere; many do not."""
    ones = patches(1.4, lambda _: 1.4, count=20)
    twos = [replace(s, photo=str(i % 4)) for i, s in enumerate(ones)]
    alone, several = (believed(LensModel.fit(s)).belief_at(RIGHT, "g", 31).error for s in (ones, twos))

    assert several < 0.8 * alone


def test_patches_of_another_aperture_and_of_excluded_photos_do_not_speak() -> None:
    known = LensModel.fit(
        [
            *patches(1.0, lambda _: 1.6, photo="bad"),
            *(replace(s, spectrum=None, photo="good") for s in patches(1.0, lambda _: 1.6)),
        ]
    )
    stopped_down = LensSettings(aperture=8.0)

    assert believed(known).witness.votes_at(RIGHT) > 1.0
    without = LensModel.fit(known.samples, ModelSettings(excluded=("bad",)))
    assert believed(without).witness.votes_at(RIGHT) == 0.0
    assert WitnessedField.of(known, stopped_down).witness.votes_at(RIGHT) < 0.1


def test_question_outside_the_samples_is_answered_with_the_error_of_the_model() -> None:
    known = model(1.4, 1.4)
    far = LensSettings(aperture=8.0)
    field = WitnessedField.of(known, far, here(1.4))
    answer = known.query(RIGHT, far.with_channel("g"), 31)

    assert answer.extrapolated
    assert field.belief_at(RIGHT, "g", 31).error >= answer.predicted_error - 1e-9


def test_red_and_blue_are_changed_as_green_is() -> None:
    field = believed(model(1.0, 1.6))

    assert width_at(field, RIGHT, "r") == pytest.approx(width_at(field, RIGHT), rel=0.05)


def test_kernels_that_were_measured_are_believed_more_than_patches() -> None:
    witness = believed(model(1.0, 1.6)).witness

    assert witness.shares(RIGHT, 0.05)[0, 0] == pytest.approx(1.0)
    assert witness.shares(RIGHT, 0.3)[0, 0] < 0.05
    assert witness.shares(RIGHT, 0.12).sum() == pytest.approx(1.0)
