"""Pictures of the report show its numbers at their places."""

from __future__ import annotations

import math
from collections.abc import Callable
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.report import (
    LensReport,
    ReportSettings,
    apertures_svg,
    curves_svg,
    lens_report,
    mtf_map_svg,
)
from lensmodel.report.drawing import Axes, Label, Line, svg

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture(scope="module")
def report() -> LensReport:
    """A lens that is softer at the left, at two apertures."""
    samples = []
    for photo, aperture in (("a", 2.0), ("b", 4.0)):
        for r in (0.1, 0.4, 0.65, 0.9):
            for k in range(6):
                place = FieldPosition(r, 2.0 * math.pi * k / 6 + r)
                width = 1.5 - 0.8 * r * math.cos(place.phi) + 1.0 / aperture
                kernel = gaussian(15, np.eye(2) * width)
                samples.append(PsfSample(kernel, place, LensSettings(aperture=aperture), photo=photo))
    return lens_report(LensModel.fit(samples), options=ReportSettings(rows=3, cols=5, size=15))


def test_the_map_is_darkest_red_where_the_lens_is_softest_and_bluest_where_sharpest(
    report: LensReport,
) -> None:
    boxes = ET.fromstring(mtf_map_svg(report)).findall(f"{SVG}rect")[1:]

    values = [point.mean for point in report.field]
    assert len(boxes) == 15
    assert boxes[int(np.argmin(values))].get("fill") == "#7f1d1d"
    assert boxes[int(np.argmax(values))].get("fill") == "#0b6e99"
    assert float(boxes[int(np.argmin(values))].get("x", "")) < float(
        boxes[int(np.argmax(values))].get("x", "")
    )


def test_the_map_marks_guesses_and_tells_of_the_centring(report: LensReport) -> None:
    texts = [e.text or "" for e in ET.fromstring(mtf_map_svg(report)).findall(f"{SVG}text")]

    assert sum(text.endswith("?") for text in texts) == sum(p.extrapolated for p in report.field)
    assert report.decentring.text in " ".join(texts)
    assert max(len(text) for text in texts) <= 100


@pytest.mark.parametrize(
    ("draw", "begun"), [(mtf_map_svg, ("",)), (curves_svg, ("",)), (apertures_svg, ("f/2 ", "f/4 "))]
)
def test_pictures_say_which_model_answered(
    report: LensReport, draw: Callable[[LensReport], str], begun: tuple[str, ...]
) -> None:
    root = ET.fromstring(draw(report))
    texts = [e.text or "" for e in root.findall(f"{SVG}text")]
    lowest = max(float(e.get("y", "")) for e in root.findall(f"{SVG}text"))

    for words in begun:
        assert f"{words}answered by regression: no patch has a spectrum" in texts
    assert lowest < float(root.get("viewBox", "").split()[3])


def test_curves_are_solid_sagittal_and_dashed_tangential_at_their_values(report: LensReport) -> None:
    lines = ET.fromstring(curves_svg(report)).findall(f"{SVG}polyline")
    long = [line for line in lines if len((line.get("points") or "").split()) == len(report.radii)]

    assert [line.get("stroke-dasharray") for line in long] == [None, "6 4"] * len(report.curves)
    first = [float(p.split(",")[1]) for p in (long[0].get("points") or "").split()]
    top, bottom = 40.0, 348.0
    assert [(bottom - y) / (bottom - top) for y in first] == pytest.approx(
        report.curves[0].sagittal, abs=1e-3
    )


def test_apertures_have_a_tick_each_and_a_line_for_each_zone(report: LensReport) -> None:
    root = ET.fromstring(apertures_svg(report))

    texts = [e.text for e in root.findall(f"{SVG}text")]
    assert {"f/2", "f/4", "centre", "mid", "corner"} <= set(texts)


def test_texts_are_escaped() -> None:
    root = ET.fromstring(svg("a < b", 10, 10, [Label(0, 0, "<&>")]))

    assert root.findtext(f"{SVG}title") == "a < b"
    assert root.findtext(f"{SVG}text") == "<&>"


def test_axes_put_the_smallest_value_at_the_lower_left() -> None:
    axes = Axes(10.0, 20.0, 110.0, 220.0, (0.0, 1.0), (0.0, 2.0))

    assert axes.place(0.0, 0.0) == (10.0, 220.0)
    assert axes.place(1.0, 2.0) == (110.0, 20.0)
    assert axes.curve([0.0, 1.0], [0.0, 2.0], "#000000") == Line(
        ((10.0, 220.0), (110.0, 20.0)), "#000000", 2.0
    )
