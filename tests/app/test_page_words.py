"""Sentences of the pages that no journey through the browser passes by in all their forms."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Any

import pytest

from app.pages.words import history_words
from app.schemas import CalibrationOut


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
        ([version(1, {})], "One photo so far. It is tested on the others once there are some."),
        ([version(1, {}), version(2, None)], "The photos are being tested on one another."),
        (
            [version(1, {}), version(2, {"center": 0.115, "mid": 0.1682})],
            "With 2 photos: center 0.115, middle 0.168, corners ?. The curve begins with the next one.",
        ),
        (
            [version(1, None), version(2, 0.25)],
            "With 2 photos: center 0.25, middle 0.25, corners 0.25. The curve begins with the next one.",
        ),
    ],
)
def test_fewer_than_two_errors_are_told_in_words(history: list[CalibrationOut], words: str) -> None:
    assert history_words(history) == words
