from __future__ import annotations

import json
import lzma
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy import ndimage, signal

from lab import cases as making
from lab import kernels
from lab.blind import benchmark, judge
from lab.blind.benchmark import BlindBenchmark, BlindReport, CaseResult, run_blind_benchmark, summarised
from lab.cases import _apart, list_photos, load_psfs, make_cases, observe, photo_half, scene_of
from lab.outside import judged
from lab.stored import ROOT
from lensmodel.blind import PsfEstimate
from lensmodel.core import psf
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.registry import Registry
from lensmodel.core.types import FieldPosition, LensSettings, NoiseModel, Plane
from lensmodel.patches import Patch


@pytest.fixture(scope="module", autouse=True)
def small_photos(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Show parts of the library's own photographs: to read whole ones takes longer than the rest of a run."""
    folder = tmp_path_factory.mktemp("photos")
    for path in list_photos():
        with Image.open(path) as whole:
            whole.crop((300, 200, 860, 660)).save(folder / f"{path.stem}.png", compress_level=1)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(making, "demo_data_path", lambda name: folder / Path(name).with_suffix(".png"))
        yield


@dataclass(frozen=True)
class Fake:
    """Answers with a Gaussian, and counts how often it was asked."""

    sigma: float = 1.2
    name: str = "fake"
    version: int = 1
    asked: list[int] = field(default_factory=list, compare=False, repr=False)

    def estimate(
        self, patches: Sequence[Plane], noise: Sequence[NoiseModel], *, size: int = 31
    ) -> PsfEstimate:
        self.asked.append(len(patches))
        return PsfEstimate(kernels.gaussian(size, np.eye(2) * self.sigma**2), 0.3)


def run(cache: Path | None = None, *, cases: int = 3, **methods: Fake) -> BlindReport:
    """Run the benchmark on a few small cases."""
    wanted = BlindBenchmark(methods=tuple(methods), patch=128, cases=cases, half="all")
    known = Registry("method", {name: (lambda m=m: m) for name, m in methods.items()})
    return run_blind_benchmark(wanted, cache=cache, methods=known)


@dataclass(frozen=True)
class Declining(Fake):
    def estimate(self, patches: Sequence[Plane], noise: Sequence[NoiseModel], **_: object) -> PsfEstimate:
        raise NotEnoughEvidenceError("nothing to see")


@pytest.fixture(scope="module")
def report() -> BlindReport:
    return run(narrow=Fake(0.3), wide=Fake(9.0), shy=Declining())


@pytest.fixture(scope="module")
def scene() -> Plane:
    return scene_of(list_photos()[3])[1][:192, :192]


def test_judge_brings_a_blurred_scene_nearer_to_the_truth(scene: Plane) -> None:
    kernel = kernels.gaussian(15, [[2.0, 0.5], [0.5, 1.0]])
    blurred = signal.fftconvolve(np.pad(scene, 7, mode="reflect"), kernel, mode="valid")
    noisy = (blurred + np.random.default_rng(0).normal(0, 0.003, scene.shape)).astype(np.float32)
    restored = judge.deconvolved(noisy, kernel, 0.003, (0.0, 0.0))

    assert restored.shape == scene.shape
    assert judge.squared_error(restored, scene) < 0.7 * judge.squared_error(noisy, scene)


def test_kernel_shifted_by_the_judge_is_the_kernel_shifted_on_the_grid() -> None:
    kernel = np.zeros((9, 9))
    kernel[2, 5], kernel[4, 4] = 0.25, 0.75
    moved = np.roll(kernel, (1, -2), axis=(0, 1))

    np.testing.assert_allclose(
        judge.shifted_otf(kernel, (32, 32), (1.0, -2.0)),
        judge.shifted_otf(moved, (32, 32), (0.0, 0.0)),
        atol=1e-12,
    )


def test_padding_joins_without_a_jump() -> None:
    ramp = np.add.outer(np.arange(64.0), np.arange(64.0)).astype(np.float32)
    padded = judge.tapered(ramp, 28)
    largest_step = max(np.abs(np.diff(padded, axis=axis)).max() for axis in (0, 1))

    assert np.abs(padded[0] - padded[-1]).max() <= largest_step
    assert np.abs(padded[:, 0] - padded[:, -1]).max() <= largest_step
    np.testing.assert_array_equal(padded[28:-28, 28:-28], ramp)


@dataclass(frozen=True)
class Oracle(Fake):
    """Knows the true kernel of a case and returns it off centre."""

    kernel: tuple[tuple[float, ...], ...] = ()

    def estimate(self, patches: Sequence[Plane], noise: Sequence[NoiseModel], **_: object) -> PsfEstimate:
        off_centre = np.roll(np.pad(np.array(self.kernel), 2), (1, 2), axis=(0, 1))
        return PsfEstimate(psf.as_kernel(off_centre), 0.3)


def test_error_ratio_of_the_true_kernel_is_one(monkeypatch: pytest.MonkeyPatch) -> None:
    kernel = load_psfs()[3]
    monkeypatch.setattr(benchmark, "load_psfs", lambda: kernel[None])
    rows = [r for r in run(oracle=Oracle(kernel=tuple(map(tuple, kernel)))).results if r.method == "oracle"]

    assert len(rows) == 3
    for row in rows:
        assert row.error_ratio == pytest.approx(1.0, rel=1e-3)
        assert row.ncc == pytest.approx(1.0, abs=1e-6)
        assert row.untouched_ratio > 1.2
        assert row.improved


def test_harm_is_told_from_declining_which_leaves_the_patch(report: BlindReport) -> None:
    wide = next(row for row in summarised(report.results) if row["method"] == "wide")
    left = [row for row in report.results if row.method in {benchmark.UNTOUCHED, "shy"}]

    assert wide["improved"] == 0.0
    assert wide["width_ratio"] > 1.5
    assert [row.declined for row in left] == [row.method == "shy" for row in left]
    assert len(left) == 6
    assert all(row.error_ratio == row.untouched_ratio and not row.improved for row in left)


def test_halves_share_no_photo_and_no_psf() -> None:
    photos = tuple(
        Path(f"{stem}.png") for stem in ("s01_city_sunset", "s03_lake_mountains", "s05_colosseum", "mine")
    )
    options = {"noise": 0.01, "patch": 256, "seed": 0, "limit": None}
    halves = {half: make_cases(photos, 12, half=half, **options) for half in ("dev", "test", "all")}
    pairs = {half: {(c.photo, c.psf_number) for c in cases} for half, cases in halves.items()}

    assert not {p for p, _ in pairs["dev"]} & {p for p, _ in pairs["test"]}
    assert not {n for _, n in pairs["dev"]} & {n for _, n in pairs["test"]}
    assert len(pairs["all"]) == 48
    assert pairs["dev"] | pairs["test"] <= pairs["all"]
    assert [photo_half(name) for name in ("city", "s01_city_sunset", "lake")] == ["test", "test", "dev"]


def test_a_limit_spreads_over_photos_and_psfs() -> None:
    cases = make_cases(list_photos(), 12, half="all", noise=0.01, patch=256, seed=0, limit=10)

    assert len({c.photo for c in cases}) == 5
    assert len({c.psf_number for c in cases}) == 10


@pytest.mark.slow
def test_more_scenes_than_photos_are_further_windows_of_the_same_photos() -> None:
    options = {"half": "all", "noise": 1e-3, "patch": 128, "seed": 3}
    cases = make_cases(list_photos(), 2, limit=None, scenes=12, **options)

    assert len(cases) == len({case.name for case in cases}) == 24
    assert [len({c.photo for c in cases if c.window == k}) for k in range(3)] == [5, 5, 2]
    first = {c.window: c for c in cases if c.photo == cases[0].photo and c.psf_number == 0}
    kernel = load_psfs()[4]
    sharp = [observe(first[k], kernel).sharp for k in range(3)]
    assert not any(np.array_equal(a, b) for a, b in pairwise(sharp))
    with pytest.raises(InvalidInputError, match="at least one scene, not 0"):
        make_cases(list_photos(), 2, limit=None, scenes=0, **options)


def test_windows_overlap_none_before_them_as_long_as_there_are_such() -> None:
    there = FieldPosition(0.5, 0.0)
    best, beside, far = (Patch(0, col, 64, there, 1.0, 0) for col in (0, 32, 64))

    assert [_apart([best, beside, far], k).col for k in range(4)] == [0, 64, 32, 0]


def test_observation_is_the_scene_through_the_psf() -> None:
    kernel = load_psfs()[4]
    (case,) = make_cases(list_photos(), 12, half="all", noise=1e-4, patch=128, seed=3, limit=1)
    seen = observe(case, kernel)
    inner = (slice(27, -27), slice(27, -27))
    again = ndimage.convolve(seen.sharp.astype(np.float64), kernel)

    assert seen.sharp.shape == seen.patch.shape == (128, 128)
    assert np.abs(again - seen.patch)[inner].max() < 1e-3


def test_bad_settings_are_named(tmp_path: Path) -> None:
    with pytest.raises(InvalidInputError, match="noise"):
        BlindBenchmark(noise=(0.0,))
    with pytest.raises(InvalidInputError, match="default"):
        run_blind_benchmark(BlindBenchmark(methods=("best",)))
    with pytest.raises(InvalidInputError, match="no PNG"):
        list_photos(tmp_path)


def test_a_second_run_computes_nothing_and_a_stopped_one_goes_on_where_it_was(tmp_path: Path) -> None:
    first, second, third = Fake(), Fake(), Fake()
    one = run(tmp_path, fake=first)
    two = run(tmp_path, fake=second)

    assert (len(first.asked), len(second.asked)) == (3, 0)
    assert two.to_json() == one.to_json()

    stored = tmp_path / "blind.jsonl"
    lines = stored.read_text().splitlines(keepends=True)
    stored.write_text("".join(lines[:-1]) + lines[-1][:30])  # killed while it wrote
    run(tmp_path, fake=third)

    assert len(third.asked) == 1


def test_a_changed_method_is_computed_again(tmp_path: Path) -> None:
    for method in (Fake(), Fake(sigma=1.3), Fake(version=2)):
        run(tmp_path, cases=1, fake=method)

        assert len(method.asked) == 1


def test_the_published_cases_are_all_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    with lzma.open(ROOT / "docs" / "lab" / "blind-cases.jsonl.xz") as packed:
        (tmp_path / "blind.jsonl").write_bytes(packed.read())

    assert len(dict(benchmark._stored(tmp_path / "blind.jsonl"))) == 7 * 24
    assert not caplog.records


@pytest.mark.slow
def test_numbers_do_not_depend_on_the_number_of_processes() -> None:
    wanted = BlindBenchmark(methods=(), patch=128, cases=3, half="all")
    one, two = (run_blind_benchmark(wanted, workers=n) for n in (1, 2))

    assert [r.error_ratio for r in one.results] == [r.error_ratio for r in two.results]


def result(ratio: float, method: str = "m", untouched: float = 3.0) -> CaseResult:
    return CaseResult(
        case="c", method=method, noise=0.01, error_ratio=ratio, untouched_ratio=untouched, ncc=0.9,
        rel_l2=0.4, mtf_rmse=0.1, width_px=1.0, true_width_px=2.0, declined=False, seconds=1.0,
    )  # fmt: skip


def test_summary_counts_what_it_says() -> None:
    (row,) = summarised([result(1.0), result(2.5), result(2.9), result(8.0)])

    assert [row[name] for name in ("cases", "improved", "er_lt_3", "er_lt_2")] == [4, 0.75, 0.75, 0.25]
    assert row["er_median"] == pytest.approx(2.7)
    assert row["width_ratio"] == 0.5


def test_report_has_a_row_for_each_method_and_no_nan(report: BlindReport, tmp_path: Path) -> None:
    files = {path.name for path in benchmark.write_report(report, tmp_path)}
    stored = json.loads((tmp_path / "blind.json").read_text(), parse_constant=pytest.fail)

    assert files == {"blind.json", "blind.md", "blind-er-1percent.svg", "blind-er-1percent.png"}
    assert [row["method"] for row in stored["summary"]] == [benchmark.UNTOUCHED, "narrow", "wide", "shy"]
    assert len(stored["cases"]) == 12
    assert benchmark.markdown_table(report).count("\n") == 2 + 4


@pytest.mark.tools
def test_a_lens_learned_from_a_photo_of_the_sky_has_the_psfs_of_its_stars(shared_data: Path) -> None:
    rows = list(judged(shared_data / "psf" / "starfield_a.tiff", LensSettings(aperture=2.8)))
    assert len(rows) >= 5  # of seven: in one cell stars are not single, in another they do not agree
    blind, point = (np.median([getattr(row, name) for row in rows]) for name in ("distance", "point"))
    assert blind < min(0.25, 0.7 * point)
    assert [row.measured_px for row in rows] == pytest.approx([row.blind_px for row in rows], abs=0.25)
