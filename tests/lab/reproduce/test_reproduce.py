"""`lab.reproduce`: planning, keys, tables, pages and resuming; one real run, slow."""

from __future__ import annotations

import json
import re
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from PIL import Image

from lab.kernels import distance
from lab.reproduce import cases, job, measure
from lab.reproduce.cases import BEFORE, PAPER_WAY, RIVAL, TRUE, Case, Reproduction, key_of, planned
from lab.reproduce.fields import MeanField, general_field, symmetric
from lab.reproduce.figures import Flow
from lab.reproduce.job import paper_way, run_reproduction
from lab.reproduce.page import collected, write_json, write_page
from lab.reproduce.tables import Bar, bars, held, kept, paths, share, summary
from lab.scenes import HARD_SCENES
from lab.stored import version_of
from lab.traced import read_grid
from lensmodel.blind.sampling import PRESETS, Config
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import CHANNELS, ZONES, FieldPosition, Frame, zone_of
from lensmodel.simulate import LENS_KINDS

DRAW = job.figures.draw


def case(number: int = 0, **changes: Any) -> Case:
    return replace(planned("quick").cases[number], height=480, width=640, **changes)


def plan(*cases: Case, **changes: Any) -> Reproduction:
    return Reproduction(cases or (case(),), size="quick", **changes)


def photographs(folder: Path, count: int) -> tuple[Path, ...]:
    """Photographs of one colour each; every third stands upright."""
    paths = []
    for i in range(count):
        size = (90, 150) if i % 3 == 0 else (150, 90)
        path = folder / f"photo{i}.png"
        Image.new("RGB", size, (10 * i + 5, 0, 0)).save(path)
        paths.append(path)
    return tuple(paths)


HELIAR, TELEPHOTO = cases.repository_grids()


def traced(path: Path = HELIAR, **changes: Any) -> Case:
    (one,) = planned("quick", lenses=[str(path)]).cases
    return replace(one, height=480, width=640, **changes)


def test_plan_has_eight_kinds_of_lenses_of_both_families_and_says_which_were_looked_at() -> None:
    drawn = [one for one in planned("default").cases if one.grid is None]
    assert len({one.lens.identity.model.split()[1] for one in drawn}) == len(LENS_KINDS) == 8
    assert min(one.seed for one in drawn) >= cases.FIRST_SEED
    quick = planned("quick").cases
    assert [one.family for one in quick] == ["third order"] * 2 + ["ray-traced"] * 2
    assert [one.unseen for one in quick] == [True, True, False, False]
    assert {one.name.partition("-")[0] for one in quick} == {"1008", "1004", "heliar", "reverse"}
    assert len({one.seed for one in quick}) == 4


def test_traced_case_has_the_pitch_the_aperture_and_the_truth_of_its_grid() -> None:
    one, grid, place = traced(), read_grid(HELIAR), FieldPosition(0.7, 2.0)
    assert (one.settings.aperture, one.camera.pitch_um) == (3.5, grid.pitch_um)
    np.testing.assert_array_equal(one.truth().kernel_at(place, "b", 31), grid.kernel_at(place, "b", 31))


def test_key_of_a_traced_lens_follows_the_content_of_its_grid(tmp_path: Path) -> None:
    moved = tmp_path / "elsewhere.npz"
    moved.write_bytes(HELIAR.read_bytes())
    assert traced(moved).seed == traced().seed
    assert key_of(traced(moved), plan(), "1") == key_of(traced(), plan(), "1")
    assert key_of(traced(TELEPHOTO), plan(), "1") != key_of(traced(), plan(), "1")
    with pytest.raises(InvalidInputError, match="one design"):
        planned("quick", lenses=[str(HELIAR), str(moved)])


def test_only_lenses_that_are_named_are_run() -> None:
    assert [one.seed for one in planned("default", lenses=["1003"]).cases] == [1003]
    assert {one.family for one in planned("quick", lenses=[str(HELIAR)]).cases} == {"ray-traced"}
    with pytest.raises(InvalidInputError, match="'sonnar' is neither"):
        planned("quick", lenses=["sonnar"])


class EvenField:
    """A field that is the same under every turn of the frame about its middle, and under its mirror.

    Kernels have a tail outwards: symmetric ones would hide a turn the wrong way round.
    """

    def kernel_at(self, position: FieldPosition, channel: str, size: int) -> np.ndarray:
        del channel
        u = np.array([-np.sin(position.phi), np.cos(position.phi)])  # (row, col)
        places = np.moveaxis(np.mgrid[:size, :size] - size // 2, 0, -1).astype(float)
        core, tail = (
            np.exp(-0.5 * np.square(places - shift * u).sum(axis=-1) / width)
            for shift, width in ((0.0, 1.0), (3.0 * position.r, 2.0))
        )
        return as_kernel(core + 0.5 * tail)


def test_even_lens_is_its_own_general_profile_and_an_uneven_one_is_not() -> None:
    place = FieldPosition(0.8, 0.6)
    even, found = (field.kernel_at(place, "g", 21) for field in (EvenField(), symmetric(EvenField())))
    np.testing.assert_allclose(found, even, atol=1e-12)
    assert distance(even, even[::-1]).rel_l2 > 0.1
    one = traced()
    general, own = (field.kernel_at(place, "g", 25) for field in (general_field(one), one.truth()))
    assert distance(general, own).rel_l2 > 0.02


def test_general_profile_of_a_drawn_lens_is_the_mean_of_development_lenses_of_its_kind() -> None:
    one, place = case(), FieldPosition(0.5, 1.0)
    field = general_field(one)
    assert isinstance(field, MeanField)
    lenses = [each.lens for each in field.fields]  # type: ignore[attr-defined]  # simulated fields
    assert {lens.identity.model.split()[1] for lens in lenses} == {one.lens.identity.model.split()[1]}
    assert max(int(lens.identity.serial.removeprefix("SIM")) for lens in lenses) < 100
    mean = np.mean([each.kernel_at(place, "g", 21) for each in field.fields], axis=0)
    np.testing.assert_allclose(field.kernel_at(place, "g", 21), mean / mean.sum())


def test_flow_gives_the_psfs_of_its_windows_in_their_middles_and_their_mean_between() -> None:
    field, frame = EvenField(), Frame(96, 144)
    flow = Flow(field, frame, 15)
    middles = [frame.position(11.5, 59.5), frame.position(11.5, 83.5)]
    left, right = (field.kernel_at(place, "g", 15) for place in middles)
    between = frame.position(12.0, 72.0)  # half a pixel beyond the middle of the two
    assert distance(flow(middles[0]), left).rel_l2 < 0.03  # the pixel that is nearest lies half a pixel away
    assert distance(flow(between), 0.5 * (left + right)).rel_l2 < 0.03
    assert distance(flow(between), left).rel_l2 > 0.04


@pytest.mark.parametrize("count", [3, 6, 13])
def test_photographs_of_the_held_out_photo_serve_in_no_other(tmp_path: Path, count: int) -> None:
    files = photographs(tmp_path, count)
    layout = cases.layout_for(files)
    held = cases.frame_scene(files, layout, None)
    learned = [cases.frame_scene(files, layout, i) for i in range(5)]
    rows, cols = layout.tile
    assert held.shape == (3, layout.rows * rows, layout.cols * cols)
    assert not set(np.unique(held[0])) & {level for scene in learned for level in np.unique(scene[0])}


def test_smallest_grid_that_covers_a_wanted_frame_is_taken(tmp_path: Path) -> None:
    paths = photographs(tmp_path, 12)
    assert (cases.layout_for(paths).rows, cases.layout_for(paths).cols) == (2, 2)
    assert (cases.layout_for(paths, (80, 140)).rows, cases.layout_for(paths, (80, 140)).cols) == (1, 1)
    for files, frame, why in ((paths, (400, 600), "give larger ones"), (paths[:1], None, "two photographs")):
        with pytest.raises(InvalidInputError, match=why):
            cases.layout_for(files, frame)


def test_key_changes_with_settings_and_code() -> None:
    one = case()
    keys = {key_of(one, plan(), "1"), key_of(one, plan(), "2"), key_of(case(seed=1002), plan(), "1")}
    assert len(keys) == 3
    assert cases.photos_of(one, plan()) == cases.photos_of(one, plan(compare=True))
    assert cases.photos_of(one, plan()) != cases.photos_of(replace(one, width=320), plan())
    assert key_of(case(), plan(), "1") in keys


def test_version_follows_what_is_imported_anywhere(tmp_path: Path) -> None:
    (tmp_path / "pkg").mkdir()
    texts = {"a": "from pkg import b\n", "b": "def f():\n    import pkg.c\n", "c": "", "d": ""}
    for name, text in texts.items():
        (tmp_path / "pkg" / f"{name}.py").write_text(text)
    first = version_of("pkg.a", root=tmp_path)
    (tmp_path / "pkg" / "d.py").write_text("changed = 1")
    assert version_of("pkg.a", root=tmp_path) == first
    (tmp_path / "pkg" / "c.py").write_text("changed = 1")
    assert version_of("pkg.a", root=tmp_path) != first


def state(mtf50: float, psnr: float) -> dict[str, Any]:
    edge = {"edges": 2, "mtf50": mtf50, "tangential_mtf50": mtf50, "sagittal_mtf50": None}
    edge |= {"mtf_max": 1.02, "overshoot": 2.0}
    return {"edges": {zone: dict(edge) for zone in ZONES}, "psnr": dict.fromkeys(ZONES, psnr)}


def psf(error: float, right: float = 0.75) -> dict[str, Any]:
    return {"rel_l2": {c: dict.fromkeys(ZONES, error) for c in "rgb"}, "predicted_right": right}


def result(*lenses: tuple[float, float]) -> dict[str, Any]:
    """Lenses given by MTF50 and PSNR after n = 1; 100 and 30 before, 200 and 34 with the true PSF."""
    before, true, rival = state(100, 30.0), state(200, 34.0), state(130, 31.0)
    cases = [
        {
            "name": f"lens{i}",
            "title": f"Lens <{i}>",
            "family": "third order",
            "unseen": True,
            "source": f"drawn, seed {1000 + i}",
            "settings": {"seed": 1000 + i, "height": 480, "width": 640},
            "states": {BEFORE: before, TRUE: true, "n = 1": state(*lens), RIVAL: rival},
            "psf": {"n = 1": psf(0.2), RIVAL: psf(0.5)},
            "refused": {"n = 1": []},
            "paths": {},
            "pictures": {"before": "before.png", "scene": "scene.png", "true": "true.png", "n1": "after.png"},
        }
        for i, lens in enumerate(lenses)
    ]
    about = {"code": "abc", "plan": {"size": "quick", "own_scenes": True}, "figures": {}}
    return {**about, "scenes": ["city", "lake"], "developed_on": ["lake"], "cases": cases}


def test_share_is_of_the_gain_of_the_true_psf_unless_that_is_small() -> None:
    one = result((160, 33.0))["cases"][0]
    assert share(one, "n = 1", "mid") == pytest.approx(0.6)
    assert kept(one, "n = 1", "mid") == pytest.approx(0.75)
    one["states"][TRUE] = state(104, 30.1)
    assert share(one, "n = 1", "mid") is kept(one, "n = 1", "mid") is None


def test_summary_takes_the_mean_over_lenses_and_counts_zones_that_fell() -> None:
    found = summary(result((160, 32.0), (120, 29.98), (120, 29.0)))
    assert list(found["mtf"]) == [BEFORE, RIVAL, "n = 1", TRUE]
    assert found["mtf"]["n = 1"]["corner"]["mtf50"] == pytest.approx(400 / 3)
    assert found["mtf"]["n = 1"]["corner"]["sagittal_mtf50"] is None
    assert found["worse"]["1"] == {"zones": 9, "clearly_worse": 3}
    assert found["psf"][RIVAL]["g"]["corner"] == pytest.approx(0.5)
    assert found["share"]["1"]["mid"] == pytest.approx(1 / 3)


def judged(made: dict[str, Any], name: str, family: str = "third order") -> dict[tuple[str, str], Bar]:
    """The bars of that name, by number of photos and place."""
    return {
        (bar.n, bar.place): bar for bar in bars(made) if bar.name.startswith(name) and bar.family == family
    }


def test_bar_of_the_highest_mtf_sees_the_one_lens_that_rings() -> None:
    made = result((190, 33.0), (190, 33.0), (190, 33.0))
    made["cases"][1]["states"]["n = 1"]["edges"]["mid"]["mtf_max"] = 1.3
    found = judged(made, "highest corrected MTF of any lens")
    assert (found["1", "mid"].value, found["1", "mid"].met) == (1.3, False)
    assert (found["1", "center"].value, found["1", "center"].met) == (1.02, True)


def test_forecast_is_judged_by_the_mean_of_what_its_zones_are_off_by() -> None:
    made = result((190, 33.0))
    made["cases"][0]["states"]["n = 1"]["forecast"] = {
        "center": {"expected": 2.0, "true": 1.0},
        "mid": {"expected": None, "true": 1.0},
        "corner": {"expected": 1.0, "true": 1.5},
    }
    (bar,) = (bar for (n, _), bar in judged(made, "what the forecast").items() if n == "1")
    assert (bar.value, bar.met) == (pytest.approx(0.75), False)


def after(two: tuple[float, float], five: tuple[float, float]) -> dict[str, Any]:
    """A lens after two and five photos: the error of its blue PSF, and PSNR, both in the corner."""
    made = result((190, 33.0))
    one = made["cases"][0]
    for n, green, (error, psnr) in (("2", 0.3, two), ("5", 0.1, five)):
        one["states"][f"n = {n}"], one["psf"][f"n = {n}"] = state(190, 33.0), psf(0.2)
        one["states"][f"n = {n}"]["psnr"]["corner"] = psnr
        for channel, value in (("r", green), ("g", green), ("b", error)):
            one["psf"][f"n = {n}"]["rel_l2"][channel]["corner"] = value
    return made


@pytest.mark.parametrize(("five", "worse"), [((0.209, 32.96), 0), ((0.150, 32.94), 1)])
def test_five_photos_are_never_worse_than_two(five: tuple[float, float], worse: int) -> None:
    made = after((0.20, 33.00), five)
    found = judged(made, "zones where five photos")
    assert {place: bar.value for place, bar in found.items()} == {("5", "of 3 zones"): worse}
    rises = {place: bar for (_, place), bar in judged(made, "relative L2 of green above").items()}
    assert rises["corner"].value == pytest.approx(-0.2)
    assert rises["mid"].met is True


def test_colours_are_judged_by_their_ratio_to_green() -> None:
    found = judged(after((0.4, 33.0), (0.2, 33.0)), "relative L2 of the PSF, blue over green")
    assert found["2", "corner"].value == pytest.approx(0.4 / 0.3)
    assert [found[n, "corner"].met for n in ("2", "5")] == [True, False]


def test_the_soft_fast_lens_is_judged_by_itself() -> None:
    made = result((190, 33.0), (190, 33.0))
    made["cases"][1]["settings"]["seed"] = cases.SOFT_SEED
    made["cases"][1]["psf"]["n = 1"]["rel_l2"]["g"]["center"] = 0.29
    found = [bar for bar in bars(made) if bar.family == "soft fast lens"]
    assert [(bar.place, bar.met) for bar in found][:2] == [("center", True), ("mid", True)]
    assert judged(made, "relative L2 of the PSF, green")["1", "center"].value == pytest.approx(0.2)


def test_files_of_other_kinds_are_judged_by_what_raw_ones_gain() -> None:
    made = result((190, 33.0))  # raw gains 3 dB
    states = {BEFORE: state(0, 30.0), TRUE: state(0, 33.0), "after": state(0, 31.2)}
    made["cases"][0]["paths"] = dict.fromkeys(("tiff", "jpeg"), states)
    assert paths(made)["jpeg"]["share"]["mid"] == pytest.approx(0.4)
    met = {b.name: b.met for b in bars(made) if b.place == "mid" and "that of raw" in b.name}
    assert met == {"TIFF: gain in PSNR over that of raw": False, "JPEG: gain in PSNR over that of raw": True}


def test_page_shows_every_way_lens_and_refusal_and_needs_nothing_from_outside(tmp_path: Path) -> None:
    made, way, bench = result((160, 32.0), (120, 29.0)), f"{PAPER_WAY}, n = 1", tmp_path / "bench"
    one, other = made["cases"]
    one["states"] |= {
        way: state(140, 31.5),
        cases.GENERAL: state(145, 31.6),
        cases.MEASURED: state(195, 33.9),
    }
    one["psf"] |= {way: psf(0.6), cases.GENERAL: psf(0.6), cases.MEASURED: psf(0.6)}
    one["refused"]["n = 1"] = ["photo-00: flat"]
    other |= {"family": "ray-traced", "unseen": False, "title": "Traced Heliar"}
    assert collected(bench, tmp_path) is None
    bench.mkdir()
    (bench / "blind.md").write_text("| method | cases |\n|---|---|\n| default | 4 |\n")
    Image.new("L", (4, 4)).save(bench / "blind-er-1percent.png")
    made["figures"]["fig1"] = collected(bench, tmp_path / "pictures")

    markdown, html = (path.read_text(encoding="utf-8") for path in write_page(made, tmp_path))
    assert list(summary(made)["psnr"]) == [BEFORE, RIVAL, cases.GENERAL, way, "n = 1", cases.MEASURED, TRUE]
    shown = ["| third order | Lens &lt;0&gt; | drawn, seed 1000 | unseen |", "photo-00: flat", "MISSED"]
    shown += ["| ray-traced | Traced Heliar | drawn, seed 1001 | looked at during development |"]
    shown += ["| default, n = 1 | 160 |", f"| {RIVAL} | 130 |", "| default | 4 |"]
    for row in (*shown, *(f"| {way} | {value} |" for value in ("140", "0.600", "31.50"))):
        assert row in markdown
    stored = json.loads(write_json(made, tmp_path / "all.json").read_text(encoding="utf-8"))
    assert stored["summary"]["third order"]["share"]["1"]["corner"] == pytest.approx(0.6)
    assert stored["cases"][0]["states"]["n = 1"]["psnr"]["mid"] == 32.0
    assert stored["bars_held"] == held(bars(made))
    assert {"name", "place", "value", "low", "high", "met"} <= stored["bars"][0].keys()
    assert "Lens &lt;0&gt;" in html
    assert not re.search(r"https?:|//[a-z]|<script|<link|@import", html)
    sources = re.findall(r'src="([^"]+)"', html)
    assert "pictures/fig1-blind-er-1percent.png" in sources
    assert all(source.startswith("pictures/") for source in sources)


def test_true_kernels_have_no_error(monkeypatch: pytest.MonkeyPatch) -> None:
    few = [(FieldPosition(r, 0.5), c) for r in (0.1, 0.5, 0.9) for c in CHANNELS]
    monkeypatch.setattr(measure, "places", lambda: few)
    field = case().truth()
    exact = [(field.kernel_at(p, c, measure.PSF_SIZE), 0.1) for p, c in few]
    found = measure.psf_errors(exact, field)
    assert max(v for zones in found["rel_l2"].values() for v in zones.values()) < 1e-3
    assert found["predicted_right"] == 0.0  # it expected an error of 0.1 where there was none


@pytest.mark.parametrize("name", HARD_SCENES)
def test_scenery_is_light_of_the_same_frame_and_not_the_scene_itself(name: str) -> None:
    scene = np.random.default_rng(1).random((3, 160, 240), dtype=np.float32)
    change = HARD_SCENES[name]
    made = change(scene, np.random.default_rng(2))
    assert (made.shape, made.dtype) == (scene.shape, np.float32)
    assert made.min() >= 0.0
    assert np.abs(made - scene).mean() > 0.01
    assert np.array_equal(made, change(scene, np.random.default_rng(2)))


@pytest.mark.parametrize("frame", [Frame(480, 640), Frame(1808, 2816)])
def test_parts_lie_in_the_frame_and_meet_every_zone(frame: Frame) -> None:
    found = measure.parts(frame)
    assert len(found) == len(set(found)) == 7
    for row, col, height, width in found:
        assert 0 <= row <= frame.height - height
        assert 0 <= col <= frame.width - width
    places = [(r + u * h, c + u * w) for r, c, h, w in found for u in (0.1, 0.5, 0.9)]
    assert {zone_of(frame.position(*place).r) for place in places} == set(ZONES)
    assert sum(h * w for _, _, h, w in found) < 0.5 * frame.height * frame.width or frame.height < 1000


class Nothing:
    """A learner that never learns anything; keeps the presets and photos that it was given."""

    opened: ClassVar[list[tuple[str, int]]]
    learned: ClassVar[list[str]]
    seconds = 0.0

    def __init__(self, way: Config, workers: int) -> None:
        del workers
        self.opened.append((way.estimator, way.kernel_size))

    def learn(self, photos: Sequence[Path]) -> list[str]:
        self.learned.extend(photo.stem for photo in photos)
        return [f"{photo.stem}: too dark" for photo in photos]


@pytest.fixture
def quick_photos(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Photos and truth are made up, so that only the order of work is under test."""
    taken: list[str] = []

    def made_up(one: Case, files: Sequence[Path], folder: Path, **_: object) -> cases.Shots:
        taken.append(one.name)
        folder.mkdir(parents=True, exist_ok=True)
        return cases.Shots.of(one, folder)

    truth = {"states": {BEFORE: state(100, 30.0), TRUE: state(200, 34.0)}}
    monkeypatch.setattr(job, "take", made_up)
    monkeypatch.setattr(job, "Learner", Nothing)
    monkeypatch.setattr(Nothing, "opened", [], raising=False)
    monkeypatch.setattr(Nothing, "learned", [], raising=False)
    monkeypatch.setattr(job.CaseJob, "_truth", lambda _: truth)
    monkeypatch.setattr(job.CaseJob, "_path", lambda _, name: {"paths": {name: {}}})
    for part in ("_by_field", "_measured", "_rival"):
        monkeypatch.setattr(job.CaseJob, part, lambda *_: {})
    monkeypatch.setattr(job.figures, "draw", lambda *_, **__: {})
    return taken


def reproduced(folder: Path, chosen: Reproduction) -> dict[str, Any]:
    announced: list[tuple[str, int, int]] = []
    made = run_reproduction(chosen, folder, on_work=lambda *told: announced.append(told))
    assert announced[-1][1] == announced[-1][2]  # all the work that was announced is over
    return made


def test_second_run_computes_nothing(tmp_path: Path, quick_photos: list[str]) -> None:
    first = reproduced(tmp_path, chosen := plan(case(photos=(1, 2))))
    (one,) = first["cases"]
    assert one["states"]["n = 1"] == one["states"][BEFORE]  # nothing was learned
    assert one["refused"]["n = 1"] == ["photo-00: too dark"]
    Nothing.learned.clear()
    assert reproduced(tmp_path, chosen) == first
    assert Nothing.learned == []
    assert len(quick_photos) == 1


@pytest.mark.usefixtures("quick_photos")
def test_papers_own_way_is_learned_beside_the_default(tmp_path: Path) -> None:
    chosen = plan(case(photos=(1, 2)), compare=True)
    made = reproduced(tmp_path, chosen)
    assert {f"{PAPER_WAY}, n = {n}" for n in (1, 2)} < set(made["cases"][0]["states"])
    assert Nothing.opened[:2] == [("default", PRESETS["default"].kernel_size), ("michaeli-irani", 31)]
    assert paper_way(replace(chosen.cases[0], height=2000, width=3000)).kernel_size == 55


def test_run_that_was_killed_keeps_what_it_has_and_ends_as_if_it_had_not_been(
    tmp_path: Path, quick_photos: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(self: Nothing, photos: Sequence[Path]) -> list[str]:
        if len(photos) > 1:
            raise KeyboardInterrupt
        return [f"{photos[0].stem}: too dark"]

    chosen = plan(case(photos=(1, 2)), case(1, photos=(1, 2)))
    with monkeypatch.context() as patch:
        patch.setattr(Nothing, "learn", killed)
        with pytest.raises(KeyboardInterrupt):
            reproduced(tmp_path / "killed", chosen)
    (kept_result,) = (tmp_path / "killed").rglob("learned-1.json")
    written = kept_result.stat().st_mtime_ns
    assert len(quick_photos) == 1
    made = reproduced(tmp_path / "killed", chosen)
    assert kept_result.stat().st_mtime_ns == written
    assert made == reproduced(tmp_path / "whole", chosen)


@pytest.mark.usefixtures("quick_photos")
def test_each_choice_of_lenses_keeps_its_figures(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def drawn(cases: Sequence[Case], path: Path) -> dict[str, Any]:
        path.write_text(cases[0].name)
        return {"picture": path.name}

    monkeypatch.setattr(job.figures, "draw", DRAW)
    monkeypatch.setattr(job.figures, "_fig2", drawn)
    monkeypatch.setattr(job.figures, "_fig4", lambda chosen, _, path, __: drawn(chosen.cases, path))
    one = plan(case(photos=(1,)), compare=True)
    other = plan(case(1, photos=(1,)), compare=True)
    for chosen in (one, other, one):
        for figure in reproduced(tmp_path, chosen)["figures"].values():
            shown = tmp_path / "pictures" / figure["picture"]
            assert shown.read_text() == chosen.cases[0].name
    shutil.rmtree(tmp_path / "pictures")
    for figure in reproduced(tmp_path, one)["figures"].values():
        assert (tmp_path / "pictures" / figure["picture"]).exists()


@pytest.mark.usefixtures("quick_photos")
def test_damaged_result_is_reported(tmp_path: Path) -> None:
    chosen = plan(case(photos=(1,)))
    reproduced(tmp_path, chosen)
    next(tmp_path.rglob("learned-1.json")).write_text("{")
    with pytest.raises(InvalidInputError, match="delete it"):
        reproduced(tmp_path, chosen)


@pytest.mark.slow
def test_lens_is_learned_and_corrected_from_end_to_end(tmp_path: Path) -> None:
    made = reproduced(tmp_path, plan(case(photos=(1,))))
    (one,) = made["cases"]
    before, true, learned = (one["states"][name] for name in (BEFORE, TRUE, "n = 1"))
    for zone in ("center", "corner"):
        assert true["psnr"][zone] > learned["psnr"][zone] > before["psnr"][zone]
        assert true["edges"][zone]["mtf50"] > before["edges"][zone]["mtf50"]
        assert learned["edges"][zone]["mtf50"] > before["edges"][zone]["mtf50"]
        assert one["paths"]["tiff"]["after"]["psnr"][zone] > one["paths"]["tiff"][BEFORE]["psnr"][zone]
    assert one["psf"]["n = 1"]["rel_l2"]["g"]["center"] < 0.6
    _, html = write_page(made, tmp_path)
    for source in re.findall(r'src="([^"]+)"', html.read_text(encoding="utf-8")):
        assert (tmp_path / source).stat().st_size > 0
