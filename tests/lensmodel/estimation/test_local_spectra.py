from __future__ import annotations

import numpy as np
import pytest

from lensmodel.core.psf import as_kernel, centred, gaussian
from lensmodel.core.types import NoiseModel
from lensmodel.estimation.spectra.local_spectra import (
    FREQUENCIES,
    LocalSpectra,
    SpectrumMixture,
    local_power,
    log_local_power,
    periodograms,
)
from lensmodel.lab.scenes import dead_leaves
from lensmodel.optics.local_pupil import Pupil
from lensmodel.optics.pupil import TERMS

LENS = np.array([0.3, 0.9, -0.5, 0.6, 0.5, -0.3, 0.0, 0.0])
NOISE = 1e-3


def power_of(kernel: np.ndarray) -> np.ndarray:
    return local_power(np.asarray(kernel))


def kernel_of(terms: np.ndarray) -> np.ndarray:
    return np.asarray(centred(as_kernel(Pupil.of(31).kernel(terms)[0])))


def drawn(kernel: np.ndarray, tiles: int, seed: int = 0) -> LocalSpectra:
    """Tiles of scenes that are drawn from the mixture, behind a kernel."""
    mixture, rng = SpectrumMixture.load(), np.random.default_rng(seed)
    component = rng.choice(len(mixture.share), tiles, p=mixture.share / mixture.share.sum(dtype=np.float64))
    mean = mixture.power[component] * power_of(kernel) + NOISE
    seen = (mean * rng.exponential(size=mean.shape)).astype(np.float32)
    return LocalSpectra((seen,), (NOISE,), mixture)


def test_white_noise_has_its_variance_at_every_frequency() -> None:
    noise = np.random.default_rng(1).normal(0.0, 0.1, (256, 256)).astype(np.float32)
    power = periodograms(noise)

    assert power.shape == (15 * 15, FREQUENCIES)
    assert power.mean() == pytest.approx(0.01, rel=0.03)


def test_a_point_blurs_nothing_and_a_gaussian_as_theory_says() -> None:
    point = np.zeros((15, 15))
    point[7, 7] = 1.0

    np.testing.assert_allclose(power_of(point), 1.0, atol=2e-4)
    # sigma 1 px: exp(-4 pi^2 f^2) is 0.025 half way to the limit, and the window adds little there
    wide = power_of(gaussian(31, np.eye(2)))
    assert 0.5 < wide.max() <= 1.001
    assert wide.min() < 1e-3


@pytest.mark.parametrize("terms", [LENS, 0.3 * LENS])
def test_the_true_wavefront_scores_best(terms: np.ndarray) -> None:
    truth = kernel_of(terms)
    spectra = drawn(truth, 400)
    best = spectra.likelihood(power_of(truth))

    for scale in (0.5, 0.8, 1.25, 2.0):
        assert spectra.likelihood(power_of(kernel_of(scale * terms))) < best
    for term in range(6):
        moved = terms + 0.5 * np.eye(TERMS)[term]
        assert spectra.likelihood(power_of(kernel_of(moved))) < best


def test_derivatives_of_local_log_power_agree_with_differences() -> None:
    kernel, changes = Pupil.of(31).kernel(LENS)
    value, derivatives = log_local_power(kernel, changes)

    np.testing.assert_allclose(value, np.log(local_power(kernel)), rtol=1e-6)
    for term in range(6):
        step = 1e-2 * np.eye(TERMS)[term]
        ahead, behind = (np.log(local_power(Pupil.of(31).kernel(LENS + s)[0])) for s in (step, -step))
        clear = value > np.log(1e-2)  # the light is in single precision, its faintest parts are rounding
        np.testing.assert_allclose(
            derivatives[clear, term], ((ahead - behind) / 2e-2)[clear], atol=0.02 * np.abs(derivatives).max()
        )


def test_slope_of_the_likelihood_agrees_with_differences() -> None:
    spectra = drawn(kernel_of(LENS), 100)
    power = np.log(power_of(kernel_of(0.8 * LENS)))
    value, slope, curvature = spectra.pull(0, power)
    towards = np.random.default_rng(3).normal(size=FREQUENCIES)

    ahead, behind = (spectra.pull(0, power + step * towards)[0] for step in (1e-2, -1e-2))
    assert (ahead - behind) / 2e-2 == pytest.approx(float(slope @ towards), rel=1e-2)
    assert (curvature > 0.0).all()
    assert value < spectra.pull(0, np.log(power_of(kernel_of(LENS))))[0]


def test_the_likeliest_gain_is_that_of_the_scene() -> None:
    power = np.log(power_of(kernel_of(LENS)))
    spectra = drawn(kernel_of(LENS), 200)

    for step in (-1.0, 0.0, 1.5):
        assert spectra.gains(power + step)[0] == pytest.approx(-step, abs=0.25)


def test_a_scene_of_more_contrast_is_as_likely_with_another_gain() -> None:
    truth = power_of(kernel_of(LENS))
    spectra = drawn(kernel_of(LENS), 200)
    louder = LocalSpectra((spectra.periodograms[0] * np.float32(np.e),), (NOISE * np.e,), spectra.mixture)

    less = spectra.likelihood(truth) - louder.likelihood(truth)
    assert less == pytest.approx(0.5 * FREQUENCIES * 200, rel=1e-4)  # of the unit alone


def test_brightness_of_a_photograph_changes_nothing() -> None:
    scene = dead_leaves(128, 128, np.random.default_rng(2), largest=40.0)[1].astype(np.float32)
    one, two = (LocalSpectra.of([(g * scene, NoiseModel.white(g * 0.01))]) for g in (1.0, 0.25))

    np.testing.assert_allclose(one.periodograms[0], two.periodograms[0], rtol=1e-4, atol=1e-6)
    assert one.noise[0] == pytest.approx(two.noise[0], rel=1e-4)
