"""What children answer is what their workers expect."""

from __future__ import annotations

import pytest

from app.jobs.answers import Corrected, checked
from lensmodel.core import codec
from lensmodel.core.types import EdgeGain
from lensmodel.correction.expected_gain import ZoneReport

GAIN = EdgeGain("sagittal", 4, 0.1, 0.2, 2.0, 1.5)


@pytest.mark.parametrize("measured", [(), (GAIN,), (GAIN, GAIN)])
def test_the_report_of_a_correction_is_taken_with_and_without_a_chart(measured: tuple[EdgeGain, ...]) -> None:
    zones = {"center": ZoneReport(cells=2, expected_gain_db=1.0, psf_error=0.1, measured=measured)}
    answer = {"file": "result.png", "report": codec.to_json({"zones": zones, "nothing_to_correct": False})}

    assert checked(Corrected, answer) == answer
