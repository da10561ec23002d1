from __future__ import annotations

import math

import numpy as np
import pytest
from scipy import signal

from lab.blind.methods.edges import Edges, profiles, projection
from lab.blind.steps.pyramid import View
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel, delta, distance, gaussian, second_moments
from lensmodel.core.types import Kernel, NoiseModel, Plane

pytestmark = pytest.mark.slow  # a method to compare with, of the laboratory

SIGMA = 0.005
OVAL = gaussian(13, [[2.4, 0.9], [0.9, 1.2]])


def squares(kernel: Kernel, *, side: int = 160, seed: int = 0, most: float = math.pi / 2) -> Plane:
    """Turned squares of several grays, integrated over the pixel, blurred."""
    rng, over, grid = np.random.default_rng(seed), 4, 5
    n = side + kernel.shape[0] - 1
    t = (np.arange(n * over) + 0.5) / over
    fine = np.full((n * over, n * over), 0.2)
    for i in range(grid):
        for j in range(grid):
            row, col = (np.array([i, j]) + 0.5) * n / grid + rng.uniform(-2, 2, 2)
            angle = rng.uniform(0, most)
            down, across = t[:, None] - row, t[None, :] - col
            u = math.cos(angle) * across - math.sin(angle) * down
            v = math.sin(angle) * across + math.cos(angle) * down
            fine[(np.abs(u) < 9.5) & (np.abs(v) < 9.5)] = rng.uniform(0.5, 0.9)
    scene = fine.reshape(n, over, n, over).mean(axis=(1, 3))
    y = signal.convolve(scene, kernel, mode="valid", method="direct")
    return (y + rng.normal(0, SIGMA, y.shape)).astype(np.float32)


def bent() -> Kernel:
    kernel = np.zeros((13, 13))
    kernel[4, 4:9] = 1.0
    kernel[4:9, 8] = np.linspace(1.0, 0.3, 5)
    return as_kernel(signal.convolve(kernel, gaussian(3, 0.4 * np.eye(2)), mode="same", method="direct"))


def estimate(y: Plane, size: int = 15) -> Kernel:
    return Edges().estimate([y], [NoiseModel.white(SIGMA)], size=size).kernel


@pytest.mark.parametrize(
    ("truth", "error"),
    [(OVAL, 0.15), (gaussian(13, np.eye(2)), 0.15), (bent(), 0.3)],
    ids=["oval", "round", "bent"],
)
def test_straight_edges_give_the_kernel(truth: Kernel, error: float) -> None:
    assert distance(estimate(squares(truth)), truth).rel_l2 < error


def test_the_axes_of_an_oval_blur_come_out_right() -> None:
    found, truth = second_moments(estimate(squares(OVAL))), second_moments(OVAL)

    assert np.allclose(found, truth, rtol=0.2, atol=0.1)
    assert found[0, 1] > 0.5


def test_sharp_edges_give_a_kernel_like_a_point() -> None:
    found = Edges().estimate([squares(delta(3))], [NoiseModel.white(SIGMA)], size=15)

    assert found.kernel.max() > 0.8
    assert found.no_blur


def test_the_kernel_turns_with_the_patch() -> None:
    y = squares(OVAL)

    turned = estimate(np.ascontiguousarray(np.rot90(y)))

    assert distance(turned, np.rot90(estimate(y))).rel_l2 < 0.05


def test_shifting_or_dimming_the_patch_changes_little() -> None:
    y = squares(OVAL)
    straight = estimate(y)

    assert distance(estimate(y[3:, 3:]), straight).rel_l2 < 0.05
    assert distance(estimate((0.5 * y + 0.1).astype(np.float32)), straight).rel_l2 < 0.05


def test_more_directions_give_a_smaller_predicted_error() -> None:
    noise = [NoiseModel.white(SIGMA)]
    few = Edges().estimate([squares(OVAL, most=0.1)], noise, size=15)
    many = Edges().estimate([squares(OVAL)], noise, size=15)

    assert few.diagnostics["covered"] < 0.3
    assert many.diagnostics["covered"] > 0.8
    assert many.predicted_error < few.predicted_error
    assert many.confidence > few.confidence


def test_pictures_without_straight_edges_are_declined() -> None:
    rng = np.random.default_rng(0)
    clouds = signal.convolve(rng.normal(size=(160, 160)), gaussian(45, 120.0 * np.eye(2)), mode="valid")
    y = (0.5 + 0.2 * clouds / np.abs(clouds).max()).astype(np.float32)

    with pytest.raises(NotEnoughEvidenceError, match="edges"):
        estimate(y)


@pytest.mark.parametrize("angle", [0.0, 0.4, math.pi / 4, 1.3])
def test_a_projection_keeps_light_and_place(angle: float) -> None:
    matrix = projection(angle, 11, 64)
    s = (np.arange(64) - 31.5) * 0.25
    middle, beside = 5 * 11 + 5, 3 * 11 + 7  # two rows up, two columns to the right

    assert np.allclose(matrix.sum(axis=0)[[middle, beside]], 1.0, atol=0.02)
    assert s @ matrix[:, beside] == pytest.approx(2 * math.cos(angle) + 2 * math.sin(angle), abs=0.05)


def test_the_side_of_a_lopsided_edge_is_told() -> None:
    tail = np.zeros((13, 13))
    tail[6, 6:12] = 0.6 ** np.arange(6)  # a tail to the right
    found = profiles(View.of(squares(as_kernel(tail)), NoiseModel.white(SIGMA)), 7, 4)
    skews = [
        float(
            (np.maximum(e.spread, 0) * ((np.arange(e.spread.size) - e.spread.size / 2 + 0.5) / 4) ** 3).sum()
        )
        for e in found
        if e.direction in (0, 1)
    ]

    assert len(skews) >= 3
    assert np.median(skews) > 0.5
