"""The physical mean: derivatives of kernels, and recovery of a lens from its true kernels."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, as_kernel, centroid, distance
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.wavefront.from_kernels import fit_wavefront, side_of_light, spread_samples
from lensmodel.optics.pupil import TERMS, PupilGrid
from lensmodel.optics.wavefront import Wavefront
from lensmodel.simulate import draw_lens


def test_derivatives_of_the_light_are_its_differences() -> None:
    grid = PupilGrid.of(0.3, 15)
    g = np.array([0.4, 0.5, -0.3, 0.6, 0.4, -0.2, 0.1, 0.2])
    amplitude = grid.amplitude(1.1, (0.2, 0.1))

    _, found = grid.with_derivatives(g, amplitude)

    for term in range(TERMS):
        step = 1e-3 * np.eye(TERMS)[term]
        wanted = (grid.light(g + step, amplitude) - grid.light(g - step, amplitude)) / 2e-3
        assert np.abs(found[term] - wanted).max() < 5e-3 * np.abs(wanted).max()


@pytest.mark.parametrize(("q", "size"), [(0.17, 33), (0.19, 25), (0.35, 21), (1.2, 9)])
def test_folded_transform_gives_the_light_of_the_plain_one(q: float, size: int) -> None:
    grid = PupilGrid.of(q, size)  # even and odd numbers of samples, in the pupil and across the light
    g = np.array([1.0, 0.8, -0.4, -1.5, 0.4, 0.3, 0.2, -0.1])
    amplitude = grid.amplitude(1.1, (0.2, 0.1))
    angle = np.tensordot(g * np.pi / q, grid.terms.astype(np.float64), axes=1)

    plain = np.abs(grid.rows @ (amplitude * np.exp(1j * angle)) @ grid.cols) ** 2

    np.testing.assert_allclose(grid.fine_light(g, amplitude), plain, atol=1e-5 * plain.max())


def test_tilt_to_the_right_moves_the_light_to_the_right() -> None:
    grid = PupilGrid.of(0.5, 21)
    amplitude = grid.amplitude(2.0, (0.0, 0.0))

    right = grid.light(np.array([0, 0, 0, 0, 0, 0, 3.0, 0]), amplitude)
    up = grid.light(np.array([0, 0, 0, 0, 0, 0, 0, 3.0]), amplitude)

    assert int(right.argmax()) == 10 * 21 + 13
    assert int(up.argmax()) == 7 * 21 + 10


def test_one_photo_of_true_kernels_tells_the_corner_that_it_did_not_see() -> None:
    lens = draw_lens(4)
    settings = LensSettings(aperture=lens.at_focal(None).f_number)
    places = [FieldPosition(r, a + r) for r in (0.1, 0.4, 0.6, 0.8) for a in np.arange(6) * math.pi / 3]
    samples = [PsfSample(lens.kernel(p, settings, 31), p, settings) for p in places]
    corner = FieldPosition(0.97, 0.58)

    front = fit_wavefront(samples)

    assert front is not None
    assert distance(front.kernel(corner, settings, 31), lens.kernel(corner, settings, 31)).rel_l2 < 0.08


def test_light_beyond_35_pixels_is_part_of_what_is_fitted() -> None:
    row, col = np.mgrid[-27:28, -27:28]
    wide = as_kernel((np.hypot(row, col) < 22.0).astype(np.float64))

    assert 40 <= side_of_light(wide) <= 45
    assert side_of_light(as_kernel(np.asarray(wide[12:-12, 12:-12]))) == 31  # a kernel of the usual size


@pytest.mark.parametrize(
    "change",
    [
        {"log_q": math.nan},
        {"log_q": -700.0},
        {"eye": (0.0, 0.1)},
        {"f_number": 0.0},
        {"size": 14},
        {"error": -1.0},
    ],
)
def test_impossible_wavefronts_are_refused(change: dict[str, Any]) -> None:
    with pytest.raises(InvalidInputError, match="wavefront"):
        replace(Wavefront(np.zeros(19), -0.5, (1.0, 0.1), 2.0, 15), **change)


def test_in_huge_pixels_the_light_is_in_one() -> None:
    front = Wavefront(np.zeros(19), math.log(1e-3), (1.0, 0.1), 2.0, 15)

    kernel = front.kernel(FieldPosition(0.0, 0.0), LensSettings(), 5)

    assert kernel[2, 2] == pytest.approx(1.0)


@pytest.mark.parametrize("count", [0, 11])
def test_too_few_samples_make_no_wavefront(count: int) -> None:
    kernel = draw_lens(4).kernel(FieldPosition(0.2, 0.0), None, 11)

    assert fit_wavefront([PsfSample(kernel, FieldPosition(0.2, 0.0))] * count) is None


def test_no_sample_is_chosen_twice_where_photos_share_their_places() -> None:
    kernel = as_kernel(np.ones((3, 3)))
    samples = [
        PsfSample(kernel, FieldPosition(0.09 * i, i), weight=weight, photo=photo)
        for photo, weight in (("b", 0.5), ("c", 0.5), ("a", 0.2))
        for i in range(10)
    ]

    chosen = spread_samples(samples, 24)

    assert len({id(s) for s in chosen}) == 24
    assert len({s.position for s in chosen[:10]}) == 10
    assert [s.photo for s in chosen].count("a") == 4  # the lesser votes come last


def of_lens(seed: int, photos: int) -> list[PsfSample]:
    lens, rng = draw_lens(seed), np.random.default_rng(seed)
    places = [
        FieldPosition(float(r), float(a))
        for r, a in zip(*rng.uniform((0, -3), (0.9, 3), (14 * photos, 2)).T, strict=True)
    ]
    return [PsfSample(lens.kernel(p, None, 21), p, photo=f"p{i % photos}") for i, p in enumerate(places)]


@pytest.fixture(scope="module")
def cold() -> LensModel:
    return LensModel.fit(of_lens(4, 1), ModelSettings(mode="wavefront"))


@pytest.fixture(scope="module")
def steps() -> list[tuple[int, int]]:
    """What the fit of `warm` told of its progress."""
    return []


@pytest.fixture(scope="module")
def warm(
    cold: LensModel,
    steps: list[tuple[int, int]],
    searching_shortly: Callable[[], AbstractContextManager[None]],
) -> LensModel:
    with searching_shortly():
        return cold.warmed(lambda done, total: steps.append((done, total)))


class TestWavefrontAlone:
    def test_leans_on_the_wavefront_in_a_corner_without_samples(
        self, cold: LensModel, warm: LensModel
    ) -> None:
        corner = FieldPosition(0.97, 0.58)
        truth = draw_lens(4).kernel(corner, None, 21)
        plain = cold.query(corner, LensSettings(), 21)
        combined = warm.query(corner, LensSettings(), 21)

        assert plain.wavefront_share == 0.0
        assert combined.wavefront_share == 1.0
        assert distance(combined.kernel, truth).rel_l2 < 0.6 * distance(plain.kernel, truth).rel_l2

    def test_is_no_worse_than_without_where_no_wavefront_fits(self, short_search: None) -> None:
        # three separate spots in a row, apart by the field: no pupil makes them
        def spots(place: FieldPosition) -> Kernel:
            t, apart = np.arange(-10, 11), 3.0 + 2.0 * place.r
            along = np.exp(-0.8 * t**2) + np.exp(-0.8 * (t - apart) ** 2) + np.exp(-0.8 * (t + apart) ** 2)
            return as_kernel(np.outer(np.exp(-0.8 * t**2), along))

        samples = [PsfSample(spots(s.position), s.position, photo=s.photo) for s in of_lens(4, 1)]
        asked = [FieldPosition(r, a) for r in (0.2, 0.5, 0.8) for a in (-2.0, 0.3, 2.2)]

        def error(model: LensModel) -> float:
            kernels = [(model.query(p, LensSettings(), 21).kernel, spots(p)) for p in asked]
            return float(np.mean([distance(k, t).rel_l2 for k, t in kernels]))

        cold = LensModel.fit(samples, ModelSettings(mode="wavefront"))
        assert error(cold.warmed()) < 1.1 * error(cold)

    def test_waits_for_the_wavefront_until_it_is_asked_to_be_warm(
        self, cold: LensModel, warm: LensModel, steps: list[tuple[int, int]]
    ) -> None:
        assert not cold.warm
        assert cold.query(FieldPosition(0.5, 0.2), LensSettings(), 21).wavefront_share == 0.0
        assert warm.warm
        assert warm.warmed() is warm
        assert warm.query(FieldPosition(0.5, 0.2), LensSettings(), 21).wavefront_share > 0.0
        assert steps[-1][0] == steps[-1][1]

    def test_samples_without_spectra_are_answered_for_by_the_regression_and_are_warm_without_work(
        self,
    ) -> None:
        model = LensModel.fit(of_lens(4, 2))

        assert model.warm
        assert model.warmed() is model
        answer = model.query(FieldPosition(0.5, 0.2), LensSettings(), 21)
        assert (answer.answered_by, answer.wavefront_share) == ("regression", 0.0)
        assert answer.reason == "no patch has a spectrum"

    def test_same_samples_give_the_same_wavefront(self, warm: LensModel, short_search: None) -> None:
        again = LensModel.fit(warm.samples, warm.settings).warmed()
        corner = FieldPosition(0.97, 0.58)
        one, two = (model.query(corner, LensSettings(), 21) for model in (warm, again))

        assert one.wavefront_share > 0.0
        assert np.array_equal(one.kernel, two.kernel)


def test_a_kernel_whose_centre_goes_to_and_fro_is_rendered_all_the_same() -> None:
    terms = [-0.389, -0.137, -0.445, 0.017, -0.369, -0.038, -0.193, 0.012, 0.068, 0.215]
    terms += [-0.054, -0.56, 1.086, -0.005, 0.012, -0.054, -0.044, 0.006, -0.009]
    front = Wavefront(np.array(terms), -1.53, (1.16, 0.2), 1.8, 13)

    kernel = front.kernel(FieldPosition(0.71, 0.53), LensSettings(aperture=1.8, focal_mm=35.0), 31)

    assert kernel.sum() == pytest.approx(1.0)
    assert math.hypot(*centroid(kernel)) < 0.01


def test_light_narrower_than_the_fine_grid_is_never_negative() -> None:
    terms = [-0.045, 0.106, -0.494, 0.164, 0.032, 0.081, -0.174, 0.053, -0.465, -0.503]
    terms += [-0.114, 0.113, 0.222, -0.165, 0.015, -0.159, -0.065, 0.186, -0.176]
    front = Wavefront(np.array(terms), -1.532, (0.901, 0.124), 1.8, 11)

    kernel = front.kernel(FieldPosition(0.9, -2.58), LensSettings(aperture=1.8, focal_mm=35.0), 31)

    assert kernel.min() >= 0.0
    assert math.hypot(*centroid(kernel)) < 0.01
