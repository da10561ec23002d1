"""Patches speak against kernels that do not fit them, where they do not."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.psf import PsfSample, delta, gaussian, rms_width, second_moments
from lensmodel.regression import LensModel, Witness, WitnessedField
from lensmodel.regression.witness import ALONG, COUNT, SHARES, WIDTHS, alternatives
from lensmodel.spectrum import RING_LIMITS, RINGS, SECTORS, PatchSpectrum
from lensmodel.types import FieldPosition, Kernel, LensSettings

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


def model(true: float, estimated: float) -> LensModel:
    return LensModel.fit(patches(true, lambda _: estimated))


def test_alternatives_are_narrower_by_what_they_say_and_keep_their_light() -> None:
    kernel = gaussian(41, 3.0**2 * np.eye(2))
    found = alternatives(kernel, 0.3)

    assert found.shape == (COUNT, 41, 41)
    assert np.allclose(found.sum(axis=(1, 2)), 1.0)
    for width, narrow in zip(WIDTHS, found, strict=False):
        assert rms_width(narrow) == pytest.approx(3.0 * width, rel=0.03)
    for share, mixed in zip(SHARES, found[len(WIDTHS) :], strict=False):
        assert mixed[20, 20] == pytest.approx(1.0 - share + share * kernel[20, 20])


@pytest.mark.parametrize(("phi", "axis"), [(0.0, 1), (math.pi / 2, 0), (math.pi, 1)])
def test_radial_alternative_is_narrower_along_the_radius_alone(phi: float, axis: int) -> None:
    radial, tangential = alternatives(gaussian(41, 2.5**2 * np.eye(2)), phi)[-2:]

    along = np.sqrt(np.diag(second_moments(radial)))
    assert along[axis] == pytest.approx(ALONG * along[1 - axis], rel=0.03)
    across = np.sqrt(np.diag(second_moments(tangential)))
    assert across[1 - axis] == pytest.approx(ALONG * across[axis], rel=0.03)


def test_radial_alternative_follows_an_angle_between_the_axes() -> None:
    # at 45 degrees, up and to the right, light that is kept lies across: up to the left, down to the right
    radial = alternatives(gaussian(41, 2.5**2 * np.eye(2)), math.pi / 4)[-2]

    assert second_moments(radial)[0, 1] > 0.5  # rows grow downwards


@pytest.mark.parametrize("place", [RIGHT, LEFT])
def test_right_kernels_stay_as_they_are(place: FieldPosition) -> None:
    known = model(1.4, 1.4)
    verdict = Witness.of(known, SETTINGS).verdict(place)
    kernel = known.kernels([place], SETTINGS, 31)[0]

    assert verdict.shares[0] > 0.95
    assert rms_width(verdict.kernel(kernel)) > 0.97 * rms_width(kernel)
    assert verdict.error(kernel) < 0.1


def test_kernels_too_wide_are_narrowed_and_expected_to_be_wrong() -> None:
    known = model(1.0, 1.6)
    verdict = Witness.of(known, SETTINGS).verdict(RIGHT)
    kernel = known.kernels([RIGHT], SETTINGS, 31)[0]

    assert verdict.shares[0] < 0.05
    assert rms_width(verdict.kernel(kernel)) < 0.8 * rms_width(kernel)
    assert verdict.error(kernel) > 0.4


def test_objection_stays_where_the_patches_object() -> None:
    right = patches(1.0, lambda place: 1.6 if abs(place.phi) < 0.8 else 1.0, count=60)
    witness = Witness.of(LensModel.fit(right), SETTINGS)

    assert witness.verdict(RIGHT).shares[0] < 0.2
    assert witness.verdict(LEFT).shares[0] > 0.8


def test_patches_of_the_photo_speak_where_those_of_the_lens_cannot() -> None:
    mute = LensModel.fit([replace(s, spectrum=None) for s in patches(1.0, lambda _: 1.6)])
    own = [replace(s, kernel=delta(31), photo="here") for s in patches(1.0, lambda _: 1.6)]

    assert Witness.of(mute, SETTINGS).verdict(RIGHT).shares[0] == 1.0
    assert Witness.of(mute, SETTINGS, own).verdict(RIGHT).shares[0] < 0.1


def test_nobody_to_speak_changes_nothing() -> None:
    mute = LensModel.fit([replace(s, spectrum=None) for s in patches(1.0, lambda _: 1.6)])
    verdict = Witness.of(mute, SETTINGS).verdict(RIGHT)
    kernel: Kernel = gaussian(31, 1.6**2 * np.eye(2))

    assert np.array_equal(verdict.kernel(kernel), kernel)
    assert verdict.error(kernel) == 0.0


def test_one_patch_alone_does_not_overrule_a_model() -> None:
    mute = LensModel.fit([replace(s, spectrum=None) for s in patches(1.0, lambda _: 1.6)])
    one = replace(patches(1.0, lambda _: 1.6)[0], position=RIGHT)

    assert Witness.of(mute, SETTINGS, [one]).verdict(RIGHT).shares[0] > 0.5
    assert Witness.of(mute, SETTINGS, [one] * 5).verdict(RIGHT).shares[0] < 0.3


def test_patches_of_another_aperture_and_of_excluded_photos_do_not_speak() -> None:
    wrong = LensModel.fit(
        [
            *patches(1.0, lambda _: 1.6, photo="bad"),
            *(replace(s, spectrum=None, photo="good") for s in patches(1.0, lambda _: 1.6)),
        ]
    )
    stopped_down = LensSettings(aperture=8.0)

    assert Witness.of(wrong, SETTINGS).verdict(RIGHT).shares[0] < 0.1
    assert Witness.of(wrong.excluding("bad"), SETTINGS).verdict(RIGHT).shares[0] == 1.0
    assert Witness.of(wrong, stopped_down).verdict(RIGHT).shares[0] == 1.0


def test_field_gives_what_the_verdict_says() -> None:
    known = model(1.0, 1.6)
    witness = Witness.of(known, SETTINGS)
    field = WitnessedField(known.field(SETTINGS), witness)

    expected = witness.verdict(RIGHT).kernel(known.field(SETTINGS).kernel_at(RIGHT, "r", 31))
    assert np.array_equal(field.kernel_at(RIGHT, "r", 31), expected)
