from __future__ import annotations

import math

import numpy as np
import pytest
from blurred_scenes import OVAL, SIGMA, scene, shot, stroke
from numpy.typing import NDArray
from scipy import signal

from lab.blind.methods.sun import default_prior, edge_mask, edge_terms, target
from lab.blind.steps.pyramid import View
from lab.kernels import gaussian
from lab.training import blind_data
from lensmodel.core.psf import as_kernel, delta
from lensmodel.core.types import Kernel, Plane
from lensmodel.quality import edge_area

pytestmark = pytest.mark.slow  # a method to compare with, of the laboratory


def explained(y: Plane, sharp: NDArray[np.float64], kernel: Kernel) -> float:
    """Cost of the kernel step for one kernel when the sharp scene is known."""
    view = View(y.astype(np.float64), SIGMA)
    terms = edge_terms(sharp, view, kernel.shape[0], 0.0)
    return sum(float(np.square(t.y - t.grid.blurred(kernel, t.x)).sum()) for t in terms)


def test_the_generating_kernel_costs_least_where_the_scene_is_known() -> None:
    truth, side = stroke(), 120
    sharp = scene(side + 12)
    y, inner = shot(truth, side=side), sharp[6:-6, 6:-6]
    wrong = (delta(13), OVAL, as_kernel(np.rot90(truth)), as_kernel(truth[::-1, ::-1]), as_kernel(truth**1.5))

    assert all(explained(y, inner, kernel) > explained(y, inner, truth) for kernel in wrong)


def test_stored_patterns_are_those_that_the_command_makes() -> None:
    made = blind_data.spread(blind_data.primitives(), blind_data.COUNT)

    assert np.allclose(default_prior().patches, made, atol=1e-6)


def test_a_sharp_step_stays_and_a_soft_one_becomes_steeper() -> None:
    rows, cols = np.arange(-28, 28)[:, None], np.arange(-28, 28)[None, :]
    step = edge_area(rows, cols, 0.4)
    soft = signal.convolve(np.pad(step, 6, mode="edge"), gaussian(13, 1.5 * np.eye(2)), "valid", "direct")
    inner = (slice(8, -8), slice(8, -8))

    across = np.abs(math.cos(0.4) * cols - math.sin(0.4) * rows)
    assert edge_mask(step).sum() > 20
    assert across[edge_mask(step)].max() < 1.5
    kept, _ = target(step, edge_mask(step), default_prior())
    steeper, count = target(soft, edge_mask(soft), default_prior())

    assert np.sqrt(np.mean((kept - step)[inner] ** 2)) < 0.03
    assert np.abs(np.diff(steeper, axis=1)[inner]).max() > 1.3 * np.abs(np.diff(soft, axis=1)[inner]).max()
    assert np.array_equal(steeper[count == 0], soft[count == 0])
