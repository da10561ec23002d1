"""The lens test: its figures, errors, units, documents, and two of them beside each other."""

from __future__ import annotations

import csv
import io
import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lensmodel.core.codec import from_json, to_json
from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.photo.lateral import LateralColour
from lensmodel.report.charts import charts_of, error_chart, map_chart
from lensmodel.report.comparison import Side, compare
from lensmodel.report.decentring import Asymmetry, _verdict
from lensmodel.report.documents import comparison_html, to_html
from lensmodel.report.lens_test import LensTest, lens_test, zone_means
from lensmodel.report.pdf import comparison_pdf, to_pdf
from lensmodel.report.tables import to_csv
from lensmodel.report.units import SensorGeometry

QUICK = ModelSettings(r=0.3, phi=0.8, mirror=0.0, method="nadaraya-watson", robust=False)
SIZE = 15


def samples(
    photos: int = 3,
    *,
    corner: float = 2.0,
    spread: float = 0.0,
    pitch: float | None = 6.0,
    aperture: float = 2.8,
) -> list[PsfSample]:
    """Round kernels that widen from .8 px in the center to `corner`; photos disagree by `spread`."""
    rng = np.random.default_rng(5)
    found = []
    for photo in range(photos):
        wide = 1.0 + spread * rng.standard_normal()
        for r in (0.05, 0.5, 0.95):
            for phi in np.linspace(-3.0, 3.0, 5):
                sigma = abs((0.8 + (corner - 0.8) * r) * wide)
                found += [
                    PsfSample(
                        gaussian(SIZE, sigma**2 * np.eye(2)),
                        FieldPosition(r, float(phi)),
                        LensSettings(aperture, channel=channel),
                        photo=f"p{photo}",
                        pixel_pitch_um=pitch,
                    )
                    for channel in CHANNELS
                ]
    return found


@cache
def report_of(
    channels: tuple[Channel, ...] = ("g",), *, draws: int = 4, rows: int = 4, **options: float | None
) -> LensTest:
    given = [s for s in samples(**options) if s.settings.channel in channels]  # type: ignore[arg-type]
    model = LensModel.fit(given, QUICK)
    return lens_test(model, "A lens", height_px=4000, draws=draws, rows=rows, size=SIZE, channels=channels)


@pytest.fixture(scope="module")
def soft() -> LensTest:
    return report_of(("g", "r", "b"), spread=0.1)


def test_a_figure_is_told_in_each_unit_and_never_beyond_what_a_sensor_shows() -> None:
    sensor = SensorGeometry(5.0, 4000)

    assert [sensor.words(0.2, unit) for unit in sensor.units] == [".200", "800", "40"]
    assert sensor.words(1.0) == "at least .500"
    assert sensor.words(1.0, "lp/mm") == "at least 100"
    assert SensorGeometry().units == ("c/px",)
    assert SensorGeometry().words(0.2, "lp/mm") == "unknown"


@pytest.mark.parametrize(
    ("pitch", "pairs"),
    [
        (6.0, [10, 20, 30, 40]),
        (14.0, [10, 20, 30]),
        (2.0, [20, 40, 60, 80]),
        (None, [None] * 4),
    ],
)
def test_curves_lie_below_the_nyquist_frequency(pitch: float | None, pairs: list[int | None]) -> None:
    curves = report_of(draws=0, rows=1, photos=1, pitch=pitch).tested[0].report.curves

    assert [curve.lp_mm for curve in curves] == pairs
    assert all(curve.frequency <= 0.5 for curve in curves)


def test_the_first_sentence_is_for_photographers(soft: LensTest) -> None:
    assert soft.verdict.startswith("At f/2.8 this copy is a little soft in the centre, and its corners are")
    assert "softer" in soft.verdict
    even = report_of(draws=0, corner=0.8)
    assert "its corners are just as good" in even.verdict
    assert "its corners are nearly as good" in report_of(draws=0, corner=0.9).verdict


def test_errors_grow_with_what_photos_disagree_about(soft: LensTest) -> None:
    agreed = report_of(spread=0.0)
    errors = [np.mean(test.tested[0].spread.tangential) for test in (agreed, soft)]  # type: ignore[union-attr]

    assert errors[0] < 1e-6
    assert 0.002 < errors[1] < 0.1
    assert soft.tested[0].spread is not None
    assert soft.tested[0].spread.drawn == "photos"
    single = report_of(photos=1, draws=2, rows=1).tested[0].spread
    assert single is not None
    assert single.drawn == "patches"
    assert [one.spread is None for one in soft.tested] == [False, True, True]  # green first


def test_a_lens_that_draws_points_within_a_pixel_is_reported() -> None:
    point = np.zeros((SIZE, SIZE))
    point[SIZE // 2, SIZE // 2] = 1.0
    given = [s for s in samples() if s.settings.channel == "g"]
    narrow = [s if s.position.r > 0.9 else replace(s, kernel=point) for s in given]

    test = lens_test(LensModel.fit(narrow, QUICK), "Sharp", draws=0, rows=2, size=SIZE, channels=("g",))
    nothing = [replace(s, kernel=point) for s in given]
    perfect = lens_test(LensModel.fit(nothing, QUICK), "Perfect", draws=0, rows=2, size=SIZE, channels=("g",))

    text = "in the centre a point stays within a pixel, in the corners it is 1.5 px wide"
    assert text in test.tested[0].report.shape.text
    assert "a point stays within a pixel" in perfect.tested[0].report.shape.text
    assert "Astigmatism" in to_html(perfect)
    assert to_pdf(perfect).startswith(b"%PDF-")


def test_photos_at_other_apertures_do_not_make_one_photo_look_well_known() -> None:
    once = [replace(s, photo="stopped", settings=replace(s.settings, aperture=5.6)) for s in samples(1)]
    given = [s for s in samples(3, spread=0.1) + once if s.settings.channel == "g"]

    test = lens_test(LensModel.fit(given, QUICK), "Two", draws=2, rows=1, size=SIZE, channels=("g",))

    drawn = {t.report.settings.aperture: t.spread.drawn for t in test.tested if t.spread is not None}
    assert drawn == {2.8: "photos", 5.6: "patches"}


def test_all_documents_hold_the_same_figures(soft: LensTest) -> None:
    restored = from_json(LensTest, json.loads(json.dumps(to_json(soft))))
    assert restored == soft
    page = to_html(soft)
    assert page.count("<svg") == len(charts_of(soft, None))
    assert "http://" not in page.replace('xmlns="http://www.w3.org/2000/svg"', "")
    assert soft.verdict in page
    rows = list(csv.DictReader(io.StringIO(to_csv(soft))))
    first = next(row for row in rows if row["quantity"] == "MTF50" and row["channel"] == "g")
    assert float(first["value"]) == pytest.approx(soft.tested[0].report.field[0].tangential, rel=1e-5)
    assert {row["channel"] for row in rows} == {"r", "g", "b"}
    means = {f"MTF50, mean of {zone}": value for zone, value in soft.tested[0].zones.items()}
    assert {row["quantity"] for row in rows} == {"MTF50", "MTF", "width of a point", *means}
    written = {row["quantity"]: float(row["value"]) for row in rows[:3]}
    assert written == pytest.approx(means, rel=1e-5)
    assert soft.tested[0].zones == zone_means(soft.tested[0].report)
    pdf = to_pdf(soft)
    assert pdf.startswith(b"%PDF-")
    assert pdf == to_pdf(soft)  # no time of day in it


def test_both_maps_share_one_scale(soft: LensTest) -> None:
    chart = map_chart(soft.tested[0], soft.sensor, "lp/mm")

    texts = [part.text for part in chart.parts if hasattr(part, "text")]
    assert {"tangential", "sagittal", "0", "42", "83"} <= set(texts)  # half a cycle at 6 micrometres
    assert error_chart(soft.tested[1], soft.sensor) is None


def test_two_copies_are_compared_with_their_error(soft: LensTest) -> None:
    sharp = report_of(corner=1.0, spread=0.02)

    found = compare(Side("soft", soft.tested[0]), Side("sharp", sharp.tested[0]))

    corner = found.zones[2]
    assert corner.sure
    assert corner.share > 0.3
    assert "sharper in the corners" in found.verdict
    same = compare(Side("one", soft.tested[0]), Side("two", soft.tested[0]))
    assert (
        same.verdict == "Compared with one, two is about the same in the centre, about the same halfway out "
        "and about the same in the corners."
    )
    assert len(found.charts) == 3
    assert "sharper in the corners" in comparison_html(found)
    assert comparison_pdf(found).startswith(b"%PDF-")


def test_two_copies_of_one_name_can_be_told_apart(soft: LensTest) -> None:
    sharp = report_of(corner=1.0, spread=0.02)

    found = compare(Side("Nikkor 50mm", soft.tested[0]), Side("Nikkor 50mm", sharp.tested[0]))

    assert found.verdict.startswith("Compared with Nikkor 50mm (1), Nikkor 50mm (2) is ")
    page = comparison_html(found)
    for side in (found.first, found.second):
        assert side.facts in page
        assert f"{side.tested.report.samples} blur samples" in side.facts


def test_apertures_are_tested_each_and_the_best_is_named() -> None:
    both = samples(aperture=2.8, corner=2.0) + samples(aperture=8.0, corner=0.9)
    test = lens_test(LensModel.fit(both, QUICK), "A lens", draws=0, rows=4, size=SIZE, channels=("g",))

    assert test.apertures == (2.8, 8.0)
    assert zone_means(test.at(8.0).report)["corner"] > zone_means(test.at(2.8).report)["corner"]
    assert "It is sharpest over the whole picture at f/8." in test.verdict
    assert "MTF50 by aperture" in to_html(test)


def test_lateral_colour_is_the_median_of_the_photos_that_show_it() -> None:
    none = (0.0, 0.0, 0.0, 1.0)
    shifts = [LateralColour((0.0, 0.0, 0.0, 1.0 + s), none, 2000.0, 50, 50) for s in (1e-4, 2e-4, 9e-3)]
    blind = LateralColour(none, none, 2000.0)
    test = lens_test(
        LensModel.fit(samples(1), QUICK),
        "A lens",
        rows=2,
        lateral=[*shifts, blind],
        draws=0,
        size=SIZE,
        channels=("g",),
    )

    assert test.lateral is not None
    assert test.lateral.red[-1] == pytest.approx(0.4)
    assert test.lateral.blue[-1] == 0.0
    assert "Lateral colour" in to_html(test)


@pytest.mark.parametrize(
    ("sides", "error", "verdict"), [(0.24, 0.10, "unknown"), (0.08, 0.05, "centred"), (0.48, 0.1, "unknown")]
)
def test_sides_that_may_differ_by_much_are_undecided(sides: float, error: float, verdict: str) -> None:
    softer = Asymmetry(math.log1p(sides), 0.0, math.log1p(2.0 * error) / 2.0, significant=False)

    assert _verdict(softer, None, 5)[0] == verdict
    assert _verdict(replace(softer, significant=True, amount=0.5), None, 5)[0] == "decentred"
