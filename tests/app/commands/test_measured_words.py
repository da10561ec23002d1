"""What `lensmodel correct` says of a chart."""

from __future__ import annotations

from app.commands.correction import measured
from lensmodel.core.types import EdgeGain
from lensmodel.correction import ZoneReport


def test_measured_gain_of_a_chart_is_told_in_words_and_nothing_of_other_photos() -> None:
    chart = ZoneReport(4, 3.21, 0.1, EdgeGain(6, 0.118, 0.402, 3.41, 1.2))

    lines = measured({"center": ZoneReport(4, 3.2, 0.1), "corner": chart})

    assert lines == [
        "corner of the chart: MTF50 from 0.118 to 0.402 cycles/pixel, 3.4 times (median of 6 edges), "
        "overshoot 1.2 %; predicted for a usual scene +3.2 dB"
    ]
