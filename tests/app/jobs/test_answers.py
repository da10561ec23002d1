"""What children answer is what their workers expect."""

from __future__ import annotations

from app.jobs.answers import CORRECTED, checked
from lensmodel.core import codec
from lensmodel.correction.expected_gain import ZoneReport


def test_the_report_of_a_correction_is_taken() -> None:
    zones = {"center": ZoneReport(cells=2, expected_gain_db=1.0, psf_error=0.1)}
    answer = {"file": "result.png", "report": codec.to_json({"zones": zones, "nothing_to_correct": False})}

    assert checked(CORRECTED, answer) == answer
