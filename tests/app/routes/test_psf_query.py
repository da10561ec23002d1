"""What may be asked of a PSF: numbers of real cameras."""

from __future__ import annotations

import pytest
from pydantic import ValidationError

from app.schemas import PsfQuery


@pytest.mark.parametrize("name", ["focus_distance_m", "pixel_pitch_um"])
def test_a_length_next_to_nothing_is_refused(name: str) -> None:
    with pytest.raises(ValidationError, match="greater than"):
        PsfQuery.model_validate({"r": 0.5, name: 5e-324})


@pytest.mark.parametrize(("name", "value"), [("focus_distance_m", 0.02), ("pixel_pitch_um", 0.5)])
def test_the_smallest_of_real_cameras_is_answered(name: str, value: float) -> None:
    assert getattr(PsfQuery.model_validate({"r": 0.5, name: value}), name) == value
