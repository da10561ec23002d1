"""Contract of every deconvolution method, and what each one promises by itself."""

from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from scipy import ndimage
from skimage import restoration

from lab.kernels import gaussian
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import delta
from lensmodel.core.types import Channel, FieldPosition, Frame, Kernel, NoiseModel
from lensmodel.correction import (
    SaturationAwareRichardsonLucy,
    Sensor,
    SparseGradient,
    correct_planes,
    deconvolvers,
    restore_planes,
)
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.richardson_lucy import Acceleration, Lights, first_guess
from lensmodel.correction.sparse_gradient import shrink, shrinkage

CLEAN = Sensor(NoiseModel(1e-7, 1e-8))
METHODS = list(deconvolvers)


@dataclass(frozen=True)
class Even:
    """One kernel everywhere."""

    kernel: Kernel

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        return self.kernel


def scene(rows: int = 96, cols: int = 110, seed: int = 0) -> np.ndarray:
    """Return overlapping squares of random light: edges of all sizes, as photographs have."""
    rng = np.random.default_rng(seed)
    plane = np.full((rows, cols), 0.3, dtype=np.float32)
    for _ in range(150):
        side = int(min(4 + rng.pareto(1.2) * 4, 40))
        top, left = int(rng.integers(-side, rows)), int(rng.integers(-side, cols))
        plane[max(top, 0) : max(top + side, 0), max(left, 0) : max(left + side, 0)] = rng.uniform(0.05, 0.8)
    return plane


def lit(plane: np.ndarray, light: float, *places: tuple[float, float], radius: float = 5.0) -> np.ndarray:
    """The plane with discs of that light."""
    rows, cols = np.indices(plane.shape)
    for row, col in places:
        plane = np.where(np.hypot(rows - row, cols - col) < radius, np.float32(light), plane)
    return plane


def rmse(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.sqrt(np.mean((a - b) ** 2)))


@pytest.mark.parametrize("name", METHODS)
def test_method_keeps_a_constant(name: str) -> None:
    flat = np.full((60, 64), 0.4, dtype=np.float32)

    restored = deconvolvers.create(name).deconvolve(flat, UniformBlur(gaussian(9, np.eye(2))), sensor=CLEAN)

    np.testing.assert_allclose(restored, 0.4, atol=2e-3)


@pytest.mark.parametrize("name", METHODS)
def test_method_changes_nothing_without_blur_and_noise(name: str) -> None:
    plane = scene()

    restored = deconvolvers.create(name).deconvolve(plane, UniformBlur(delta(5)), sensor=CLEAN)

    assert rmse(restored, plane) < 1e-3


@pytest.mark.parametrize("name", METHODS)
def test_method_brings_a_scene_blurred_without_noise_nearer_to_the_truth(name: str) -> None:
    sharp, blur = scene(), UniformBlur(gaussian(11, np.eye(2) * 1.2))
    blurred, truth = blur.forward(sharp), blur.frame(sharp)

    restored = deconvolvers.create(name).deconvolve(blurred, blur, sensor=CLEAN)

    assert rmse(restored, truth) < (0.9 if name == "paper" else 0.6) * rmse(blurred, truth)


def test_light_beyond_saturation_and_the_rest_make_up_the_photo_where_it_was_not_clipped() -> None:
    blurs = [UniformBlur(gaussian(9, np.eye(2) * width)) for width in (0.8, 1.0, 1.3)]
    sharp = scene(90, 101)
    tile = np.stack([np.minimum(blur.forward(sharp)[:80, :90], 0.7) for blur in blurs])

    lights = Lights.of(tile, blurs, [Sensor(CLEAN.noise, 0.7)] * 3, 20)

    assert lights is not None
    np.testing.assert_allclose((lights.rest + lights.glow)[tile < 0.7], tile[tile < 0.7], atol=1e-6)
    assert Lights.of(tile, blurs, [CLEAN] * 3, 20) is None


def test_automatic_strength_is_near_the_best_where_noise_is_strong_and_the_kernel_wide() -> None:
    rng, noise = np.random.default_rng(7), NoiseModel(1 / 2500, 0.003**2)
    blur, sharp = UniformBlur(gaussian(21, np.eye(2) * 2.5**2)), scene(170, 180, seed=2)
    seen = blur.forward(sharp)
    seen = (seen + np.sqrt(noise.variance(seen)) * rng.standard_normal(seen.shape)).astype(np.float32)

    def decibels(factor: float) -> float:
        method = SparseGradient(weight=factor * SparseGradient().weight)
        made = method.deconvolve(seen, blur, sensor=Sensor(noise, np.inf))
        return -20 * np.log10(rmse(made[8:-8, 8:-8], blur.frame(sharp)[8:-8, 8:-8]))

    assert decibels(1.0) > max(decibels(factor) for factor in (0.35, 0.5, 0.7, 1.4, 2.0)) - 0.1


@cache
def clipped_lamps(width: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, UniformBlur, NoiseModel]:
    """Lamps of 1.5 to 25 times saturation: photo, truth, unclipped pixels nearby, blur and noise."""
    rng = np.random.default_rng(3)
    sharp = scene(170, 180, seed=2) * 0.6
    for light in (1.5, 3.0, 6.0, 12.0, 25.0):
        sharp = lit(sharp, light, tuple(rng.uniform(30, 140, 2)), radius=rng.uniform(1.0, 5.0))
    blur = UniformBlur(gaussian(17, np.eye(2) * width**2))
    truth, noise = blur.frame(sharp), NoiseModel(2e-5, 1e-6)
    seen = blur.forward(sharp)
    seen += np.sqrt(noise.variance(seen)) * rng.standard_normal(seen.shape)
    photo = np.minimum(seen, 1.0).astype(np.float32)
    near = ndimage.binary_dilation(photo >= 1.0, iterations=16) & (photo < 1.0) & (truth < 1.0)
    return photo, truth, near, blur, noise


def error_and_ring(made: np.ndarray, truth: np.ndarray, near: np.ndarray) -> tuple[float, float]:
    """RMS error near lamps, and by how much the darkest pixels fall below the darkest truth around."""
    darkest = ndimage.minimum_filter(truth, 5)
    return rmse(made[near], truth[near]), float(np.quantile((darkest - made)[near], 0.99))


@cache
def errors_of_richardson_lucy(width: float, steps: int) -> tuple[float, float]:
    photo, truth, near, blur, noise = clipped_lamps(width)
    made = SaturationAwareRichardsonLucy(steps).deconvolve(photo, blur, sensor=Sensor(noise, clip=1.0))
    return error_and_ring(made, truth, near)


@pytest.mark.parametrize("name", ["standard", "fast"])
def test_method_beats_richardson_lucy_around_lamps_that_the_lens_spread(name: str) -> None:
    photo, truth, near, blur, noise = clipped_lamps(2.0)
    made = deconvolvers.create(name).deconvolve(photo, blur, sensor=Sensor(noise, clip=1.0))

    error, ring = error_and_ring(made, truth, near)
    rivals = [errors_of_richardson_lucy(2.0, steps) for steps in (8, 15, 25)]

    assert error < min(rival[0] for rival in rivals)
    assert ring < rivals[1][1]


@pytest.mark.parametrize("width", [0.6, 2.0])
@pytest.mark.parametrize("name", ["standard", "fast"])
def test_correction_rings_less_than_half_of_richardson_lucy_around_lamps(name: str, width: float) -> None:
    photo, truth, near, blur, noise = clipped_lamps(width)
    made = correct_planes(
        np.stack([photo] * 3), Even(blur.kernel), Frame(*photo.shape), noise=[noise] * 3, method=name
    ).planes[1]

    error, ring = error_and_ring(made, truth, near)

    assert ring < 0.5 * errors_of_richardson_lucy(width, 15)[1]
    assert error < 0.85 * rmse(photo[near], truth[near])


@pytest.mark.parametrize("name", METHODS)
def test_method_answers_float32_of_the_frame_is_repeatable_and_leaves_its_input_alone(name: str) -> None:
    blurred = scene(40, 50)
    before = blurred.copy()
    blur = UniformBlur(gaussian(7, np.eye(2)))

    first, second = (deconvolvers.create(name).deconvolve(blurred, blur, sensor=CLEAN) for _ in range(2))

    assert (first.shape, first.dtype) == (blurred.shape, np.float32)
    np.testing.assert_array_equal(first, second)
    np.testing.assert_array_equal(blurred, before)


@pytest.mark.parametrize(
    ("method", "wrong", "said"),
    [
        (SaturationAwareRichardsonLucy, {"iterations": 0}, "iterations"),
        (SaturationAwareRichardsonLucy, {"iterations": 501}, "iterations"),
        (SaturationAwareRichardsonLucy, {"acceleration": "fast"}, "fixed, adaptive, none"),
        (SparseGradient, {"weight": 0.0}, "positive"),
    ],
)
def test_parameters_out_of_range_are_refused(method: type, wrong: dict, said: str) -> None:
    with pytest.raises(InvalidInputError, match=said):
        method(**wrong)


def test_richardson_lucy_raises_the_likelihood_with_every_step() -> None:
    rng = np.random.default_rng(5)
    blur = UniformBlur(gaussian(9, np.eye(2) * 2))
    light = np.maximum(blur.forward(scene()), 0.01)
    counts = (rng.poisson(light * 500) / 500).astype(np.float32)
    sensor = Sensor(NoiseModel(1 / 500, 0.0))
    scores = []
    for steps in (1, 2, 4, 8, 16):
        plane = SaturationAwareRichardsonLucy(steps, "none").deconvolve(counts, blur, sensor=sensor)
        # The frame of the estimate is all that is returned; inside it the prediction is complete.
        predicted = np.maximum(blur.forward(plane), 1e-6)
        seen = blur.frame(counts)
        scores.append(float((seen * np.log(predicted) - predicted).sum(dtype=np.float64)))

    assert np.all(np.diff(scores) > 0)


def test_richardson_lucy_equals_scikit_image_inside_at_equal_start() -> None:
    sharp, kernel = scene(150, 150), gaussian(7, np.eye(2))
    blur = UniformBlur(kernel)
    blurred = np.maximum(blur.forward(sharp), 1e-3)
    plain = SaturationAwareRichardsonLucy(6, "none")
    ours = plain.deconvolve(blurred, blur, sensor=Sensor(NoiseModel(1e-4, 0.0)))
    # scikit-image starts from a constant; ours from one back-projection, which is its first step
    # up to the constant: x1 = 0.5 k~ * (y / 0.5) = k~ * y.
    theirs = restoration.richardson_lucy(blurred.astype(np.float64), kernel, num_iter=7, clip=False)

    np.testing.assert_allclose(ours[30:-30, 30:-30], theirs[30:-30, 30:-30], atol=1e-4)


@pytest.mark.parametrize("acceleration", ["fixed", "adaptive"])
def test_acceleration_is_worth_three_times_the_steps(acceleration: Acceleration) -> None:
    sharp, blur = scene(128, 128), UniformBlur(gaussian(15, np.eye(2) * 4))
    blurred, truth = blur.forward(sharp), blur.frame(sharp)
    fast, slow = SaturationAwareRichardsonLucy(20, acceleration), SaturationAwareRichardsonLucy(60, "none")

    found = [rmse(m.deconvolve(blurred, blur, sensor=CLEAN), truth) for m in (fast, slow)]
    assert found[0] <= found[1]


def test_measured_acceleration_is_biggs_and_andrews_own() -> None:
    sharp, kernel = scene(60, 60), gaussian(9, np.eye(2) * 2)
    blur = UniformBlur(kernel)
    blurred = np.maximum(blur.forward(sharp), 1e-3)
    sensor = Sensor(NoiseModel(1e-4, 0.0), clip=np.inf)

    # eqs. (4) to (7), written down a second time, over plain Richardson-Lucy steps
    latent, reach = first_guess(blurred, blur)
    previous, changes = latent, []
    for _ in range(8):
        alpha = 0.0
        if len(changes) > 1:
            alpha = float(np.sum(changes[-1] * changes[-2]) / np.sum(changes[-2] ** 2))
        start = np.maximum(latent + np.clip(alpha, 0.0, 1.0) * (latent - previous), 1e-6)
        ratio = blurred / np.maximum(blur.forward(start), 1e-6)
        previous, latent = latent, start * np.maximum(1.0 + blur.adjoint(ratio - 1.0) / reach, 0.0)
        changes.append((latent - start).astype(np.float64))

    method = SaturationAwareRichardsonLucy(8, acceleration="adaptive")
    found = method.deconvolve(blurred, blur, sensor=sensor)
    np.testing.assert_allclose(found, blur.frame(latent), rtol=2e-4, atol=2e-5)


def test_clipped_lights_do_not_ring_into_their_neighbours() -> None:
    rng = np.random.default_rng(8)
    background = 0.2 + 0.05 * ndimage.gaussian_filter(rng.standard_normal((140, 140)), 1.5).astype(np.float32)
    lights = lit(lit(background, 10.0, (50, 60), radius=4), 20.0, (95, 88), radius=4)
    blur = UniformBlur(gaussian(17, np.eye(2) * 4))
    noise = (rng.standard_normal((124, 124)) * 1e-3).astype(np.float32)
    sensor = Sensor(NoiseModel(1e-6, 1e-6), clip=1.0)
    photo = np.minimum(blur.forward(lights), 1.0) + noise
    quiet = blur.forward(background) + noise
    method = SaturationAwareRichardsonLucy(25)
    truth = blur.frame(lights)
    far = ~ndimage.binary_dilation(truth > 1.0, iterations=16)

    with_lights, without = (
        method.deconvolve(plane.astype(np.float32), blur, sensor=sensor) for plane in (photo, quiet)
    )

    assert rmse(with_lights[far], truth[far]) <= 1.1 * rmse(without[far], truth[far])


@pytest.mark.parametrize("alpha", [0.5, 0.8, 1.0])
@pytest.mark.parametrize("threshold", [1e-4, 0.01, 1.0])
def test_shrinkage_finds_the_minimum_but_on_the_ramp_of_its_jump(alpha: float, threshold: float) -> None:
    prox, scale = shrinkage(alpha), np.float32(threshold ** (1.0 / (2.0 - alpha)))
    v = np.linspace(-4.0, 4.0, 41).astype(np.float32)
    grid = np.linspace(-4.2, 4.2, 20001)

    found = np.array([shrink(value, scale, prox) for value in v])

    def energy(w: np.ndarray) -> np.ndarray:
        return threshold * np.abs(w) ** alpha + (w - v[:, None]) ** 2 / 2

    best = energy(np.tile(grid, (v.size, 1))).min(axis=1)
    jump = np.abs(v) * prox[0] / scale
    excess = energy(found[:, None].astype(np.float64))[:, 0] - best - 2e-3 * threshold - 1e-5
    assert np.all(excess[(jump <= 1.0) | (jump >= 1.1)] <= 0.0)


def test_data_with_their_surroundings_give_the_same_picture_inside() -> None:
    blur = UniformBlur(gaussian(9, np.eye(2)))
    blurred = np.stack([blur.forward(scene(110, 120))] * 3)
    sensors = [Sensor(NoiseModel(1e-5, 1e-6), edges=(side,) * 4) for side in (True, False)]

    alone, inside = (restore_planes(SparseGradient(), blurred, [blur] * 3, [s] * 3).planes for s in sensors)

    assert rmse(alone[:, 16:-16, 16:-16], inside[:, 16:-16, 16:-16]) < 2e-3


def test_a_frame_behind_a_point_moved_by_a_part_of_a_pixel_does_not_run_away() -> None:
    # lateral colour of a file whose blur is not known: its transfer function rings, and is no kernel's
    rng = np.random.default_rng(2)
    tile = np.ascontiguousarray(np.repeat(rng.uniform(0.05, 0.9, (3, 16, 4)), 16, axis=2), dtype=np.float32)
    tile = tile.repeat(4, axis=1)
    shifts = ((0.3, -0.4), (0.0, 0.0), (-0.3, 0.4))
    blurs = [UniformBlur(np.ones((1, 1)), shift) for shift in shifts]

    restored = SparseGradient().deconvolve_planes(tile, blurs, [Sensor(NoiseModel.white(0.002))] * 3).planes

    assert np.abs(restored).max() < 100.0  # steps of the tile ring; without a bound nothing is a number
