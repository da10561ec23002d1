from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lab.population import library, scenes
from lab.population.photos import Processing, Scenes, bayer, demosaic
from lab.population.sets import Lens, draw_set, fixed_set, load_sets, of_photos, save_sets
from lab.population.traced import draw, grid_of
from lensmodel.core.psf import KINDS
from lensmodel.neural.network import FAR_M, SIDE, relation_features


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Scenes that are drawn: twelve of them, so that one is held out."""
    made = tmp_path_factory.mktemp("population")
    scenes.build(made / "scenes", iter(()), drawn=6, side=420)
    return made


def lens_of(folder: Path, family: library.Family = "wavefront") -> Lens:
    stored = library.make_lens(family, 3, Scenes(folder / "scenes", held_out=False), held_out=False)
    assert stored is not None
    return Lens.of(stored)


@pytest.fixture(scope="module")
def lens(folder: Path) -> Lens:
    return lens_of(folder)


@pytest.mark.slow
def test_a_lens_is_the_same_whenever_it_is_made(folder: Path, lens: Lens) -> None:
    assert [len(Scenes(folder / "scenes", held_out=value)) for value in (False, True)] == [11, 1]
    again = lens_of(folder)
    np.testing.assert_array_equal(again.statistics, lens.statistics)
    np.testing.assert_array_equal(again.truth, lens.truth)


@pytest.mark.slow
def test_sets_hold_what_was_asked_for_and_survive_a_file(lens: Lens, tmp_path: Path) -> None:
    drawn = draw_set(lens, 6, 5, np.random.default_rng(0))
    assert len(drawn.xy) == 6
    assert drawn.truth.shape[:2] == (5, 3)
    np.testing.assert_allclose(drawn.truth.astype(float).sum(-1), 1.0, atol=5e-3)
    sets = fixed_set([lens], samples=8, queries=3, count=1)
    save_sets(sets, tmp_path / "sets.npz")
    (back,) = load_sets(tmp_path / "sets.npz")
    np.testing.assert_array_equal(back.truth, sets[0].truth)
    np.testing.assert_allclose(back.query_xy, of_photos(lens, 1).query_xy[:: len(lens.xy) // 3])


@pytest.mark.slow
def test_other_photos_are_taken_through_the_same_lens_and_no_shard_is_made_twice(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(library, "SHARD", 1)
    first = library.Order(folder / "first", folder / "scenes", "third-order", plain=True)
    assert first.make(0) == 1
    assert not first.make(0)  # it is there
    again = replace(first, folder=folder / "again", through=folder / "first")
    assert again.make(0) == 1
    (one,), (other,) = (
        library.load_shard(folder / name / "third-order-00000.npz") for name in ("first", "again")
    )
    for same in ("fine", "coarse", "xy", "states", "facts"):
        np.testing.assert_allclose(other[same].astype(float), one[same].astype(float), atol=2e-3)
    assert not np.array_equal(other["statistics"][:8], one["statistics"][:8])


def test_a_scene_tells_its_own_blur() -> None:
    rng = np.random.default_rng(4)
    f = np.hypot(np.fft.fftfreq(512)[:, None], np.fft.rfftfreq(512)[None])
    noise = np.fft.rfft2(rng.standard_normal((512, 512))) / np.maximum(f, 1 / 512)
    for variance in (0.0, 0.1, 0.25):
        plane = np.fft.irfft2(noise * np.exp(-2 * np.pi**2 * variance * f**2))
        plane = 0.5 + 0.1 * plane / plane.std()
        slope, blur = scenes.own_blur(np.repeat(plane[..., None], 3, 2), rng)
        assert slope == pytest.approx(2.0, abs=0.15)
        assert blur == pytest.approx(variance, abs=0.04)


def test_demosaicking_keeps_samples_and_interpolates_a_slope() -> None:
    rows, cols = np.mgrid[:16, :18].astype(np.float32)
    slope = np.stack([0.1 + 0.01 * rows, 0.2 + 0.005 * cols, 0.3 + 0.01 * rows]).astype(np.float32)
    mosaic = np.take_along_axis(slope, bayer(16, 18)[None].astype(np.intp), 0)[0]
    made = demosaic(mosaic)
    inner = np.s_[:, 3:-3, 3:-3]
    np.testing.assert_allclose(made[inner], slope[inner], atol=1e-5)


def test_what_a_camera_does_to_a_kernel_is_what_it_does_to_a_point() -> None:
    processing = Processing(0.4, 0.0, 0.6, 1.0, 0.0, 0, mosaicked=False)
    point = np.zeros((1, SIDE, SIDE), np.float32)
    point[0, SIDE // 2, SIDE // 2] = 1.0
    kernel = processing.applied(point)[0]
    grey = np.full((3, SIDE, SIDE), 0.5, np.float32)
    grey[:, SIDE // 2, SIDE // 2] += 1e-3  # so little that the gamma is a line
    seen = processing.develop(np.empty((0, 0), np.float32), grey)[1]
    seen = np.maximum(seen - np.median(seen), 0.0)
    np.testing.assert_allclose(kernel, seen / seen.sum(), atol=0.02)


@pytest.mark.parametrize("kind", KINDS[1:])
def test_processing_keeps_a_flat_picture(kind: str) -> None:
    processing = Processing.draw(np.random.default_rng(2), kind)  # type: ignore[arg-type]
    flat = np.full((3, 64, 64), 0.25, np.float32)
    made = processing.develop(np.full((64, 64), 0.25, np.float32), flat)
    assert np.ptp(made) < 0.02
    assert made.mean() == pytest.approx(0.25, abs=0.06)  # a tone curve may move it a little


@pytest.mark.slow
def test_a_traced_lens_is_photographed_at_several_apertures_and_focus_distances() -> None:
    drawn = [
        library.draw_states("traced", np.random.default_rng(seed), held_out=False) for seed in (5, 7, 11, 12)
    ]
    near = [state for states in drawn for state in states if state.focus_m < FAR_M]
    assert near
    for state in near:
        assert 6.0 < 1000.0 * state.focus_m / state.focal_mm < 101.0
        assert state.lens.working(state.f_number) > state.f_number
    assert all(states[0].focus_m == FAR_M for states in drawn)


@pytest.mark.slow
def test_samples_of_another_focus_distance_say_so(folder: Path) -> None:
    lens = lens_of(folder, "traced")
    assert len(np.unique(lens.settings[:, 3])) > 1
    query = lens.settings[np.argmin(lens.settings[:, 3])][None]
    relation = relation_features(lens.xy[:1], query, lens.xy[:2], lens.settings[[0, 0]])[0]
    apart = lens.settings[0, 3] - query[0, 3]
    np.testing.assert_allclose(relation[:, 4], apart**2, rtol=1e-5)
    np.testing.assert_allclose(relation[:, 17], apart, rtol=1e-5)


def test_a_grid_answers_as_the_lens_does() -> None:
    lens = draw(np.random.default_rng(1), ["heliar"])
    grid = grid_of(lens, step=0.5)
    assert grid.kernels.shape[-1] == 55
    np.testing.assert_allclose(grid.kernels.astype(float).sum((-1, -2)), 1.0, atol=5e-3)
    assert grid.facts["design"] == "heliar"
