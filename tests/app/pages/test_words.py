"""Sentences of the pages that no journey through the browser passes by in all their forms."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import Any

import pytest

from app.pages.words import coverage_advice, coverage_bars, history_words
from app.schemas import CalibrationOut
from lensmodel.core.types import FieldPosition


def version(number: int, error: dict[str, Any] | float | None) -> CalibrationOut:
    return CalibrationOut(
        version=number,
        kind="photo",
        photo_id="p",
        samples_added=1,
        samples=number,
        photos=number,
        error=error,
        coverage=None,
        created_at=datetime(2026, 1, 1, tzinfo=UTC),
    )


@pytest.mark.parametrize(
    ("history", "words"),
    [
        ([version(1, {})], "One photo so far. Once there are more, they are tested on one another."),
        ([version(1, {}), version(2, None)], "The photos are being tested on one another."),
        (
            [version(1, {}), version(2, {"center": 0.115, "mid": 0.1682})],
            "With 2 photos: centre 12 %, middle 17 %, corners not known. "
            "The curve starts with the next photo.",
        ),
        (
            [version(1, None), version(2, 0.25)],
            "With 2 photos: centre 25 %, middle 25 %, corners 25 %. The curve starts with the next photo.",
        ),
    ],
)
def test_fewer_than_two_errors_are_told_in_words(history: list[CalibrationOut], words: str) -> None:
    assert history_words(history) == words


def everywhere(without: float | None = None) -> list[FieldPosition]:
    """Many places all over a picture of 3:2, except near one of its corners."""
    places = []
    for x in range(-20, 21):
        for y in range(-14, 15):
            r, phi = math.hypot(x, y) / 25.0, math.atan2(y, x)
            near = (
                without is not None
                and math.hypot(
                    r * math.cos(phi) - 0.9 * math.cos(without), r * math.sin(phi) - 0.9 * math.sin(without)
                )
                < 0.35
            )
            if r <= 1.0 and not near:
                places.append(FieldPosition(r, phi))
    return places


def test_every_part_has_been_seen_only_where_there_is_evidence_near_each() -> None:
    bars = coverage_bars({"center": 60, "mid": 80, "corner": 40})

    assert coverage_advice(bars, everywhere()) == "Every part of the picture has been seen well."
    assert "the lower right corner" in coverage_advice(bars, everywhere(-math.atan2(1.0, 1.5)))


def test_a_zone_with_few_places_is_asked_for_first() -> None:
    bars = coverage_bars({"center": 60, "mid": 80, "corner": 3})

    assert coverage_advice(bars, everywhere()).startswith("Little seen so far: corners.")
