from __future__ import annotations

import numpy as np
import pytest
from blurred_scenes import OVAL, SIGMA, scene, shot, stroke
from numpy.typing import NDArray
from scipy import signal

from lab.blind.methods.zhang import PatchPosterior, pooled_kernel
from lab.blind.steps.kernel_step import Grid, Term, least_squares_kernel
from lensmodel.core.psf import as_kernel, delta, distance, gaussian
from lensmodel.core.types import Kernel

pytestmark = pytest.mark.slow  # a method to compare with, of the laboratory

FLOOR = 1e-4 + 2 * SIGMA**2


def explained(y: NDArray[np.floating], kernel: Kernel, sweeps: int = 10) -> float:
    """Free energy when everything but the kernel is fitted."""
    found = PatchPosterior.of(y.astype(np.float64), kernel.shape[0], kernel, FLOOR)
    for _ in range(sweeps):
        found = found.improved(kernel, 8).with_noise(kernel)
    return found.free_energy(kernel)


def spread_out(kernel: Kernel, variance: float) -> Kernel:
    return as_kernel(signal.convolve(kernel, gaussian(7, variance * np.eye(2)), "same", method="direct"))


@pytest.mark.parametrize("truth", [stroke(), OVAL], ids=["bent", "gauss"])
def test_the_generating_kernel_has_the_least_free_energy(truth: Kernel) -> None:
    y = shot(truth, side=96)
    best = explained(y, truth)

    for wrong in (delta(13), as_kernel(truth**1.7), spread_out(truth, 0.6), as_kernel(np.rot90(truth))):
        assert explained(y, wrong) > best


def test_every_update_lowers_the_free_energy() -> None:
    y, kernel = shot(stroke(), side=72).astype(np.float64), gaussian(13, np.eye(2))
    found = PatchPosterior.of(y, 13, kernel, FLOOR)
    energy = found.free_energy(kernel)
    for _ in range(6):
        found = found.improved(kernel, 8)
        after_image = found.free_energy(kernel)
        raw = pooled_kernel(found.weighted(), kernel)
        kernel = as_kernel(raw)
        found = found.scaled(float(raw.sum()))
        after_kernel = found.free_energy(kernel)
        found = found.with_noise(kernel)
        after_noise = found.free_energy(kernel)

        assert after_noise <= after_kernel < after_image < energy
        energy = after_noise


def test_scaling_scene_against_kernel_changes_no_free_energy() -> None:
    y, kernel = shot(stroke(), side=72).astype(np.float64), stroke()
    found = PatchPosterior.of(y, 13, kernel, FLOOR).improved(kernel, 4)

    assert found.scaled(2.0).free_energy(kernel / 2.0) == pytest.approx(found.free_energy(kernel), rel=1e-5)


def test_products_with_the_convolution_are_each_others_transposes() -> None:
    rng = np.random.default_rng(0)
    grid = Grid((20, 27), 5)
    x, e, k = rng.normal(size=grid.latent), rng.normal(size=grid.frame), rng.random((5, 5))
    x, e = x.astype(np.float32), e.astype(np.float32)
    blurred = signal.convolve(x, k, mode="valid")

    assert np.allclose(grid.blurred(k, x), blurred, atol=1e-4)
    assert np.vdot(grid.back(grid.spectrum(k), e), x) == pytest.approx(np.vdot(e, blurred), rel=1e-4)
    assert np.vdot(grid.onto_kernel(grid.spectrum(x), e), k) == pytest.approx(np.vdot(e, blurred), rel=1e-4)
    # sum_i c_i w_i(k) = sum_j k_j² (sum of c under j)
    assert np.vdot(grid.reach_of(k), x**2) == pytest.approx(np.vdot(grid.sums_of(x**2), k**2), rel=1e-4)


def test_the_kernel_step_recovers_the_kernel_of_a_known_scene() -> None:
    truth, y = stroke(), scene(140)
    x = np.diff(y, axis=1)
    observed = signal.fftconvolve(x, truth, mode="valid")
    frame = (observed.shape[0], observed.shape[1])
    term = Term(Grid(frame, 13), observed.astype(np.float32), x.astype(np.float32), 1.0)

    found = least_squares_kernel([term], gaussian(13, np.eye(2)), turns=6)

    assert distance(as_kernel(found), truth).rel_l2 < 0.01
