"""The regression on families of kernels whose truth is known in closed form."""

from __future__ import annotations

import math
from dataclasses import replace
from functools import cache
from itertools import chain

import numpy as np
import pytest

from lab.kernels import distance, gaussian
from lab.model_benchmark import pixel_to_local, run_model_benchmark
from lensmodel.core.errors import InvalidInputError, NoSamplesError
from lensmodel.core.psf import PsfSample, centroid, delta, second_moments
from lensmodel.core.types import CHANNELS, FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, regression
from lensmodel.model import query as va
from lensmodel.model.bandwidths import HeldOut, bandwidths
from lensmodel.model.query import MODES
from lensmodel.model.regression import (
    Answers,
    LocalKernels,
    Neighbourhood,
    WidthField,
    coefficients,
    spline_sums,
    without_negatives,
)

SIZE = 21
GREEN = LensSettings(aperture=2.0)


@cache
def truth(position: FieldPosition, turn: float = 0.0) -> Kernel:
    """Gaussian, wide along v and growing outwards, as seen from a place `turn` further on its ring."""
    c, s = math.cos(position.phi + turn), math.sin(position.phi + turn)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col)
    along, across = 0.8 + 1.2 * position.r**2, 1.0 + 2.0 * position.r**2
    return gaussian(SIZE, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def places(count: int, seed: int) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    r = np.sqrt(rng.uniform(0.0, 0.9, count))
    angles = rng.uniform(-math.pi, math.pi, count)
    return [FieldPosition(float(a), float(p)) for a, p in zip(r, angles, strict=True)]


@cache
def photo(
    name: str, seed: int, *, noise: float = 0.0, blur: float = 0.0, count: int = 24
) -> tuple[PsfSample, ...]:
    """Samples of one photo; `blur` adds variance along the rows, `noise` is relative at the peak."""
    rng = np.random.default_rng([seed, 1])
    found = []
    for where in places(count, seed):
        kernel = np.array(truth(where))
        if blur:
            shake = np.array(gaussian(SIZE, [[blur, 0.0], [0.0, 1e-3]]))
            kernel = np.fft.ifft2(np.fft.fft2(kernel) * np.fft.fft2(np.fft.ifftshift(shake))).real
        kernel = np.maximum(kernel, 0.0)
        # noise that leaves the empty surroundings empty: clipped there, it would be a bias, not noise
        grain = rng.normal(0.0, noise, kernel.shape) * np.sqrt(kernel * kernel.max())
        kernel = np.maximum(kernel + grain, 0.0)
        found.append(PsfSample(kernel, where, GREEN, photo=name))
    return tuple(found)


def photos(count: int, *, noise: float = 0.0, samples: int = 24) -> list[PsfSample]:
    return list(chain.from_iterable(photo(f"p{i}", i, noise=noise, count=samples) for i in range(count)))


def kernel_at(model: LensModel, r: float, phi: float, size: int = SIZE) -> Kernel:
    return model.query(FieldPosition(r, phi), GREEN, size).kernel


def difference(a: Kernel, b: Kernel) -> float:
    return float(np.linalg.norm(a - b) / np.linalg.norm(b))


def error(model: LensModel, seed: int = 99) -> float:
    return float(
        np.mean([distance(model.query(p, GREEN, SIZE).kernel, truth(p)).rel_l2 for p in places(12, seed)])
    )


# ---- what every mode keeps


@pytest.mark.parametrize("mode", MODES)
class TestEveryMode:
    def test_answers_a_centred_kernel_of_sum_one(self, mode: str) -> None:
        kernel = kernel_at(LensModel.fit(photos(1), mode), 0.6, 1.0, 33)

        assert kernel.shape == (33, 33)
        assert kernel.min() >= 0.0
        assert kernel.sum() == pytest.approx(1.0)
        assert np.hypot(*centroid(kernel)) < 2e-3

    def test_returns_the_one_psf_of_a_constant_round_family(self, mode: str) -> None:
        same = gaussian(SIZE, np.eye(2) * 1.5)
        model = LensModel.fit([replace(sample, kernel=same) for sample in photo("a", 3)], mode)

        assert difference(kernel_at(model, 0.5, -2.0), same) < 5e-3

    def test_does_not_depend_on_the_order_of_samples(self, mode: str) -> None:
        forward, backward = LensModel.fit(photos(2), mode), LensModel.fit(photos(2)[::-1], mode)

        assert difference(kernel_at(forward, 0.7, 0.4), kernel_at(backward, 0.7, 0.4)) < 1e-5

    def test_answers_many_places_at_once_as_one_by_one(self, mode: str) -> None:
        model, asked = LensModel.fit(photos(6), mode), places(9, 5)

        together = model.kernels(asked, GREEN, SIZE)

        for where, kernel in zip(asked, together, strict=True):
            assert np.abs(kernel - model.query(where, GREEN, SIZE).kernel).max() < 1e-9


# ---- the local frame and its splines


@pytest.mark.parametrize("turn", [0.0, 0.4, math.pi / 4])
@pytest.mark.parametrize(("kernel", "most"), [(delta(31), 0.12), (gaussian(31, np.eye(2) * 0.25), 0.06)])
def test_narrow_kernels_nearly_keep_their_shape_when_they_turn(
    kernel: Kernel, most: float, turn: float
) -> None:
    where = FieldPosition(0.5, 0.5)
    local = LocalKernels.of([PsfSample(kernel, where, GREEN)], va.point(where, GREEN)[None], WidthField())
    only = Answers(np.zeros(1, dtype=np.intp), np.ones(1), np.ones(1, dtype=np.intp))

    found = local.kernels(only, np.array([0.5 + turn]), np.ones((1, 2)), 31)[0]

    assert difference(found, kernel) < (most if turn else 1e-6)
    assert found[15, 15] > 0.88 * kernel[15, 15]


def test_long_axis_turns_with_the_place() -> None:
    model = LensModel.fit(photos(3))
    for phi in (-2.5, -0.7, 0.3, 1.9):
        row, col = np.linalg.eigh(second_moments(kernel_at(model, 0.8, phi)))[1][:, 1]
        # v at phi points to (row, col) = (-cos phi, -sin phi)
        aligned = abs(-row * math.cos(phi) - col * math.sin(phi))
        assert math.degrees(math.acos(min(aligned, 1.0))) < 2.0


@pytest.mark.parametrize("finer", [1, 2])
def test_spline_goes_through_the_pixels(finer: int) -> None:
    kernel = np.random.default_rng(2).random((11, 11))
    stored = np.pad(coefficients(kernel, finer), 3).astype(np.float32).reshape(1, -1)
    row, whole, at = np.zeros(1, dtype=np.intp), np.array([0, 1]), np.eye(2)[None] * finer
    read = np.zeros((1, 11, 11))

    spline_sums(stored, np.full(1, 99.0), row, np.ones(1), at, whole, np.zeros((1, 2)), read)

    assert np.abs(read[0] - kernel).max() < 1e-6


def test_values_without_negatives_keep_their_sum_and_those_without_any_stay() -> None:
    ripples = np.random.default_rng(9).normal(0.3, 1.0, (4, 81))
    ripples[1] = np.abs(ripples[1])

    after = without_negatives(ripples)

    assert after.min() == 0.0
    assert after.sum(axis=1) == pytest.approx(ripples.sum(axis=1))
    assert np.array_equal(after[1], ripples[1])
    lowered = (ripples - after)[0][after[0] > 0.0]  # the nearest such values are lower by one amount
    assert lowered == pytest.approx(np.full(len(lowered), lowered[0]))


# ---- the sum of eq. (4), its neighbours, its bandwidths


def test_neighbours_in_the_tree_weigh_what_all_samples_would() -> None:
    rng = np.random.default_rng(6)
    colours = [GREEN.with_channel(CHANNELS[i % 3]) for i in range(300)]
    where = np.array([va.point(p, s) for p, s in zip(places(300, 3), colours, strict=True)])
    where[::5, 3] = np.nan  # some do not know their aperture
    claims = np.where(rng.random(300) < 0.2, 0.0, rng.random(300))
    around = Neighbourhood(where, claims, np.array([0.03, 0.2, 0.2, 0.5, 20.0, 0.25, 0.5]))

    for position in [FieldPosition(0.0, 0.0), *places(7, 4)]:
        near = around.near([position], GREEN)
        squared = va.squared_distances(where, va.point(position, GREEN), around.scale)
        expected = claims * np.exp(-0.5 * (squared - squared[claims > 0.0].min()))
        found = np.bincount(near.rows, near.weights, 300)

        assert 1 < len(near.rows) < 300
        assert found == pytest.approx(expected / expected.sum(), abs=1e-3)
        assert len(around.within(va.point(position, GREEN), 1.5)) < 300


def all_pairs(model: LensModel, position: FieldPosition, *, pixel: float) -> np.ndarray:
    """Answer with the sum over all pixels of all samples, eq. 4 to 7; a PSF is zero outside its support."""
    t = np.arange(SIZE, dtype=np.float64) - SIZE // 2
    u, v = (a.ravel() for a in pixel_to_local(t[:, None], t[None, :], position.phi))
    known = va.points(model.samples)
    squared = va.squared_distances(known, va.point(position, GREEN), bandwidths(known, "paper"))
    above, below = np.zeros(u.size), np.zeros(u.size)
    for sample, weight in zip(model.samples, np.exp(-0.5 * squared), strict=True):
        kernel = np.pad(sample.kernel, 4)
        p = np.arange(kernel.shape[0], dtype=np.float64) - kernel.shape[0] // 2
        pu, pv = (a.ravel() for a in pixel_to_local(p[:, None], p[None, :], sample.position.phi))
        near = np.exp(-0.5 * ((u[:, None] - pu) ** 2 + (v[:, None] - pv) ** 2) / pixel**2)
        above += sample.weight * weight * (near @ kernel.ravel())
        below += sample.weight * weight * near.sum(axis=1)
    return (above / below).reshape(SIZE, SIZE)


def test_answer_is_within_eight_hundredths_of_the_exact_sum() -> None:
    model = LensModel.fit(photo("a", 0, count=16), "paper")
    for where in places(4, 5):
        exact = all_pairs(model, where, pixel=0.3)
        exact /= exact.sum()
        fast = model.query(where, GREEN, SIZE).kernel
        # the exact sum smooths by h_u^2 = 0.09 px^2 and by the pixel grid; the spline does not
        assert np.abs(fast - exact).max() <= 0.08 * exact.max()


def test_bandwidths_are_those_of_green_in_whatever_order_channels_come() -> None:
    green = photos(3, noise=0.01)
    blue = [replace(s, settings=s.settings.with_channel("b")) for s in photos(3, noise=0.5)]
    of_green = bandwidths(va.points(green), "paper")

    for samples in ([*green, *blue], [*blue, *green]):
        assert np.array_equal(bandwidths(va.points(samples), "paper"), of_green)


# ---- families


def test_follows_the_ring_family() -> None:
    assert error(LensModel.fit(photos(3))) < 0.08


def test_angles_on_both_sides_of_pi_are_neighbours() -> None:
    model = LensModel.fit(photos(2))
    above, below = (kernel_at(model, 0.6, sign * (math.pi - 1e-6)) for sign in (1.0, -1.0))

    assert difference(above, below) < 1e-4


def test_widths_are_carried_into_the_corner() -> None:
    inner = [s for s in photos(4) if s.position.r < 0.85]
    carried, faded = (
        distance(kernel_at(LensModel.fit(inner, mode), 1.0, 0.3), truth(FieldPosition(1.0, 0.3))).rel_l2
        for mode in ("default", "paper")
    )

    assert carried < 0.06
    assert carried < 0.5 * faded


def test_width_field_finds_widths_along_both_axes() -> None:
    field = WidthField.fit(photos(4), np.ones(96))
    inner, outer = field.over(np.array([va.point(FieldPosition(r, 0.7), GREEN) for r in (0.2, 0.9)]))

    assert outer[0] / inner[0] == pytest.approx((0.8 + 1.2 * 0.81) / (0.8 + 1.2 * 0.04), rel=0.05)
    assert outer[1] / inner[1] == pytest.approx((1.0 + 2.0 * 0.81) / (1.0 + 2.0 * 0.04), rel=0.05)


def test_colours_hardly_mix() -> None:
    narrow, wide = gaussian(SIZE, np.eye(2) * 0.8), gaussian(SIZE, np.eye(2) * 5.0)
    samples = [PsfSample(narrow, p, GREEN, photo="a") for p in places(20, 1)]
    samples += [PsfSample(wide, p, GREEN.with_channel("r"), photo="a") for p in places(20, 2)]

    assert difference(kernel_at(LensModel.fit(samples, "paper"), 0.5, 0.0), narrow) < 0.05


def test_samples_answer_by_their_weight() -> None:
    where = FieldPosition(0.5, 0.0)
    loud = PsfSample(gaussian(SIZE, np.eye(2)), where, GREEN, weight=1.0, photo="a")
    quiet = PsfSample(gaussian(SIZE, np.eye(2) * 4), where, GREEN, weight=0.01, photo="b")

    assert difference(kernel_at(LensModel.fit([loud, quiet]), 0.5, 0.0), loud.kernel) < 0.02


# ---- growing


def test_samples_added_one_by_one_answer_as_all_at_once() -> None:
    samples = photos(4)
    at_once = LensModel.fit(samples, "paper")
    grown = LensModel.fit(samples[:40], "paper")
    for sample in samples[40:]:
        grown = grown.added([sample])

    for where in places(5, 7):
        a, b = grown.query(where, GREEN, SIZE), at_once.query(where, GREEN, SIZE)
        assert difference(a.kernel, b.kernel) < 1e-6
        assert a.effective_samples == pytest.approx(b.effective_samples, rel=1e-6)


def test_a_sample_takes_25_bytes_a_pixel() -> None:
    samples = photos(20)

    assert LensModel.fit(samples).nbytes < 25 * SIZE * SIZE * len(samples) + 8 * 800 * SIZE * SIZE


def test_many_large_kernels_are_kept_no_finer_than_their_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    samples, fine = photos(4), LensModel.fit(photos(4))
    monkeypatch.setattr(regression, "_MOST_BYTES", 4 * SIZE * SIZE * len(samples))

    coarse = LensModel.fit(samples)

    assert coarse.nbytes < 0.6 * fine.nbytes
    for where in places(5, 7):
        assert distance(coarse.query(where, GREEN, SIZE).kernel, truth(where)).rel_l2 < 0.1


# ---- bad photos, and what it says of itself


def test_one_bad_photo_moves_the_field_by_less_than_a_tenth_of_a_plain_mean() -> None:
    clean, bad = photos(9, noise=0.01, samples=16), photo("shaken", 50, blur=16.0, count=16)

    def moved(mode: str) -> float:
        before, after = (LensModel.fit(samples, mode) for samples in (clean, [*clean, *bad]))
        asked = places(15, 77)
        gaps = before.kernels(asked, GREEN, SIZE) - after.kernels(asked, GREEN, SIZE)
        return float(np.linalg.norm(gaps, axis=(1, 2)).mean())

    assert moved("default") < 0.1 * moved("paper")


def test_bandwidths_are_searched_again_without_a_spoilt_photo(monkeypatch: pytest.MonkeyPatch) -> None:
    claims = []
    monkeypatch.setattr(HeldOut, "best_factors", lambda held: claims.append(held.prior) or (1.0, 1.0))

    LensModel.fit([*photos(9, noise=0.01, samples=16), *photo("shaken", 50, blur=16.0, count=16)])

    first, again = claims
    assert (first == 1.0).all()
    assert (again[-16:] < 0.5).all()


def test_error_falls_with_the_number_of_photos() -> None:
    assert error(LensModel.fit(photos(10, noise=0.3, samples=16))) < 0.75 * error(
        LensModel.fit(photos(1, noise=0.3, samples=16))
    )


def test_predicted_error_is_of_the_size_of_the_true_one() -> None:
    model = LensModel.fit(photos(6, noise=0.2, samples=16))
    answers = [(where, model.query(where, GREEN, SIZE)) for where in places(20, 31)]
    ratios = [a.predicted_error / distance(a.kernel, truth(where)).rel_l2 for where, a in answers]

    assert 0.5 < float(np.median(ratios)) < 4.0


def test_what_estimators_expect_does_not_fall_with_the_number_of_photos() -> None:
    few, many = (
        LensModel.fit([replace(s, error=0.3) for s in photos(n, noise=0.1, samples=16)])
        .query(FieldPosition(0.5, 0.3), GREEN, SIZE)
        .predicted_error
        for n in (2, 8)
    )

    assert few >= many > 0.2


def test_zones_expect_more_where_there_are_no_samples() -> None:
    errors = LensModel.fit([s for s in photos(3, noise=0.1) if s.position.r < 0.5]).expected_errors()

    assert errors["center"] < errors["mid"] < errors["corner"] <= 1.0


def test_beyond_the_outermost_samples_the_error_grows_with_the_way_outward() -> None:
    model = LensModel.fit([s for s in photos(3, noise=0.1) if s.position.r < 0.8])
    outermost = max(s.position.r for s in model.samples)
    inside, rim = (
        model.query(FieldPosition(r, 0.3), GREEN, SIZE).predicted_error for r in (0.7, outermost + 0.15)
    )

    assert rim**2 > inside**2 + 0.35**2
    assert rim < 0.7


@pytest.mark.parametrize(("r", "aperture", "far"), [(0.3, 2.0, False), (1.0, 2.0, True), (0.3, 8.0, True)])
def test_a_question_far_from_every_sample_is_told(r: float, aperture: float, far: bool) -> None:
    model = LensModel.fit([s for s in photos(3) if s.position.r < 0.5])

    assert model.query(FieldPosition(r, 0.2), LensSettings(aperture=aperture), SIZE).extrapolated == far


def test_unknown_aperture_takes_no_part_in_distances() -> None:
    model = LensModel.fit([replace(s, settings=LensSettings()) for s in photos(2)])
    where = FieldPosition(0.5, 1.0)
    at_two, at_eight = (model.query(where, LensSettings(aperture=n), SIZE) for n in (2.0, 8.0))

    assert np.array_equal(at_two.kernel, at_eight.kernel)
    assert not at_eight.extrapolated


# ---- what is refused


def test_no_samples_are_said_as_such() -> None:
    with pytest.raises(NoSamplesError, match="calibrate"):
        LensModel.fit([])


def test_a_mode_that_there_is_not_is_refused() -> None:
    with pytest.raises(InvalidInputError, match="paper"):
        LensModel.fit(photos(1), "magic")


@pytest.mark.parametrize("size", [0, 4])
def test_even_sizes_are_refused(size: int) -> None:
    with pytest.raises(InvalidInputError, match="odd"):
        kernel_at(LensModel.fit(photos(1)), 0.0, 0.0, size)


@pytest.mark.parametrize(
    "bad", [{"error": -0.1}, {"error": math.nan}, {"pixel_pitch_um": 0.0}, {"half_diagonal_px": 0.0}]
)
def test_impossible_samples_are_refused(bad: dict[str, float]) -> None:
    with pytest.raises(InvalidInputError, match=next(iter(bad)).split("_")[0]):
        replace(photo("a", 0)[0], **bad)  # type: ignore[arg-type]


# ---- true kernels of lenses that were not looked at while it was made


@pytest.mark.slow
def test_true_kernels_are_predicted_between_and_beyond_the_patches() -> None:
    rows = run_model_benchmark(seeds=range(2000, 2016), photos=(1, 2, 5), methods=["mode-default"])
    errors = {row["photos"]: row["errors"] for row in rows}

    assert errors[1]["corner"] <= 0.25
    assert errors[1]["center"] <= 0.15
    assert errors[5]["corner"] <= 0.16
    assert errors[5]["center"] <= 0.06
    for zone in ("center", "mid", "corner"):
        assert errors[1][zone] > errors[2][zone] > errors[5][zone]
