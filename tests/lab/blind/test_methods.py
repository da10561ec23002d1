"""What the methods that are compared with recover of known kernels, and the steps of two of them."""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from blurred_scenes import OVAL, SIGMA, scene, shot, stroke
from numpy.typing import NDArray
from scipy import signal

from lab.blind.methods import BlindMethod, compared
from lab.blind.methods.sun import default_prior, edge_mask, edge_terms, target
from lab.blind.methods.zhang import PatchPosterior
from lab.blind.steps.kernel_step import Grid
from lab.blind.steps.pyramid import View
from lab.cases import scene_of
from lab.kernels import distance, gaussian
from lab.training import blind_data
from lensmodel.blind import estimators
from lensmodel.core.psf import as_kernel, centred, delta
from lensmodel.core.types import Kernel, NoiseModel, Plane
from lensmodel.quality import edge_area

pytestmark = pytest.mark.slow  # methods to compare with, of the laboratory

LIKENESS = {"cho-lee": 0.85, "xu-jia": 0.75, "sun": 0.75, "zhang": 0.93}
"""Least normalised cross-correlation with the true kernel."""


def test_each_method_is_held_to_a_likeness() -> None:
    assert set(LIKENESS) == set(compared) - set(estimators)


@pytest.fixture(scope="module", params=LIKENESS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def method(name: str) -> BlindMethod:
    return compared.create(name)


@pytest.fixture(scope="module")
def patch() -> Plane:
    return shot(stroke(), seed=1)


@pytest.fixture(scope="module")
def found(method: BlindMethod, patch: Plane) -> Kernel:
    return method.estimate([patch], [NoiseModel.white(SIGMA)], size=15).kernel


def test_a_bent_stroke_is_recovered_from_one_patch(name: str, found: Kernel) -> None:
    assert distance(found, stroke()).ncc > LIKENESS[name]
    assert distance(found, as_kernel(stroke()[::-1, ::-1])).ncc < distance(found, stroke()).ncc
    assert distance(delta(15), stroke()).ncc < 0.5


def test_the_kernel_turns_with_the_patch(method: BlindMethod, patch: Plane, found: Kernel) -> None:
    turned = method.estimate([np.ascontiguousarray(np.rot90(patch))], [NoiseModel.white(SIGMA)], size=15)

    # Forward differences lie half a pixel off the pixel, on the other side of it after a turn.
    assert distance(turned.kernel, np.rot90(found)).ncc > 0.95


SHAKEN_SIGMA = 0.003
SHARP = ("s08_spices", "s19_white_roses")


def motion_kernels(path: Path) -> tuple[Kernel, ...]:
    """Read A. Levin's eight kernels of 2009 from a MATLAB 7.3 file.

    It is an HDF5 file that keeps each kernel as a compact dataset: a layout message of version 3,
    class 0, the size in bytes, then the values, column by column.
    """
    data, found, at = path.read_bytes(), [], 0
    while (at := data.find(b"\x03\x00", at + 1)) >= 0:
        size = struct.unpack_from("<H", data.ljust(at + 4, b"\0"), at + 2)[0]
        side = round((size / 8) ** 0.5)
        if data[at - 8 : at - 6] == b"\x08\x00" and size == 8 * side * side and side % 2 == 1 and side > 8:
            values = np.frombuffer(data, "<f8", side * side, at + 4)
            found.append(centred(as_kernel(values.reshape(side, side).T)))
    return tuple(found)


def shaken(photo: Path, kernel: Kernel, seed: int, side: int = 256) -> Plane:
    margin = kernel.shape[0] - 1
    green = scene_of(photo)[1].astype(np.float64)
    row, col = (green.shape[0] - side - margin) // 2, (green.shape[1] - side - margin) // 2
    sharp = green[row : row + side + margin, col : col + side + margin]
    y = signal.convolve(sharp, kernel, mode="valid", method="direct")
    return (y + np.random.default_rng(seed).normal(0, SHAKEN_SIGMA, y.shape)).astype(np.float32)


@pytest.mark.tools
@pytest.mark.parametrize(("name", "median", "least"), [("zhang", 0.95, 0.9), ("sun", 0.8, 0.6)])
def test_camera_shake_is_recovered(shared_data: Path, name: str, median: float, least: float) -> None:
    kernels = motion_kernels(shared_data / "psf" / "levin09_motion_kernels.mat")
    assert [kernel.shape[0] for kernel in kernels] == [19, 17, 15, 27, 13, 21, 23, 23]
    similar, nothing = [], []
    for i, kernel in enumerate(kernels):
        y = shaken(shared_data / "sharp" / f"{SHARP[i % 2]}.png", kernel, i)
        found = compared.create(name).estimate([y], [NoiseModel.white(SHAKEN_SIGMA)], size=29)
        similar.append(distance(found.kernel, kernel).ncc)
        nothing.append(distance(delta(29), kernel).ncc)

    assert np.median(similar) > median, similar
    assert min(similar) > least, similar
    assert np.median(nothing) < 0.55


def cost(y: Plane, sharp: NDArray[np.float64], kernel: Kernel) -> float:
    """Cost of the kernel step for one kernel when the sharp scene is known."""
    view = View(y.astype(np.float64), SIGMA)
    terms = edge_terms(sharp, view, kernel.shape[0], 0.0)
    return sum(float(np.square(t.y - t.grid.blurred(kernel, t.x)).sum()) for t in terms)


def test_the_generating_kernel_costs_least_where_the_scene_is_known() -> None:
    truth, side = stroke(), 120
    sharp = scene(side + 12)
    y, inner = shot(truth, side=side), sharp[6:-6, 6:-6]
    wrong = (delta(13), OVAL, as_kernel(np.rot90(truth)), as_kernel(truth[::-1, ::-1]), as_kernel(truth**1.5))

    assert all(cost(y, inner, kernel) > cost(y, inner, truth) for kernel in wrong)


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
