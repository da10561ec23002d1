"""The report: its figures against true kernels, its verdict, its files, and two copies compared."""

from __future__ import annotations

import base64
import csv
import io
import itertools
import json
import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from PIL import Image

from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import from_json, to_json
from lensmodel.core.psf import PsfSample, delta
from lensmodel.core.types import CHANNELS, FieldPosition, Frame, LensSettings
from lensmodel.model import LensModel, PsfAnswer
from lensmodel.quality import mtf50_from_kernel
from lensmodel.report.centring import Asymmetry, Centring, direction_in_words
from lensmodel.report.export import place_table, to_csv
from lensmodel.report.lens_report import (
    UNKNOWN,
    LensReport,
    SensorGeometry,
    compare,
    filled_aspect,
    half_sides,
    lens_report,
    marked_places,
    sharpness,
)
from lensmodel.report.plots import charts, document

QUICK = "paper"
SIZE = 15
CORNER = math.atan2(1.0, 1.5)


def samples(
    photos: int = 3,
    *,
    corner: float = 2.0,
    spread: float = 0.0,
    pitch: float | None = 6.0,
    aperture: float = 2.8,
    astigmatic: float = 1.0,
    bad_side: float = 0.0,
) -> list[PsfSample]:
    """Kernels that widen from .8 px in the centre to `corner`; photos disagree by `spread`.

    They are `astigmatic` times as wide along the radius, and wider by the share `bad_side` on the right.
    """
    rng = np.random.default_rng(5)
    found = []
    for photo in range(photos):
        wide = 1.0 + spread * rng.standard_normal()
        for r in (0.05, 0.5, 0.95):
            for phi in np.linspace(-math.pi, math.pi, 8, endpoint=False):
                sigma = abs((0.8 + (corner - 0.8) * r) * wide) * (1.0 + bad_side * r * math.cos(phi))
                u, v = np.array([-math.sin(phi), math.cos(phi)]), np.array([-math.cos(phi), -math.sin(phi)])
                along = (astigmatic if r > 0.1 else 1.0) * sigma
                kernel = gaussian(SIZE, along**2 * np.outer(u, u) + sigma**2 * np.outer(v, v))
                place = FieldPosition(r, float(phi))
                settings = [LensSettings(aperture, channel=channel) for channel in CHANNELS]
                photo_id = f"p{photo}-{aperture}"
                found += [
                    PsfSample(kernel, place, own, photo=photo_id, pixel_pitch_um=pitch) for own in settings
                ]
    return found


@cache
def report_of(*, rows: int = 4, **options: float | None) -> LensReport:
    given = [s for s in samples(**options) if s.settings.channel == "g"]  # type: ignore[arg-type]
    model = LensModel.fit(given, QUICK)
    return lens_report(model, "A lens", height_px=4000, rows=rows, size=SIZE)


def rows_of(report: LensReport) -> list[dict[str, str]]:
    return list(csv.DictReader(io.StringIO(to_csv(report))))


def drawn(report: LensReport) -> bytes:
    """The first chart, as SVG."""
    return base64.b64decode(charts(report, None)[0].source.split(",")[1])


@pytest.fixture(scope="module")
def soft() -> LensReport:
    return report_of(spread=0.1)


def test_a_figure_is_told_in_each_unit_and_never_beyond_what_a_sensor_shows() -> None:
    sensor = SensorGeometry(5.0, 4000)

    assert [sensor.words(0.2, unit) for unit in sensor.units] == [".200", "800", "40"]
    assert sensor.words(0.2, "lp/mm", (0.15, 0.6)) == "40 [30 to over 100]"
    assert sensor.words(1.0) == "at least .500"
    assert list(SensorGeometry().units) == ["c/px"]


@pytest.mark.parametrize(
    ("pitch", "names"),
    [(14.0, "10 20 30 lp/mm"), (2.0, "20 40 60 80 lp/mm"), (None, "0.05 0.1 0.15 0.2 c/px")],
)
def test_curves_lie_below_the_nyquist_frequency(pitch: float | None, names: str) -> None:
    curves = report_of(rows=1, photos=1, pitch=pitch).tested[0].curves

    *figures, unit = names.split()
    assert [curve.name for curve in curves] == [f"{figure} {unit}" for figure in figures]
    assert all(curve.frequency <= 0.5 for curve in curves)


def test_figures_are_those_of_the_true_kernels() -> None:
    found = report_of(corner=0.8).tested[0]

    kernel = gaussian(SIZE, 0.64 * np.eye(2))
    truth = mtf50_from_kernel(kernel, 0.0)
    assert [spot.mtf50[0] for spot in found.map] == pytest.approx([truth] * len(found.map), rel=0.02)
    for curve in found.curves:
        expected = math.exp(-2.0 * (math.pi * 0.8 * curve.frequency) ** 2) * np.sinc(curve.frequency)
        assert curve.sagittal == pytest.approx([expected] * len(found.radii), abs=0.03)


@pytest.mark.parametrize("network", [True, False])
def test_a_figure_has_a_range_as_wide_as_the_blur_is_unsure(
    monkeypatch: pytest.MonkeyPatch, network: bool
) -> None:
    query = LensModel.query

    def unsure(model: LensModel, place: FieldPosition, *given: object, **options: object) -> PsfAnswer:
        answer = query(model, place, *given, **options)  # type: ignore[arg-type]
        share = 0.1 if place.r < 0.6 else 0.4
        told = {"predicted_error": share, "ring_error": np.full(8, share / 4) if network else None}
        return replace(answer, **told)  # type: ignore[arg-type]

    monkeypatch.setattr(LensModel, "query", unsure)
    found = lens_report(LensModel.fit(samples(1), QUICK), "A lens", rows=3, size=SIZE)

    center, worst = found.tested[0].spots[0], found.tested[0].worst
    for spot, least, most in ((center, 0.05, 0.2), (worst, 0.2, 0.6)):
        low, high = spot.ranges[1]
        assert low < spot.mtf50[1] < high
        assert least < (high - low) / 2.0 / spot.mtf50[1] < most
    low, high = center.mean_range
    assert f"{center.mean:.3f} [{low:.3f} to {high:.3f}]".replace("0.", ".") in found.verdict


def test_beyond_the_outermost_square_of_a_chart_nothing_is_known() -> None:
    chart = []
    for r, phi in itertools.product((0.1, 0.4, 0.7), np.linspace(-3.0, 3.0, 12)):
        # widths that differ so much from place to place that a regression expects large errors
        kernel = gaussian(15, np.eye(2) * (6.0 if phi > 0 else 0.2))
        chart.append(
            PsfSample(kernel, FieldPosition(r, phi), LensSettings(2.8), estimator="measured-edges/1")
        )
    report = lens_report(LensModel.fit(chart), "")
    found = report.tested[0]

    assert max(spot.predicted_error for spot in found.map) > 0.5
    radii = np.array([spot.position.r for spot in found.map])
    unknown = np.array([spot.unknown for spot in found.map])
    assert unknown[radii > 0.78].all()
    assert not unknown[radii < 0.65].any()
    for spot in found.map:  # not known to the 15 percent of what was measured
        if spot.mtf50[0] < 0.5:
            low, high = spot.mtf50[0] * (1.0 + spot.predicted_error * np.array([-1.0, 1.0]))
            assert spot.ranges[0][0] <= max(low, 0.0) + 1e-9
            assert spot.ranges[0][1] >= min(high, 0.5) - 1e-9
    assert {row[1] for row in place_table(report)[1] if "(not known)" in row[1]} == {
        f"{spot.place} (not known)" for spot in found.spots if spot.unknown
    }
    assert drawn(report).count(b"url(#h") == 2 * unknown.sum()  # hatched, in T and in S


def test_sides_are_given_apart_and_their_two_directions_too() -> None:
    found = report_of(bad_side=0.8, astigmatic=1.8)

    head, rows = place_table(found)
    assert head[:4] == ["Aperture", "Place", "T, cycles/pixel", "S, cycles/pixel"]
    table = {row[1]: [float(cell.split(" [")[0]) for cell in row[2:4]] for row in rows}
    assert list(table)[:5] == ["centre", "left", "right", "top", "bottom"]
    assert table["left"][1] > 1.1 * table["right"][1]
    assert table["left"][0] < 0.8 * table["left"][1]
    curves = found.tested[0].curves
    assert curves[0].tangential[-1] < curves[0].sagittal[-1] - 0.05
    assert curves[-1].tangential[0] == curves[-1].sagittal[0]
    directions = {row["direction"] for row in rows_of(found) if row["quantity"] == "MTF50 at the left"}
    assert directions == {"tangential", "sagittal"}


def test_the_verdict_names_the_worst_corner_and_does_not_contradict_the_map() -> None:
    found = report_of(bad_side=0.8)

    assert found.tested[0].worst.place in {"upper right corner", "lower right corner"}
    assert re.search(r"worst corner, the (upper|lower) right, is (much|clearly) softer", found.verdict)
    assert "the right is softer than the opposite side" in found.verdict
    assert re.search(r"worst corner, .*, is as sharp \(T", report_of(corner=0.8).verdict)


@pytest.mark.parametrize("corner", [0.8, 2.0])
def test_the_verdict_is_as_sure_of_the_corners_as_the_map(corner: float) -> None:
    found = report_of(corner=corner).tested[0]
    unknown, known = (
        replace(found, spots=tuple(replace(spot, unknown=gone) for spot in found.spots))
        for gone in (True, False)
    )

    assert re.search(r"seems? .*, but too little is known there\.$", sharpness(unknown))
    assert re.search(r"(is|seems) (as|nearly as|clearly|much) ", sharpness(known))
    assert "little is known" not in sharpness(known)
    assert [spot.unknown for spot in found.spots] == [spot.predicted_error >= UNKNOWN for spot in found.spots]


def test_a_point_within_a_pixel_is_reported_as_at_least_nyquist() -> None:
    given = [
        replace(s, kernel=delta(SIZE), pixel_pitch_um=None) for s in samples() if s.settings.channel == "g"
    ]
    found = lens_report(LensModel.fit(given, QUICK), "Perfect", rows=2, size=SIZE)

    assert "very sharp in the centre" in found.verdict
    assert "at least .500" in place_table(found)[1][0][2]
    assert ">.50" in drawn(found).decode().replace("&gt;", ">")
    rows = [row for row in rows_of(found) if row["quantity"] == "MTF50"]
    assert {(row["value"], row["low"], row["high"]) for row in rows} == {("0.5", "0.5", "0.5")}


def test_all_documents_hold_the_same_figures(soft: LensReport) -> None:
    assert from_json(LensReport, json.loads(json.dumps(to_json(soft), allow_nan=False))) == soft
    rows = rows_of(soft)
    first = next(row for row in rows if row["quantity"] == "MTF50")
    assert float(first["value"]) == pytest.approx(soft.tested[0].map[0].mtf50[0], rel=1e-5)
    written = {row["quantity"]: float(row["value"]) for row in rows[:3]}
    assert written == pytest.approx(
        {f"MTF50, mean of {zone}": value for zone, value in soft.tested[0].zones.items()}, rel=1e-5
    )


def test_the_csv_says_whether_the_lens_is_centred(soft: LensReport) -> None:
    side = Asymmetry(0.2, 0.7, 0.05, significant=True)
    found = replace(soft.tested[0], centring=Centring("decentred", "", side))

    decentred, softer = rows_of(replace(soft, tested=(found,)))[-2:]

    assert (decentred["quantity"], decentred["value"], decentred["unknown"]) == ("decentred", "1", "0")
    columns = ("value", "low", "high", "phi")
    assert [float(softer[name]) for name in columns] == pytest.approx(
        [*np.exp([0.2, 0.1, 0.3]), 0.7], rel=1e-5
    )


def test_pages_are_written_in_each_format_and_the_same_each_time(soft: LensReport) -> None:
    first, second = document(soft, "pdf"), document(soft, "pdf")
    assert first.startswith(b"%PDF-")
    assert first.count(b"/Type /Page ") + first.count(b"/Type /Page\n") == 2
    assert first == second  # no time of day in it
    with Image.open(io.BytesIO(document(soft, "png"))) as picture:
        assert picture.size[0] > 1000


def test_two_copies_are_compared(soft: LensReport) -> None:
    sharp = replace(report_of(corner=1.0, spread=0.02), name="Another lens")

    share = sharp.tested[0].zones["corner"] / soft.tested[0].zones["corner"] - 1.0
    assert share > 0.3
    assert compare(soft, sharp).startswith("Compared with this copy, the other one (Another lens) is ")
    assert compare(soft, sharp).endswith(f"{share:.0%} sharper in the corners.")
    assert "about the same in the centre" in compare(soft, soft)


def test_apertures_are_tested_each_and_the_best_is_named() -> None:
    both = samples(aperture=2.8, corner=2.0) + samples(aperture=8.0, corner=0.9)
    found = lens_report(LensModel.fit(both, QUICK), "A lens", rows=4, size=SIZE)

    assert found.apertures == (2.8, 8.0)
    assert found.at(8.0).zones["corner"] > found.at(2.8).zones["corner"]
    assert "It is sharpest over the whole picture at f/8." in found.verdict
    assert charts(found, None)[-1].title == "MTF50 by aperture"


@pytest.mark.parametrize(("height", "width"), [(2000, 2000), (2128, 2832), (2160, 3840)])
@pytest.mark.parametrize("margin", [40, 96])
def test_the_shape_of_a_picture_is_that_which_its_samples_fill(height: int, width: int, margin: int) -> None:
    frame = Frame(height, width)
    rows, cols = (np.linspace(margin, side - 1 - margin, 8).tolist() for side in (height, width))
    filled = [PsfSample(delta(5), frame.position(*at), photo="a") for at in itertools.product(rows, cols)]

    assert filled_aspect(LensModel.fit(filled, QUICK)) == pytest.approx(width / height, rel=0.01)
    middle = [sample for sample in filled if sample.position.r < 0.6]
    assert filled_aspect(LensModel.fit(middle, QUICK)) == 1.5  # nothing tells


@pytest.mark.parametrize("aspect", [1.0, 16 / 9, 2 / 3, 5.0])
def test_marked_places_lie_on_the_picture_where_their_names_say(aspect: float) -> None:
    places = marked_places(aspect)
    assert len(places) == 9
    for name, place in places.items():
        right, up = (reach / half for reach, half in zip(place.xy, half_sides(aspect), strict=True))
        assert max(abs(right), abs(up)) <= 1.0
        assert np.sign(np.round([right, up], 6)).tolist() == [
            ("right" in name) - ("left" in name),
            ("upper" in name or "top" in name) - ("lower" in name or "bottom" in name),
        ]


@pytest.mark.parametrize("aspect", [0.1, 3000.0])
def test_a_strip_is_refused_before_its_map_is_made(aspect: float) -> None:
    with pytest.raises(InvalidInputError, match="width over height"):
        lens_report(LensModel.fit(samples(1), QUICK), "A lens", aspect=aspect)


def test_angles_are_named_counter_clockwise_from_the_right() -> None:
    sides = {0.0: "right", math.pi / 2: "top", -math.pi / 2: "bottom", math.pi: "left"}
    sides |= {-math.pi + 1e-9: "left", CORNER: "upper right", math.pi - CORNER: "upper left"}
    sides |= {CORNER - math.pi: "lower left", -CORNER: "lower right"}
    assert {phi: direction_in_words(phi) for phi in sides} == sides


@pytest.mark.parametrize(
    ("phi", "corner"), [(CORNER, "upper right corner"), (CORNER - math.pi, "lower left corner")]
)
def test_the_corner_that_no_photo_shows_is_asked_for_at_its_aperture(phi: float, corner: str) -> None:
    seen = [s for s in samples() if s.position.r < 0.6 or math.cos(s.position.phi - phi) < 0.5]
    found = lens_report(LensModel.fit(seen, QUICK), "A lens", rows=2, size=SIZE)

    assert f"{corner}, taken at f/2.8," in found.advice
    assert found.advice in found.summary
    one = found.tested[0]
    known = tuple(replace(s, predicted_error=0.05) for s in one.spots)
    assert "add little" in replace(found, tested=(replace(one, spots=known),)).advice
