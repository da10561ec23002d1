"""Centring, against lenses whose faults are known, fed with their true kernels."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample, rms_width
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel
from lensmodel.report.centring import EDGE_R, Asymmetry, _verdict, centring
from lensmodel.simulate import SimulatedLens, draw_lens

SIZE = 21


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


def wide_open(lens: SimulatedLens) -> LensSettings:
    return LensSettings(aperture=lens.optics[0].f_number)


def true_samples(lens: SimulatedLens, photos: int, cells: tuple[int, int] = (3, 5)) -> list[PsfSample]:
    settings = wide_open(lens)
    return [
        PsfSample(true_kernel(lens, p, settings), p, settings, photo=f"p{i}")
        for i in range(photos)
        for p in places(i, *cells)
    ]


def quick(samples: list[PsfSample]) -> LensModel:
    """A model that is made fast: the centring is judged by the samples, whatever smooths them."""
    return LensModel.fit(samples, "paper")


def aligned(kind: str, decentred: tuple[float, float] = (0.0, 0.0)) -> SimulatedLens:
    """A drawn lens whose copy has no fault but a shift of its axis."""
    lens = draw_lens(1000, kind)
    none = dict.fromkeys(("uniform_coma", "uniform_astigmatism", "tilt"), (0.0, 0.0))
    return replace(lens, optics=(replace(lens.optics[0], decentring=decentred, **none),))


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

        found = centring(quick(true_samples(lens, 3)), wide_open(lens))

        assert found.verdict == "decentred"
        assert found.softer is not None
        assert apart(found.softer.direction, direction + math.pi) < 30.0

    def test_a_centred_lens_is_called_centred(self, kind: str) -> None:
        lens = aligned(kind)

        found = centring(quick(true_samples(lens, 3)), wide_open(lens))

        assert found.verdict == "centred"
        assert "well centred within what 3 photos can tell" in found.text


@pytest.mark.parametrize("seed", [1000, 1001])
@pytest.mark.parametrize("kind", ["decentred", "tilted"])
def test_drawn_faults_are_found_on_the_side_where_the_truth_is_softer(kind: str, seed: int) -> None:
    lens = draw_lens(seed, kind)
    settings = wide_open(lens)
    angles = np.arange(8) * math.pi / 4
    width = [rms_width(lens.kernel(FieldPosition(0.7, a), settings, 31)) for a in angles]
    softer = float(np.angle((np.log(width) * np.exp(1j * angles)).sum()))

    found = centring(quick(true_samples(lens, 3)), settings)

    assert found.verdict == "decentred"
    assert found.softer is not None
    assert apart(found.softer.direction, softer) < 30.0


def test_the_mirror_image_flips_the_direction_and_keeps_the_amount() -> None:
    samples = true_samples(draw_lens(1000, "decentred"), 2)
    settings = samples[0].settings

    one = centring(LensModel.fit(samples), settings)
    other = centring(LensModel.fit(mirrored(samples)), settings)

    for a, b in ((one.softer, other.softer), (one.coma, other.coma)):
        assert a is not None
        assert b is not None
        assert apart(a.direction, math.pi - b.direction) < 1e-3
        assert b.amount == pytest.approx(a.amount, rel=1e-6)
        assert b.error == pytest.approx(a.error, rel=1e-6)


def test_photos_that_contradict_each_other_widen_the_error() -> None:
    lens = aligned("astigmatism")
    steady = true_samples(lens, 4)
    # each photo is softer at a side of its own, as of subjects at a slant
    turns = {"p0": 0.0, "p1": 1.5, "p2": 3.0, "p3": 4.6}
    widths = [1.5 + math.cos(s.position.phi - turns[s.photo]) * s.position.r for s in steady]
    slanted = [replace(s, kernel=gaussian(SIZE, np.eye(2) * w)) for s, w in zip(steady, widths, strict=True)]
    sure = centring(quick(steady), wide_open(lens)).softer
    unsure = centring(quick(slanted), wide_open(lens))

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
    found = [centring(noisy(seed, 5, 0.0), LensSettings(aperture=2.0)) for seed in range(8)]

    softer = [f.softer for f in found if f.softer is not None]
    scatter = math.sqrt(np.mean([s.amount**2 / 2.0 for s in softer]))
    assert all(f.verdict == "centred" for f in found)
    assert 0.6 < scatter / np.mean([s.error for s in softer]) < 1.5


def test_a_tilt_is_found_through_the_scatter() -> None:
    found = centring(noisy(0, 5, 0.35), LensSettings(aperture=2.0))

    assert found.verdict == "decentred"
    assert found.softer is not None
    assert apart(found.softer.direction, 1.0) < 30.0
    assert found.softer.amount == pytest.approx(2.0 * EDGE_R * 0.35, abs=4.0 * found.softer.error)


@pytest.mark.parametrize(
    ("count", "words"), [(8, "8 samples"), (15, "one photo cannot tell this from a subject at a slant")]
)
def test_a_handful_of_samples_or_one_photo_cannot_tell(count: int, words: str) -> None:
    lens = draw_lens(1000, "decentred")

    found = centring(LensModel.fit(true_samples(lens, 1)[:count]), wide_open(lens))

    assert found.verdict == "unknown"
    assert (found.softer is None) is (count == 8)
    assert words in found.text


@pytest.mark.parametrize(("estimator", "verdict"), [("default", "unknown"), ("measured-edges", "centred")])
def test_one_ordinary_photo_does_not_prove_a_lens_centred_and_a_chart_does(
    estimator: str, verdict: str
) -> None:
    samples = [replace(s, estimator=estimator) for s in true_samples(aligned("coma"), 1, cells=(6, 8))]

    assert centring(quick(samples), samples[0].settings).verdict == verdict


@pytest.mark.parametrize(
    ("sides", "error", "verdict"),
    [(0.24, 0.10, "unknown"), (0.08, 0.05, "centred"), (0.48, 0.1, "unknown"), (8.95, 12.3, "unknown")],
)
def test_sides_that_may_differ_by_much_are_undecided(sides: float, error: float, verdict: str) -> None:
    softer = Asymmetry(math.log1p(sides), 0.0, math.log1p(2.0 * error) / 2.0, significant=False)

    assert _verdict(softer, None, 5).verdict == verdict
    assert ("%" in _verdict(softer, None, 5).text) is (error < 1.0)
    assert _verdict(replace(softer, significant=True, amount=0.5), None, 5).verdict == "decentred"
