from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from scipy import signal

from lensmodel import estimation
from lensmodel.core.errors import CancelledError, LensModelError
from lensmodel.core.psf import as_kernel, centred, centroid, distance, gaussian, rms_width
from lensmodel.core.types import NoiseModel
from lensmodel.estimation.methods import default
from lensmodel.estimation.spectra.local_wavefront import AberrationFit
from lensmodel.estimation.spectra.scene_spectra import SceneSpectra, log_power
from lensmodel.lab.scenes import dead_leaves
from lensmodel.optics.local_pupil import Pupil
from lensmodel.optics.pupil import TERMS
from lensmodel.scene.prior import WINDOW_BINS, WINDOW_SCATTER, WINDOW_SHAPES, WindowPrior

LENS = np.array([0.3, 0.9, -0.5, 0.6, 0.5, -0.3, 0.0, 0.0])
NOISE = 1e-7


def kernel_of(terms: np.ndarray) -> np.ndarray:
    return np.asarray(centred(as_kernel(Pupil.of(31).kernel(terms)[0])))


def spectra_of(kernel: np.ndarray, count: int, *, scatter: float = 1.0, seed: int = 0) -> SceneSpectra:
    """Spectra of scenes drawn from the prior, behind a kernel; with scatter 0 all are the usual scene."""
    prior, rng = WindowPrior.load(), np.random.default_rng(seed)
    blur, _ = log_power(kernel, np.zeros((1, *kernel.shape)))
    covariance = WINDOW_SHAPES @ prior.spread @ WINDOW_SHAPES.T + np.diag(prior.roughness**2)
    scenes = prior.usual - 4.0 + scatter * rng.multivariate_normal(np.zeros(WINDOW_BINS), covariance, count)
    whitening = np.linalg.inv(np.linalg.cholesky(covariance + WINDOW_SCATTER**2 * np.eye(WINDOW_BINS)))
    return SceneSpectra(
        np.log(np.exp(scenes + blur) + NOISE),
        np.full(count, NOISE),
        np.stack([whitening] * count),
        prior.usual,
    )


def test_derivatives_of_a_kernel_agree_with_differences() -> None:
    pupil, step = Pupil.of(31), 5e-3
    _, derivatives = pupil.kernel(LENS)

    for term in range(TERMS):
        moved = np.eye(TERMS)[term] * step
        slope = (pupil.kernel(LENS + moved)[0] - pupil.kernel(LENS - moved)[0]) / (2.0 * step)
        assert np.abs(derivatives[term] - slope).max() < 3e-3 * np.abs(slope).max()


def test_a_perfect_lens_gives_nearly_a_point_and_turned_coma_a_turned_kernel() -> None:
    pupil = Pupil.of(31)
    point, _ = pupil.kernel(np.zeros(TERMS))
    turned = LENS * np.where(np.isin(np.arange(TERMS), (1, 2)), -1.0, 1.0)

    assert point[15, 15] > 0.8
    assert np.abs(pupil.kernel(turned)[0] - pupil.kernel(LENS)[0][::-1, ::-1]).max() < 1e-4


def test_derivatives_of_log_power_agree_with_differences() -> None:
    pupil = Pupil.of(31)
    kernel, changes = pupil.kernel(LENS)
    _, derivatives = log_power(kernel, changes)
    step = 1e-4

    for term in range(3):
        above, below = (log_power(kernel + s * step * changes[term], changes)[0] for s in (1.0, -1.0))
        assert derivatives[:, term] == pytest.approx((above - below) / (2.0 * step), abs=1e-3)


def test_the_true_wavefront_scores_best_where_the_scene_is_known() -> None:
    truth = kernel_of(LENS)
    spectra = spectra_of(truth, 2, scatter=0.0)

    def cost(kernel: np.ndarray) -> float:
        blur, by_blur = log_power(kernel, np.zeros((1, *kernel.shape)))
        left, _ = spectra.residuals(blur, by_blur, spectra.begin(blur))
        return float(left @ left)

    best = cost(truth)
    assert best < 1e-4
    for term in range(TERMS - 2):
        for step in (-0.1, 0.1):
            assert cost(kernel_of(LENS + step * np.eye(TERMS)[term])) > best + 0.1


def mtf_error(truth: np.ndarray, count: int, seed: int) -> float:
    wrong = gaussian(31, 2.2 * rms_width(truth) ** 2 * np.eye(2))  # as a softer scene would make it
    spectra = spectra_of(truth, count, seed=seed)
    return distance(AberrationFit(weight=2.0).fit(spectra, as_kernel(wrong)).kernel(31), truth).mtf_rmse


def test_width_is_found_behind_scenes_of_the_prior_though_the_start_is_too_wide() -> None:
    truth = kernel_of(LENS)
    wrong = gaussian(31, 2.2 * rms_width(truth) ** 2 * np.eye(2))

    assert mtf_error(truth, 12, 0) < 0.5 * distance(wrong, truth).mtf_rmse


@pytest.mark.slow
def test_error_falls_with_the_number_of_scenes() -> None:
    truth = kernel_of(LENS)
    one, many = (np.median([mtf_error(truth, count, seed) for seed in range(3)]) for count in (1, 24))

    assert many < 0.5 * one


def test_the_side_of_a_tail_is_that_of_the_kernel_found() -> None:
    truth = kernel_of(LENS)
    spectra = spectra_of(truth, 4)
    soft = signal.convolve2d(truth, gaussian(5, 0.5 * np.eye(2)), mode="same")

    for aim, right in ((soft, truth), (soft[::-1, ::-1], truth[::-1, ::-1])):
        found = AberrationFit(starts=8, kept=2).fit(spectra, as_kernel(aim)).kernel(31)
        assert distance(found, right).rel_l2 < distance(found, right[::-1, ::-1]).rel_l2


@pytest.fixture
def short_fit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the estimator fit from fewer beginnings, where the one that it begins with is the truth."""
    monkeypatch.setattr(default, "AberrationFit", partial(AberrationFit, starts=8, kept=2))


@pytest.fixture(scope="module")
def six_patches() -> list[np.ndarray]:
    kernel, found = kernel_of(LENS), []
    side = 64 + kernel.shape[0] - 1
    for seed in range(6):
        rng = np.random.default_rng(seed)
        blurred = signal.fftconvolve(dead_leaves(side, side, rng, largest=40.0)[1], kernel, mode="valid")
        found.append((blurred + rng.normal(0, 0.01, blurred.shape)).astype(np.float32))
    return found


def test_default_agrees_on_a_wavefront_from_six_patches_on(six_patches: list[np.ndarray]) -> None:
    truth = kernel_of(LENS)
    seen: list[tuple[int, int]] = []

    found = estimation.estimators.create("default").estimate(
        six_patches,
        [NoiseModel.white(0.01)] * 6,
        size=21,
        on_step=lambda done, total: seen.append((done, total)),
    )

    assert "cost" in found.diagnostics
    assert found.kernel.shape == (21, 21)
    assert max(map(abs, centroid(found.kernel))) < 0.02
    assert seen == sorted(seen)
    assert seen[-1][0] == seen[-1][1]
    assert distance(found.kernel, truth).ncc > 0.9


def test_fitting_a_wavefront_can_be_cancelled() -> None:
    def stop(done: int, total: int) -> None:
        raise CancelledError(f"stopped at {done} of {total}")

    truth = kernel_of(LENS)
    with pytest.raises(LensModelError, match="stopped"):
        AberrationFit().fit(spectra_of(truth, 1), as_kernel(truth), stop)


def test_another_channel_of_six_patches_follows_the_first(
    six_patches: list[np.ndarray], short_fit: None
) -> None:
    truth, method = kernel_of(LENS), estimation.estimators.create("default")
    seen, noise = six_patches, [NoiseModel.white(0.01)] * 6
    green = replace(
        estimation.estimators.create("whittle").estimate(seen, noise, size=21), kernel=as_kernel(truth)
    )

    found = method.estimate_channel(seen, noise, green, seen, size=21)

    assert "cost" in found.diagnostics
    assert distance(found.kernel, truth).ncc > 0.9
