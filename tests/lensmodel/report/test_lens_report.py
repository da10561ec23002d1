"""The report against lenses whose faults are known, fed with their true kernels."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scipy import stats

from lensmodel.core.codec import from_json, to_json
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.quality import mtf50_from_kernel
from lensmodel.report import LensReport, ReportSettings, decentring, lens_report
from lensmodel.report.decentring import _CHANCE, EDGE_R, _exceeded_by_chance
from lensmodel.report.field_shape import widths_along
from lensmodel.report.places import grid, half_sides, ring
from lensmodel.simulate import SimulatedLens, draw_lens

SIZE = 21
SMALL = ReportSettings(rows=3, cols=4, size=SIZE)


def places(seed: int, rows: int = 3, cols: int = 5) -> list[FieldPosition]:
    """One place in each cell of a 3:2 frame."""
    rng = np.random.default_rng(seed)
    found = []
    for i in range(rows):
        for j in range(cols):
            y = (1.0 - (i + rng.uniform(0.1, 0.9)) * 2.0 / rows) / math.hypot(1.5, 1.0)
            x = ((j + rng.uniform(0.1, 0.9)) * 2.0 / cols - 1.0) * 1.5 / math.hypot(1.5, 1.0)
            found.append(FieldPosition(math.hypot(x, y), math.atan2(y, x)))
    return found


@cache
def true_kernel(lens: SimulatedLens, place: FieldPosition, settings: LensSettings) -> Kernel:
    return lens.kernel(place, settings, SIZE)


def true_samples(
    lens: SimulatedLens,
    photos: int,
    aperture: float | None = None,
    pitch: float | None = None,
    cells: tuple[int, int] = (3, 5),
) -> list[PsfSample]:
    settings = LensSettings(aperture=aperture or lens.optics[0].f_number)
    return [
        PsfSample(true_kernel(lens, p, settings), p, settings, photo=f"p{i}", pixel_pitch_um=pitch)
        for i in range(photos)
        for p in places(i, *cells)
    ]


def quick(samples: list[PsfSample]) -> LensModel:
    """A model that is made fast: the centring is judged by the samples, whatever smooths them."""
    return LensModel.fit(
        samples, ModelSettings(r=0.2, phi=0.5, mirror=0.0, method="nadaraya-watson", robust=False)
    )


def aligned(kind: str, seed: int = 1000, decentred: tuple[float, float] = (0.0, 0.0)) -> SimulatedLens:
    """A drawn lens whose copy has no fault but a shift of its axis."""
    lens = draw_lens(seed, kind)
    none = (0.0, 0.0)
    optics = replace(
        lens.optics[0], decentring=decentred, uniform_coma=none, uniform_astigmatism=none, tilt=none
    )
    return replace(lens, optics=(optics,))


def wide_open(lens: SimulatedLens) -> LensSettings:
    return LensSettings(aperture=lens.optics[0].f_number)


def apart(a: float, b: float) -> float:
    """Angle between two directions in degrees."""
    return abs(math.degrees((a - b + math.pi) % (2.0 * math.pi) - math.pi))


def mirrored(samples: list[PsfSample]) -> list[PsfSample]:
    """The same lens seen in a mirror: left and right change places."""
    return [
        replace(s, kernel=s.kernel[:, ::-1], position=FieldPosition(s.position.r, math.pi - s.position.phi))
        for s in samples
    ]


@pytest.mark.parametrize("kind", ["soft-fast", "coma", "astigmatism", "field-curvature", "nearly-perfect"])
class TestDecentring:
    @pytest.mark.parametrize("direction", [0.7, -2.0])
    def test_the_side_away_from_the_shifted_axis_is_found_within_30_degrees(
        self, kind: str, direction: float
    ) -> None:
        lens = aligned(kind, decentred=(0.25 * math.cos(direction), 0.25 * math.sin(direction)))

        found = decentring(quick(true_samples(lens, 3)), wide_open(lens))

        assert found.verdict == "decentred"
        assert found.softer is not None
        assert apart(found.softer.direction, direction + math.pi) < 30.0

    def test_a_centred_lens_is_called_centred(self, kind: str) -> None:
        lens = aligned(kind)

        found = decentring(quick(true_samples(lens, 3)), wide_open(lens))

        assert found.verdict == "centred"
        assert "well centred within what 3 photos can tell" in found.text
        assert found.part is None


@pytest.mark.parametrize("seed", [1000, 1001])
@pytest.mark.parametrize("kind", ["decentred", "tilted"])
def test_drawn_faults_are_found_on_the_side_where_the_truth_is_softer(kind: str, seed: int) -> None:
    lens = draw_lens(seed, kind)
    settings = wide_open(lens)
    angles = np.arange(8) * math.pi / 4
    width = [np.sum(widths_along(lens.kernel(FieldPosition(0.7, a), settings, 31), a)) for a in angles]
    softer = float(np.angle((np.log(width) * np.exp(1j * angles)).sum()))

    found = decentring(quick(true_samples(lens, 3)), settings)

    assert found.verdict == "decentred"
    assert found.softer is not None
    assert apart(found.softer.direction, softer) < 30.0


def test_the_mirror_image_flips_the_direction_and_keeps_the_amount() -> None:
    samples = true_samples(draw_lens(1000, "decentred"), 2)
    settings = samples[0].settings

    one = decentring(LensModel.fit(samples), settings)
    other = decentring(LensModel.fit(mirrored(samples)), settings)

    for a, b in ((one.softer, other.softer), (one.coma, other.coma)):
        assert a is not None
        assert b is not None
        assert apart(a.direction, math.pi - b.direction) < 1e-3
        assert b.amount == pytest.approx(a.amount, rel=1e-6)
        assert b.error == pytest.approx(a.error, rel=1e-6)


def test_a_larger_shift_is_a_larger_asymmetry() -> None:
    amounts = []
    for shift in (0.05, 0.15, 0.3):
        lens = aligned("astigmatism", decentred=(shift, 0.0))
        found = decentring(quick(true_samples(lens, 2)), wide_open(lens))
        assert found.softer is not None
        amounts.append(found.softer.amount)

    assert amounts[0] < amounts[1] < amounts[2]


def test_photos_that_contradict_each_other_widen_the_error() -> None:
    lens = aligned("astigmatism")
    steady = true_samples(lens, 4)
    slanted = [
        # each photo is softer at a side of its own, as of subjects at a slant
        replace(s, kernel=gaussian(SIZE, np.eye(2) * (1.5 + math.cos(s.position.phi - turn) * s.position.r)))
        for turn, name in ((0.0, "p0"), (1.5, "p1"), (3.0, "p2"), (4.6, "p3"))
        for s in steady
        if s.photo == name
    ]
    sure = decentring(quick(steady), wide_open(lens)).softer
    unsure = decentring(quick(slanted), wide_open(lens))

    assert sure is not None
    assert unsure.softer is not None
    assert unsure.softer.error > 5.0 * sure.error
    assert unsure.verdict != "decentred"


def noisy(seed: int, photos: int, tilt: float) -> LensModel:
    """Round kernels whose widths scatter by a tenth; with a tilt, softer towards 1 radian."""
    rng = np.random.default_rng(seed)
    samples = []
    for i in range(photos):
        for p in places(100 * seed + i, 4, 6):
            log_w = tilt * p.r * math.cos(p.phi - 1.0) + rng.normal(0.0, 0.1)
            kernel = gaussian(SIZE, np.eye(2) * ((1.0 + p.r**2) * math.exp(log_w)) ** 2)
            samples.append(PsfSample(kernel, p, LensSettings(aperture=2.0), photo=f"p{i}"))
    return quick(samples)


def test_errors_are_as_large_as_the_scatter_of_centred_lenses() -> None:
    found = [decentring(noisy(seed, 5, 0.0), LensSettings(aperture=2.0)) for seed in range(8)]

    softer = [f.softer for f in found if f.softer is not None]
    scatter = math.sqrt(np.mean([s.amount**2 / 2.0 for s in softer]))
    assert all(f.verdict == "centred" for f in found)
    assert 0.6 < scatter / np.mean([s.error for s in softer]) < 1.5


@pytest.mark.parametrize("seed", range(2))
def test_a_tilt_is_found_through_the_scatter(seed: int) -> None:
    found = decentring(noisy(seed, 5, 0.35), LensSettings(aperture=2.0))

    assert found.verdict == "decentred"
    assert found.softer is not None
    assert apart(found.softer.direction, 1.0) < 30.0
    assert found.softer.amount == pytest.approx(2.0 * EDGE_R * 0.35, abs=4.0 * found.softer.error)


def test_a_handful_of_samples_cannot_tell() -> None:
    lens = draw_lens(1000, "decentred")

    found = decentring(LensModel.fit(true_samples(lens, 1)[:8]), wide_open(lens))

    assert found.verdict == "unknown"
    assert found.softer is None
    assert "8 samples" in found.text


def test_one_photo_is_told_to_be_one_photo() -> None:
    lens = draw_lens(1000, "decentred")

    found = decentring(LensModel.fit(true_samples(lens, 1)), wide_open(lens))

    assert found.verdict == "unknown"
    assert "one photo cannot tell this from a subject at a slant" in found.text


@pytest.mark.parametrize("half", [1, 2, 23, 400])
def test_what_chance_exceeds_is_the_quantile_of_f(half: int) -> None:
    expected = stats.f.ppf(1.0 - _CHANCE, 2, 2 * half)

    assert _exceeded_by_chance(half) == pytest.approx(expected, rel=1e-9)


def test_a_report_survives_json() -> None:
    lens = draw_lens(1001, "decentred")
    report = lens_report(LensModel.fit(true_samples(lens, 2, pitch=4.5)), options=SMALL)

    stored = json.loads(json.dumps(to_json(report), allow_nan=False))

    assert from_json(LensReport, stored) == report


def test_the_map_tells_the_sharpness_of_the_true_kernels() -> None:
    lens = draw_lens(1000, "coma")
    settings = wide_open(lens)
    report = lens_report(LensModel.fit(true_samples(lens, 3, cells=(4, 6))), settings, SMALL)

    for point in report.field:
        truth = lens.kernel(point.position, settings, SIZE)
        phi = point.position.phi
        assert point.tangential == pytest.approx(mtf50_from_kernel(truth, phi), rel=0.2)
        assert point.sagittal == pytest.approx(mtf50_from_kernel(truth, phi + math.pi / 2), rel=0.2)


def ring_model(along: float, across: float) -> LensModel:
    """Gaussians whose width along u and along v grow with r by their own share, in three photos."""
    samples = []
    for i in range(3):
        for p in places(i):
            u = np.array([-math.sin(p.phi), math.cos(p.phi)])
            v = np.array([-math.cos(p.phi), -math.sin(p.phi)])
            a, b = 1.0 + along * p.r**2, 1.0 + across * p.r**2
            kernel = gaussian(SIZE, a**2 * np.outer(u, u) + b**2 * np.outer(v, v))
            samples.append(PsfSample(kernel, p, LensSettings(aperture=2.0), photo=f"p{i}"))
    return LensModel.fit(samples)


def test_points_drawn_out_along_the_radius_lower_the_tangential_contrast() -> None:
    report = lens_report(ring_model(1.0, 0.2), options=SMALL)

    for curve in report.curves:
        assert curve.tangential[-1] < curve.sagittal[-1] - 0.05
        assert curve.tangential[0] == curve.sagittal[0]
    assert report.shape.difference[-1] == pytest.approx(0.8 * 0.95**2, abs=0.15)
    assert "drawn out radially" in report.shape.text


def test_points_drawn_out_around_the_center_are_told_apart() -> None:
    report = lens_report(ring_model(0.2, 1.0), options=SMALL)

    assert report.curves[-1].sagittal[-1] < report.curves[-1].tangential[-1]
    assert "drawn out around the centre" in report.shape.text


def test_contrast_of_curves_falls_with_frequency_and_is_that_of_a_gaussian() -> None:
    report = lens_report(ring_model(0.0, 0.0), options=SMALL)

    for curve in report.curves:
        pixel = np.sinc(curve.frequency)
        expected = math.exp(-2.0 * (math.pi * curve.frequency) ** 2) * pixel
        assert curve.tangential == pytest.approx([expected] * len(report.radii), abs=0.02)
        assert curve.tangential_spread == pytest.approx([0.0] * len(report.radii), abs=0.02)


def test_curves_are_at_10_to_40_line_pairs_where_the_pitch_is_known() -> None:
    report = lens_report(LensModel.fit(true_samples(draw_lens(1000), 1, pitch=5.0)), options=SMALL)

    assert [curve.lp_mm for curve in report.curves] == [10.0, 20.0, 30.0, 40.0]
    assert [curve.frequency for curve in report.curves] == pytest.approx([0.05, 0.1, 0.15, 0.2])


def test_the_best_aperture_is_that_of_the_true_lens() -> None:
    lens = draw_lens(1000, "soft-fast")
    stops = [lens.optics[0].f_number, 4.0, 8.0, 22.0]
    samples = [replace(s, photo=f"{n}") for n in stops for s in true_samples(lens, 1, n)]

    report = lens_report(LensModel.fit(samples), options=SMALL)

    assert [row.aperture for row in report.apertures] == stops
    center = [
        np.mean(
            [
                mtf50_from_kernel(lens.kernel(p, LensSettings(aperture=n), SIZE), p.phi)
                for p in ring(0.15, 1, 1.5)
            ]
        )
        for n in stops
    ]
    assert report.best_aperture["center"] == stops[int(np.argmax(center))]
    assert any(line.startswith("sharpest at f/") for line in report.summary)


def test_one_aperture_has_no_best() -> None:
    report = lens_report(LensModel.fit(true_samples(draw_lens(1000), 1)), options=SMALL)

    assert report.best_aperture == {}


@pytest.mark.parametrize("aspect", [1.0, 1.5, 16 / 9, 2 / 3])
@pytest.mark.parametrize("r", [0.3, 0.6, 0.8, 0.95])
def test_rings_lie_on_the_picture_and_balance(r: float, aspect: float) -> None:
    found = ring(r, 3, aspect)

    width, height = half_sides(aspect)
    assert max(abs(p.r * math.cos(p.phi)) for p in found) <= width + 1e-9
    assert max(abs(p.r * math.sin(p.phi)) for p in found) <= height + 1e-9
    assert sum(math.cos(p.phi) for p in found) == pytest.approx(0.0, abs=1e-9)
    assert sum(math.sin(p.phi) for p in found) == pytest.approx(0.0, abs=1e-9)


def test_grids_run_row_by_row_from_the_top_left() -> None:
    found = grid(3, 5, 1.5)

    assert len(found) == 15
    assert found[0].phi > math.pi / 2
    assert 0 < found[4].phi < math.pi / 2
    assert found[7].r == pytest.approx(0.0)
    assert -math.pi < found[10].phi < -math.pi / 2


@pytest.mark.parametrize(
    "make",
    [
        lambda: ReportSettings(size=4),
        lambda: ReportSettings(frequencies=(0.7,)),
        lambda: grid(0, 3, 1.5),
        lambda: ring(0.5, 1, 9.0),
    ],
)
def test_settings_out_of_range_are_refused(make: object) -> None:
    with pytest.raises(InvalidInputError):
        make()  # type: ignore[operator]  # a callable, by the list above
