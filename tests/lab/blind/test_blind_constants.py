"""What the commands fit that made the constants of blind estimators."""

from __future__ import annotations

import json
import lzma
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lab.blind.recurrence_line import is_of, line_through, readings, rows_of


def test_the_line_of_recurrence_is_recovered_from_points_that_lie_beside_it() -> None:
    apart = np.linspace(0.05, 0.3, 40)
    beside = 0.01 * (-1.0) ** np.arange(40)

    line = line_through(apart, 0.4 + 1.2 * apart + beside)

    assert (line.at_agreement, line.by_disagreement) == pytest.approx((0.4, 1.2), abs=0.02)
    # of a line's slope: spread of the errors over that of the points and the root of their number
    assert line.spread[1] == pytest.approx(0.01 / (apart.std() * math.sqrt(38)), rel=0.02)


def row(case: str, predicted: float, **changed: Any) -> dict[str, Any]:
    usual = {"method": "michaeli-irani", "declined": False, "rel_l2": 0.5}
    return {"case": case, "predicted_error": predicted, **usual, **changed}


def test_disagreements_are_read_back_from_predicted_errors_that_are_no_bound() -> None:
    apart, error = readings([row("a/psf00", 0.57), row("a/psf01", 1.0), row("a/psf02", 0.67, rel_l2=0.7)])

    np.testing.assert_allclose(apart, [0.1, 0.2])
    np.testing.assert_allclose(error, [0.5, 0.7])


def test_cases_are_read_from_reports_and_from_packed_lines(tmp_path: Path) -> None:
    rows = [row("a/psf00", 0.5), row("b/psf01", 0.6, method="default"), row("c/psf02", 0.7, declined=True)]
    (tmp_path / "blind.json").write_text(json.dumps({"cases": rows}))
    with lzma.open(tmp_path / "cases.jsonl.xz", "wt") as file:
        file.writelines(json.dumps(stored) + "\n" for stored in rows)

    assert rows_of(tmp_path / "blind.json") == rows_of(tmp_path / "cases.jsonl.xz") == rows[:1]


def test_a_case_is_of_a_half_by_its_photo_and_its_psf() -> None:
    assert is_of("dev", "s07_tea_gardens+3/psf00")
    assert not is_of("test", "s07_tea_gardens+3/psf00")
    assert is_of("all", "s07_tea_gardens/psf01")
