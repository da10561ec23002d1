"""Which photo is asked for, and how places are named."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.report import advice, direction_in_words, place_in_words

CORNER = math.atan2(1.0, 1.5)


def places(seed: int) -> list[FieldPosition]:
    """Twenty-four places of a 3:2 frame, one in each cell of 4 x 6."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(4):
        for j in range(6):
            y = (1.0 - (i + rng.uniform(0.2, 0.8)) / 2.0) / math.hypot(1.5, 1.0)
            x = ((j + rng.uniform(0.2, 0.8)) / 3.0 - 1.0) * 1.5 / math.hypot(1.5, 1.0)
            found.append(FieldPosition(math.hypot(x, y), math.atan2(y, x)))
    return found


def photo(
    name: str, aperture: float | None = 2.0, *, without: float | None = None, seed: int = 0
) -> list[PsfSample]:
    """Samples of a photo, in all channels; nothing within 60 degrees of `without` and far out."""
    kept = [p for p in places(seed) if without is None or p.r < 0.6 or math.cos(p.phi - without) < 0.5]
    return [
        PsfSample(gaussian(13, np.eye(2) * (1.0 + p.r)), p, LensSettings(aperture, channel=c), photo=name)
        for p in kept
        for c in CHANNELS
    ]


@pytest.mark.parametrize(
    ("phi", "words"),
    [
        (0.0, "right"),
        (math.pi / 2, "top"),
        (-math.pi / 2, "bottom"),
        (math.pi, "left"),
        (-math.pi + 1e-9, "left"),
        (CORNER, "upper right"),
        (math.pi - CORNER, "upper left"),
        (CORNER - math.pi, "lower left"),
        (-CORNER, "lower right"),
    ],
)
def test_angles_are_named_counter_clockwise_from_the_right_with_the_top_at_plus_half_pi(
    phi: float, words: str
) -> None:
    assert direction_in_words(phi) == words


def test_places_are_named_by_zone_and_side() -> None:
    assert place_in_words(FieldPosition(0.1, 2.0)) == "the centre"
    assert place_in_words(FieldPosition(0.5, math.pi - CORNER)) == "the upper left"
    assert place_in_words(FieldPosition(0.9, -CORNER)) == "the lower right corner"
    assert place_in_words(FieldPosition(0.8, math.pi)) == "the left edge"


@pytest.mark.parametrize(
    ("phi", "corner"),
    [
        (CORNER, "the upper right corner"),
        (math.pi - CORNER, "the upper left corner"),
        (CORNER - math.pi, "the lower left corner"),
        (-CORNER, "the lower right corner"),
    ],
)
def test_the_corner_that_no_photo_shows_is_asked_for(phi: float, corner: str) -> None:
    samples = [s for i in range(3) for s in photo(f"p{i}", without=phi, seed=i)]

    found = advice(LensModel.fit(samples))

    assert corner in found.text
    assert "at f/2" in found.text
    assert any(corner in suggestion.text for suggestion in found.suggestions)


def test_the_aperture_that_few_photos_had_is_asked_for() -> None:
    samples = [s for i in range(4) for s in photo(f"p{i}", 2.0, seed=i)]
    samples += photo("stopped", 8.0, without=0.0, seed=9)

    found = advice(LensModel.fit(samples))

    assert all(suggestion.settings.aperture == 8.0 for suggestion in found.suggestions)
    assert "at f/8" in found.text


def test_an_aperture_that_no_photo_had_is_asked_for_when_the_owner_names_it() -> None:
    samples = [s for i in range(2) for s in photo(f"p{i}", 5.6, seed=i)]

    found = advice(LensModel.fit(samples), LensSettings(aperture=1.4))

    assert "at f/1.4" in found.text
    assert "no photo shows that place" in found.suggestions[0].reason


def test_unknown_apertures_are_not_named() -> None:
    found = advice(LensModel.fit(photo("a", None)))

    assert "f/" not in found.text


def test_many_photos_of_a_lens_that_is_known_are_enough() -> None:
    samples = [s for i in range(6) for s in photo(f"p{i}", seed=i)]

    found = advice(LensModel.fit(samples))

    assert found.enough
    assert not advice(LensModel.fit(photo("a", without=0.0))).enough


def test_advice_does_not_depend_on_the_order_of_samples() -> None:
    samples = [s for i in range(2) for s in photo(f"p{i}", without=CORNER, seed=i)]

    assert advice(LensModel.fit(samples)).text == advice(LensModel.fit(samples[::-1])).text


def test_the_first_suggestion_has_the_largest_gain_and_the_suggestions_differ() -> None:
    found = advice(LensModel.fit(photo("a", without=CORNER)))

    gains = [suggestion.gain for suggestion in found.suggestions]
    assert gains == sorted(gains, reverse=True)
    assert len({(suggestion.position, suggestion.settings.aperture) for suggestion in found.suggestions}) == 3
