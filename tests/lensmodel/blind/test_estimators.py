"""Estimators of kernels, and the one that samples whole photos."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from scipy import signal

from lab.blind.methods import compared
from lab.kernels import distance, gaussian
from lab.scenes import dead_leaves
from lensmodel import blind
from lensmodel.blind.learned import LearnedEstimator
from lensmodel.blind.patch_recurrence import blend, normal_equations, recur, window_products
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError, NoUsablePatchesError
from lensmodel.core.numerics import nonnegative_least_squares
from lensmodel.core.psf import centroid, delta
from lensmodel.core.types import CHANNELS, Frame, LensSettings, NoiseModel, Plane
from lensmodel.patches.select import spread_evenly
from lensmodel.photo import Encoding, LinearPhoto, PhotoInfo
from lensmodel.quality import edge_area
from lensmodel.simulate import demo_scene

SIGMA = 0.01
NAMES = sorted(compared)  # those of the laboratory keep the same contract
LONG = {"sun", "zhang"}  # of the laboratory, and as long as all others together


def patch(kernel: np.ndarray, *, sigma: float = SIGMA, seed: int = 0, side: int = 96) -> Plane:
    return _patch(kernel.tobytes(), kernel.shape[0], sigma, seed, side).copy()  # a test may change it


@cache
def _patch(kernel_bytes: bytes, size: int, sigma: float, seed: int, side: int) -> Plane:
    kernel, margin = np.frombuffer(kernel_bytes).reshape(size, size), size - 1
    rng = np.random.default_rng(seed)
    scene = dead_leaves(side + margin, side + margin, rng, largest=40.0)[1]
    y = signal.fftconvolve(scene, kernel, mode="valid")
    return (y + rng.normal(0, sigma, y.shape)).astype(np.float32)


def photo_patch(kernel: np.ndarray, row: int, col: int, side: int = 160) -> Plane:
    margin = kernel.shape[0] - 1
    scene = demo_scene("city")[1][row : row + side + margin, col : col + side + margin]
    y = signal.fftconvolve(scene, kernel, mode="valid")
    return (y + np.random.default_rng(row).normal(0, SIGMA, y.shape)).astype(np.float32)


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=[pytest.mark.slow] if name in LONG else []) for name in NAMES]
)
def test_every_estimator_keeps_the_contract_and_repeats_to_the_bit(name: str) -> None:
    y, noise = patch(gaussian(15, 1.2 * np.eye(2)), side=80), NoiseModel.white(SIGMA)

    found, again = (compared.create(name).estimate([y], [noise], size=17) for _ in range(2))

    assert found.kernel.shape == (17, 17)
    assert found.kernel.min() >= 0
    assert found.kernel.sum() == pytest.approx(1.0)
    assert max(map(abs, centroid(found.kernel))) < 0.02
    assert 0.0 <= found.predicted_error <= 1.0
    assert np.array_equal(found.kernel, again.kernel)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("kind", ["flat", "noise", "clipped"])
def test_nothing_is_made_of_patches_that_say_nothing(name: str, kind: str) -> None:
    rng = np.random.default_rng(1)
    y = {
        "flat": np.full((96, 96), 0.5),
        "noise": 0.5 + rng.normal(0, 0.1, (96, 96)),
        "clipped": np.where(rng.random((96, 96)) > 0.5, 1.0, 0.1),
    }[kind].astype(np.float32)

    with pytest.raises(NotEnoughEvidenceError):
        compared.create(name).estimate([y], [NoiseModel.white(SIGMA)])


@pytest.mark.parametrize("name", NAMES)
def test_impossible_input_is_refused_by_name(name: str) -> None:
    method, noise = compared.create(name), NoiseModel.white(SIGMA)
    y = patch(gaussian(15, np.eye(2)))
    broken = y.copy()
    broken[3, 4] = np.nan

    for wrong, size, said in (
        (y[:20, :20], 15, "at least"),
        (broken, 15, "finite"),
        (y, 16, "odd"),
        (y, 57, r"odd and in 3\.\.55, got 57"),
    ):
        with pytest.raises(InvalidInputError, match=said):
            method.estimate([wrong], [noise], size=size)


def test_default_comes_nearer_to_the_truth_than_no_kernel_at_all() -> None:
    truth = gaussian(21, [[2.6, 1.0], [1.0, 1.4]])
    patches = [photo_patch(truth, row, col, side=128) for row, col in ((300, 500), (420, 700))]

    found = blind.estimators.create("default").estimate(patches, [NoiseModel.white(SIGMA)] * 2, size=21)

    nothing = distance(delta(21), truth).rel_l2
    assert distance(found.kernel, truth).rel_l2 < 0.4 * nothing


def test_kernel_step_recovers_the_kernel_where_the_scene_is_known() -> None:
    truth = gaussian(9, [[1.5, 0.5], [0.5, 1.0]])
    rng = np.random.default_rng(0)
    scene = dead_leaves(160, 160, rng)[1].astype(np.float64)
    y = signal.fftconvolve(scene, truth, mode="same") + rng.normal(0, SIGMA, scene.shape)
    response = np.zeros((40, 40))  # this scene took nothing from y

    a, b = normal_equations(scene, y, 9, SIGMA, response)
    k = nonnegative_least_squares(a, b, np.asarray(delta(9)).ravel()).reshape(9, 9)

    assert distance(k, truth).rel_l2 < 0.08  # the noise alone costs 0.057


def test_noise_correction_leaves_nothing_of_pure_noise() -> None:
    rng = np.random.default_rng(0)
    y = rng.normal(0, 0.1, (220, 220))
    x, response = blend(y, gaussian(9, 0.8 * np.eye(2)), np.zeros_like(y), 0.2)

    raw_a, raw_b = normal_equations(x, y, 9, 0.0, response)
    a, b = normal_equations(x, y, 9, 0.1, response)

    assert np.abs(a).max() < 0.06 * np.abs(raw_a).max()
    assert np.abs(b).max() < 0.06 * np.abs(raw_b).max()


def test_image_step_with_the_true_kernel_and_scene_returns_the_scene() -> None:
    rng = np.random.default_rng(0)
    scene = dead_leaves(120, 120, rng)[1].astype(np.float64)
    kernel = gaussian(9, np.eye(2))
    y = signal.fftconvolve(scene, kernel, mode="same")

    x, _ = blend(y, kernel, scene, 0.3)

    assert np.abs(x - scene)[12:-12, 12:-12].max() < 1e-3


def test_a_sharp_step_recurs_as_itself() -> None:
    rows, cols = np.arange(-32, 32)[:, None], np.arange(-32, 32)[None, :]
    step = edge_area(rows, cols, 0.3)

    z = recur(step, 0.001, 0.03)

    assert np.sqrt(np.mean((z - step)[8:-8, 8:-8] ** 2)) < 0.03


def test_turning_the_patch_turns_the_kernel() -> None:
    y, noise = patch(gaussian(15, [[2.0, 0.8], [0.8, 1.0]])), NoiseModel.white(SIGMA)
    method = blind.PatchRecurrence(levels=2, iterations=2)
    upright = method.estimate([y], [noise], size=15).kernel
    turned = method.estimate([np.ascontiguousarray(np.rot90(y))], [noise], size=15).kernel

    assert distance(np.rot90(upright).copy(), turned).rel_l2 < 0.15


@pytest.mark.parametrize(("shape", "side"), [((40, 30), 7), ((3, 25), 9), ((1, 4), 5), ((20, 20), 1)])
def test_products_are_those_of_windows_written_out(shape: tuple[int, int], side: int) -> None:
    rng = np.random.default_rng(3)
    x = rng.standard_normal((shape[0] + side - 1, shape[1] + side - 1))
    y = rng.standard_normal(shape) + 0.3
    columns = sliding_window_view(x, (side, side)).reshape(-1, side * side)
    columns = columns - columns.mean(axis=0)
    gram, cross = window_products(x, y, side)

    np.testing.assert_allclose(gram, columns.T @ columns, atol=1e-5 * y.size)
    np.testing.assert_allclose(cross, columns.T @ (y - y.mean()).ravel(), atol=1e-5 * y.size)
    np.testing.assert_array_equal(gram, gram.T)


# ---- samples of whole photos

RGGB = ((0, 1), (1, 2))


def shot(height: int = 640, width: int = 896, **changed: object) -> LinearPhoto:
    """A sharp scene as a photo with a mosaic."""
    planes = np.ascontiguousarray(0.5 * demo_scene("city")[:, 100 : 100 + height, 200 : 200 + width])
    noise = (NoiseModel(1e-4, 1e-6),) * 3
    developed = LinearPhoto(
        planes.astype(np.float32),
        Frame(height, width),
        noise,
        (1.0, 1.0, 1.0),
        PhotoInfo("dng", width, height),
        Encoding(),
        sensor_noise=noise,
        cfa=RGGB,
    )
    return replace(developed, **changed)  # type: ignore[arg-type] # fields of the photo


def test_windows_lie_all_over_the_frame_and_on_the_mosaic() -> None:
    chosen = spread_evenly(shot(), count=24, size=128).patches

    assert 16 <= len(chosen) <= 24
    assert len({(p.row, p.col) for p in chosen}) == len(chosen)
    assert all(p.row % 2 == p.col % 2 == 0 for p in chosen)
    assert all(0 <= p.row <= 512 and 0 <= p.col <= 768 for p in chosen)
    assert {(p.row > 256, p.col > 384) for p in chosen} == {
        (a, b) for a in (True, False) for b in (True, False)
    }
    assert spread_evenly(shot(), count=24, size=128).patches == chosen


def test_flat_and_clipped_windows_are_left_out_with_the_reason() -> None:
    planes = shot().planes.copy()
    planes[:, :, :320] = 0.3
    planes[:, 320:, 600:] = 1.0

    found = spread_evenly(shot(planes=planes), count=35, size=128)

    assert found.patches
    assert all(p.col + 128 > 320 and (p.row < 320 or p.col + 64 < 600) for p in found.patches)
    assert {r.reason for r in found.rejected} == {"flat", "clipped"}


def test_a_photo_smaller_than_a_window_is_refused() -> None:
    with pytest.raises(NoUsablePatchesError, match="full size"):
        spread_evenly(shot(100, 400), count=24, size=128)


def test_a_photo_becomes_three_samples_of_each_window_with_what_it_encodes() -> None:
    developed, method = shot(), LearnedEstimator()
    patches = method.select(developed, count=6).patches

    samples = method.samples(developed, patches, settings=LensSettings(2.8), photo="a", size=31)

    assert [s.settings.channel for s in samples] == list(CHANNELS) * len(patches)
    assert {s.position for s in samples} == {p.position for p in patches}
    for sample in samples:
        assert sample.encoded is not None
        assert len(sample.encoded.to_bytes()) <= 4096
        assert sample.estimator == f"default/{method.version}"
        assert sample.kernel.shape[0] <= 31
        assert 0.0 < (sample.error or 0.0) <= 1.0
    assert samples[0].encoded is samples[1].encoded


def test_files_are_told_apart_by_how_their_pixels_were_made() -> None:
    method = LearnedEstimator()
    kinds = {}
    for kind, cfa in (("dng", RGGB), ("dng", None), ("tiff", None), ("jpeg", None)):
        developed = shot(info=PhotoInfo(kind, 896, 640), cfa=cfa)  # type: ignore[arg-type] # kinds of files
        patches = method.select(developed, count=2).patches
        encoded = method.samples(developed, patches, settings=LensSettings(2.8), photo="", size=31)[0].encoded
        assert encoded is not None
        kinds[kind, cfa is None] = encoded.kind

    assert list(kinds.values()) == ["raw", "tiff", "tiff", "jpeg"]


def test_it_reads_whole_photos_and_others_do_not() -> None:
    assert isinstance(blind.estimators.create("default"), blind.PhotoEstimator)
    assert not isinstance(blind.estimators.create("michaeli-irani"), blind.PhotoEstimator)
