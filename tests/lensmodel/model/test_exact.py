"""How far the fast paths of the regression are from sums over all samples."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import CHANNELS, FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings, loops, neighbours, splines
from lensmodel.model import variables as va
from lensmodel.model.answer import MODES
from lensmodel.model.neighbours import Neighbourhood

SIZE = 25
SETTINGS = LensSettings(aperture=2.8)


def shape(position: FieldPosition, turn: float = 0.0, narrow: float = 0.9) -> Kernel:
    """Gaussian, wide along v and growing outwards, as seen from a place `turn` further on its ring."""
    phi = position.phi + turn
    c, s = math.cos(phi), math.sin(phi)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col)
    along, across = narrow + 0.9 * position.r**2, narrow + 1.4 * position.r**2
    return gaussian(SIZE, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def places(count: int, seed: int) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    drawn = rng.uniform((0.0, -math.pi), (0.9, math.pi), (count, 2))
    return [FieldPosition(math.sqrt(float(r)), float(phi)) for r, phi in drawn]


@pytest.fixture(scope="module")
def samples() -> list[PsfSample]:
    return [
        PsfSample(shape(p), p, SETTINGS.with_channel(CHANNELS[i % 3]), photo=f"p{i // 24}")
        for i, p in enumerate(places(480, 0))
    ]


def weights_of_all(model: LensModel, where: FieldPosition) -> np.ndarray:
    """Gaussian weights of every sample, whatever its distance (eq. 4 and 7)."""
    points = va.points(model.samples)
    squared = va.squared_distances(points, va.point(where, SETTINGS), va.scales(model.bandwidth))
    weight = np.exp(-0.5 * (squared - squared.min()))
    return np.asarray(weight / weight.sum())


@pytest.fixture(scope="module")
def narrow(samples: list[PsfSample]) -> LensModel:
    """A model whose kernels reach no farther than the samples beside them."""
    settings = ModelSettings(mode="paper", r=0.05, phi=0.2)
    return LensModel.fit(samples, settings)


def test_samples_found_by_the_tree_give_the_sum_over_all_samples(narrow: LensModel) -> None:
    # the local frame: axes of the place itself, nothing turned towards the image
    all_of_them = narrow._regression.local.upright(np.arange(len(narrow.samples)))
    for where in places(12, 3):
        weight = weights_of_all(narrow, where)
        brute = np.tensordot(weight, all_of_them, axes=1)
        near = narrow._regression.near([where], SETTINGS)
        fast = np.tensordot(near.weights, all_of_them[near.rows], axes=1)

        assert np.linalg.norm(fast - brute) < 1e-5 * np.linalg.norm(brute)


def test_answer_is_the_sum_over_all_kernels_turned_by_formula(narrow: LensModel) -> None:
    for where in places(6, 3):
        turned = [shape(s.position, where.phi - s.position.phi) for s in narrow.samples]
        brute = np.tensordot(weights_of_all(narrow, where), np.array(turned), axes=1)
        fast = narrow.query(where, SETTINGS, SIZE).kernel

        assert np.abs(fast - brute).max() < 2e-3 * brute.max()


def test_kernel_of_half_a_pixel_nearly_keeps_its_shape_when_it_turns() -> None:
    where = FieldPosition(0.5, 0.3)
    narrow = gaussian(SIZE, np.eye(2) * 0.25)
    model = LensModel.fit([PsfSample(narrow, where, SETTINGS)], ModelSettings(mode="paper"))

    turned = model.query(FieldPosition(0.5, 0.3 + math.pi / 4), SETTINGS, SIZE).kernel

    assert np.linalg.norm(turned - narrow) < 0.06 * np.linalg.norm(narrow)


def test_trees_and_a_look_at_every_sample_give_the_same_neighbours(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(6)
    where = np.array(
        [va.point(p, SETTINGS.with_channel(CHANNELS[i % 3])) for i, p in enumerate(places(300, 3))]
    )
    where[::5, 3] = np.nan  # some do not know their aperture
    weights = np.where(rng.random(300) < 0.2, 0.0, rng.random(300))
    around = Neighbourhood(where, weights, np.array([0.03, 0.2, 0.2, 0.5, 20.0, 0.25, 0.5]))
    asked = [FieldPosition(0.0, 0.0), *places(7, 4)]

    every = around.near(asked, SETTINGS)
    monkeypatch.setattr(neighbours, "_MANY", 0)
    by_tree = around.near(asked, SETTINGS)

    assert min(every.counts) > 1
    assert np.array_equal(by_tree.starts, every.starts)
    assert np.array_equal(by_tree.rows, every.rows)
    assert by_tree.weights == pytest.approx(every.weights, rel=1e-12)


def test_values_without_negatives_keep_their_sum_and_those_without_any_stay() -> None:
    ripples = np.random.default_rng(9).normal(0.3, 1.0, (4, 81))
    ripples[1] = np.abs(ripples[1])
    after = ripples.copy()

    loops.without_negatives(after)

    assert after.min() == 0.0
    assert after.sum(axis=1) == pytest.approx(ripples.sum(axis=1))
    assert np.array_equal(after[1], ripples[1])
    lowered = (ripples - after)[0][after[0] > 0.0]  # the nearest such values are lower by one amount
    assert lowered == pytest.approx(np.full(len(lowered), lowered[0]))


@pytest.mark.parametrize("finer", [1, 2])
def test_spline_goes_through_the_pixels(finer: int) -> None:
    kernel = np.random.default_rng(2).random((11, 11))
    stored = splines.coefficients(kernel, finer).astype(np.float32).reshape(1, -1)
    row, whole, at = np.zeros(1, dtype=np.intp), np.array([0, 1]), np.eye(2)[None] * finer
    read = np.zeros((1, 11, 11))

    loops.sums(stored, np.full(1, 99.0), row, np.ones(1), at, whole, np.zeros((1, 2)), read)

    assert np.abs(read[0] - kernel).max() < 1e-6


@pytest.mark.parametrize("mode", MODES)
def test_many_places_at_once_are_the_same_as_one_by_one(samples: list[PsfSample], mode: str) -> None:
    model, asked = LensModel.fit(samples[:144], ModelSettings(mode=mode)), places(9, 5)

    together = model.kernels(asked, SETTINGS, SIZE)

    for where, kernel in zip(asked, together, strict=True):
        alone = model.query(where, SETTINGS, SIZE).kernel
        assert np.abs(kernel - alone).max() < 1e-9


def test_a_sample_takes_25_bytes_a_pixel(samples: list[PsfSample]) -> None:
    assert LensModel.fit(samples).nbytes < 25 * SIZE * SIZE * len(samples) + 8 * 800 * SIZE * SIZE
