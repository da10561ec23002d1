from __future__ import annotations

import numpy as np
import pytest
from blurred_scenes import OVAL, SIGMA, shot, stroke
from numpy.typing import NDArray
from scipy import signal

from lab.blind.methods.zhang import PatchPosterior
from lab.blind.steps.kernel_step import Grid
from lab.kernels import gaussian
from lensmodel.core.psf import as_kernel, delta
from lensmodel.core.types import Kernel

pytestmark = pytest.mark.slow  # a method to compare with, of the laboratory

FLOOR = 1e-4 + 2 * SIGMA**2


def free_energy(found: PatchPosterior, kernel: NDArray[np.floating]) -> float:
    """F of both gradients."""
    total = 0.0
    for part in found.parts:
        inner = (np.square(part.x) + part.variance) / part.gamma + np.log(part.gamma / part.variance)
        n = part.y.size
        data = (part.misfit(kernel) + found.floor * n) / found.noise + n * float(np.log(found.noise))
        total += data + float(inner.sum(dtype=np.float64))
    return total


def explained(y: NDArray[np.floating], kernel: Kernel, sweeps: int = 10) -> float:
    """Free energy when everything but the kernel is fitted."""
    found = PatchPosterior.of(y.astype(np.float64), kernel.shape[0], kernel, FLOOR)
    for _ in range(sweeps):
        found = found.improved(kernel, 8).with_noise(kernel)
    return free_energy(found, kernel)


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
    energy = free_energy(found, kernel)
    for _ in range(6):
        found = found.improved(kernel, 8)
        after_image = free_energy(found, kernel)
        raw = found.kernel_step(kernel)
        kernel = as_kernel(raw)
        found = found.scaled(float(raw.sum()))
        after_kernel = free_energy(found, kernel)
        found = found.with_noise(kernel)
        after_noise = free_energy(found, kernel)

        assert after_noise <= after_kernel < after_image < energy
        energy = after_noise


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
