"""A photo that makes the patches of the others less likely does not vote."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian, rms_width
from lensmodel.core.spectrum import RING_LIMITS, RINGS, SECTORS, PatchSpectrum
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.field.cross_validation import CrossValidation
from lensmodel.model.fitting import Fit
from lensmodel.model.trust.misleading_photos import REASON, without_misleading

SETTINGS = LensSettings(aperture=2.0)
NOISE = 1e-6
PLACE = FieldPosition(0.5, 0.4)
WIDE = 1.7


def taken(name: str, estimated: float, *, true: float = 1.2, count: int = 20) -> list[PsfSample]:
    """Patches of a photo behind a Gaussian of width `true`, and the width that was estimated of each."""
    rng = np.random.default_rng(sum(map(ord, name)))
    edge = np.geomspace(*RING_LIMITS, RINGS + 1)
    modulus = np.sqrt(edge[1:] * edge[:-1])[:, None] * np.ones(SECTORS)
    samples = []
    for i in range(count):
        scene = (
            1e-2
            * (modulus / 0.1) ** -rng.normal(2.1, 0.15)
            * np.exp(0.2 * rng.standard_normal(modulus.shape))
        )
        power = scene * np.exp(-((2 * math.pi * true * modulus) ** 2)) + NOISE
        place = FieldPosition(0.95 * math.sqrt((i + 0.5) / count), math.remainder(2.4 * i, 2 * math.pi))
        width = estimated * float(np.exp(0.05 * rng.standard_normal()))
        spectrum = PatchSpectrum(power.astype(np.float32), NOISE)
        samples.append(
            PsfSample(gaussian(31, width**2 * np.eye(2)), place, SETTINGS, 0.5, name, spectrum=spectrum)
        )
    return samples


def judged(*photos: list[PsfSample], robust: bool = True) -> CrossValidation:
    """What is thought of photos whose kernels alone have condemned none."""
    samples = [s for photo in photos for s in photo]
    fit = Fit.of(samples, ModelSettings(robust=False))
    return without_misleading(fit, samples, ModelSettings(robust=robust)).validation


def wrongs(validation: CrossValidation) -> list[str]:
    return [flag.photo for flag in validation.flags if flag.reason == REASON]


def test_photo_with_kernels_too_wide_loses_its_vote_and_stays_listed() -> None:
    found = judged(taken("a", 1.2), taken("b", 1.2), taken("c", WIDE))

    assert wrongs(found) == ["c"]
    assert len(found.votes) == 60
    assert not found.votes[40:].any()
    assert found.votes[:40].all()


def test_photos_that_agree_all_vote() -> None:
    found = judged(taken("a", 1.2), taken("b", 1.22), taken("c", 1.18), taken("d", 1.2))

    assert wrongs(found) == []
    assert (found.votes > 0).all()


def test_photo_that_is_better_than_those_before_it_is_welcome() -> None:
    assert wrongs(judged(taken("a", 1.5), taken("b", 1.5), taken("c", 1.2))) == []


def test_nothing_is_held_against_two_photos() -> None:
    assert wrongs(judged(taken("a", 1.2), taken("b", WIDE))) == []


def test_photos_without_spectra_cannot_be_judged() -> None:
    mute = [
        [replace(s, spectrum=None) for s in taken(n, w)] for n, w in (("a", 1.2), ("b", 1.2), ("c", WIDE))
    ]

    assert wrongs(judged(*mute)) == []


def test_who_asks_for_no_robust_weighting_gets_none() -> None:
    assert wrongs(judged(taken("a", 1.2), taken("b", 1.2), taken("c", WIDE), robust=False)) == []


def test_the_judgement_is_kept_with_what_was_learned() -> None:
    samples = [*taken("a", 1.2), *taken("b", 1.2), *taken("c", WIDE)]
    plain = LensModel.fit(samples, ModelSettings(robust=False))
    found = without_misleading(plain._fit, samples, ModelSettings())
    model = LensModel(tuple(samples), plain.settings, found)
    again = LensModel.restored(samples, model.learned(), plain.settings)

    assert [flag.photo for flag in again.flags()] == ["c"]
    assert np.array_equal(again.votes, model.votes)
    assert rms_width(again.query(PLACE, SETTINGS, 31).kernel) == pytest.approx(1.2, rel=0.05)
