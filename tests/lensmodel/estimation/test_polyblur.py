from __future__ import annotations

import math
from functools import cache, lru_cache

import numpy as np
import pytest
from scipy import signal

from lensmodel.core.psf import delta, gaussian, second_moments
from lensmodel.core.types import Kernel, NoiseModel, Plane
from lensmodel.estimation.methods.polyblur import Polyblur, directional_slopes
from lensmodel.lab.scenes import dead_leaves
from lensmodel.simulate import demo_scene

SIGMA = 0.01
NOISE = NoiseModel.white(SIGMA)


@lru_cache(maxsize=1)
def green(scene: str) -> Plane:
    return demo_scene(scene)[1]


def shot(kernel: Kernel, *, scene: str = "city", row: int = 300, col: int = 500, side: int = 256) -> Plane:
    margin = kernel.shape[0] - 1
    window = green(scene)[row : row + side + margin, col : col + side + margin].astype(np.float64)
    y = signal.fftconvolve(window, kernel, mode="valid")
    return (y + np.random.default_rng(row).normal(0, SIGMA, y.shape)).astype(np.float32)


@cache
def drawn(side: int, seed: int) -> Plane:
    return dead_leaves(side, side, np.random.default_rng(seed), largest=40.0)[1].astype(np.float64)


def leaves(kernel: Kernel, *, seed: int = 0, side: int = 256) -> Plane:
    """Edges in every direction; none of them took part in the fit of the law."""
    y = signal.fftconvolve(drawn(side + kernel.shape[0] - 1, seed), kernel, mode="valid")
    return (y + np.random.default_rng([seed, 1]).normal(0, SIGMA, y.shape)).astype(np.float32)


def round_gaussian(sigma: float) -> Kernel:
    return gaussian(25, sigma**2 * np.eye(2))


def test_slope_of_a_blurred_step_follows_the_law() -> None:
    """A step of height 1 blurred by s, seen by the probe of 0.7 px: 1 / sqrt(2 pi (s² + 0.49)) at the edge.

    The edge lies between two pixels, half a pixel from the nearest.
    """
    step = np.tile(np.where(np.arange(96) < 48, 0.0, 0.9), (96, 1))
    y = signal.convolve(np.pad(step, 12, mode="edge"), round_gaussian(2.0), mode="valid")

    slopes = directional_slopes(y.astype(np.float32))

    variance = 4.0 + 1 / 12 + 0.49
    expected = math.exp(-0.125 / variance) / math.sqrt(2 * math.pi * variance)
    assert slopes[3] == pytest.approx(expected, rel=0.02)
    assert slopes[0] < 0.01


@pytest.mark.parametrize("sigma", [1.0, 1.5, 2.5])
def test_widths_of_round_gaussians_are_recovered(sigma: float) -> None:
    found = Polyblur().estimate([shot(round_gaussian(sigma))], [NOISE])

    width = math.sqrt(0.5 * (found.diagnostics["sigma"] ** 2 + found.diagnostics["rho"] ** 2))
    assert width == pytest.approx(sigma, rel=0.2)


def test_covariance_of_an_oblique_gaussian_is_recovered_from_three_patches() -> None:
    turn = math.radians(34)
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    truth = axes @ np.diag([2.5**2, 1.0]) @ axes.T
    patches = [leaves(gaussian(25, truth), seed=seed, side=128) for seed in (0, 1, 2)]

    found = second_moments(Polyblur().estimate(patches, [NOISE] * 3).kernel, 0.0)

    values, vectors = np.linalg.eigh(found)
    along = math.degrees(math.atan2(vectors[1, 1], vectors[0, 1])) % 180.0
    assert along == pytest.approx(34.0, abs=8.0)
    # The pixel is part of both kernels.
    least, most = np.linalg.eigvalsh(second_moments(gaussian(25, truth), 0.0))
    assert math.sqrt(values[1]) == pytest.approx(math.sqrt(most), rel=0.2)
    assert math.sqrt(values[0]) == pytest.approx(math.sqrt(least), rel=0.3)


def test_sharp_patches_give_a_kernel_like_a_point() -> None:
    found = Polyblur().estimate([leaves(delta(25), side=128)], [NOISE], size=15)

    assert found.no_blur
    assert found.kernel.max() > 0.5


def test_the_kernel_turns_with_the_patch() -> None:
    y = leaves(gaussian(25, [[4.0, 1.0], [1.0, 1.5]]), side=128)

    straight = Polyblur().estimate([y], [NOISE]).kernel
    turned = Polyblur().estimate([np.ascontiguousarray(np.rot90(y))], [NOISE]).kernel

    assert np.abs(turned - np.rot90(straight)).max() < 1e-3 * straight.max()


def test_affine_change_of_intensity_changes_nothing() -> None:
    y = leaves(round_gaussian(1.5), side=128)

    plain = Polyblur().estimate([y], [NOISE]).kernel
    other = Polyblur().estimate([0.5 * y + np.float32(0.1)], [NoiseModel.white(0.5 * SIGMA)]).kernel

    assert np.abs(other - plain).max() < 1e-4


def test_less_is_promised_where_slopes_are_near_their_ceiling() -> None:
    blurred, sharp = (
        Polyblur().estimate([leaves(k, side=128)], [NOISE]) for k in (round_gaussian(2.5), delta(25))
    )

    assert sharp.predicted_error > blurred.predicted_error
