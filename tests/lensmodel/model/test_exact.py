"""How far the fast paths of the regression are from sums over all samples."""

from __future__ import annotations

import itertools
import math
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, gaussian
from lensmodel.core.types import CHANNELS, FieldPosition, Kernel, LensSettings
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model import variables as va
from lensmodel.model.field import local_frame, splines
from lensmodel.model.field.index import SampleIndex
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.field.neighbourhood import Neighbourhood
from lensmodel.model.field.smoothers import NadarayaWatson

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
    settings = ModelSettings(method="nadaraya-watson", robust=False, mirror=0.0, r=0.05, phi=0.2)
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
    model = LensModel.fit([PsfSample(narrow, where, SETTINGS)], ModelSettings(method="nadaraya-watson"))

    turned = model.query(FieldPosition(0.5, 0.3 + math.pi / 4), SETTINGS, SIZE).kernel

    assert np.linalg.norm(turned - narrow) < 0.06 * np.linalg.norm(narrow)


def test_compiled_and_plain_sums_are_the_same_numbers() -> None:
    pytest.importorskip("numba")
    rng = np.random.default_rng(1)
    found = np.array([splines.coefficients(kernel) for kernel in rng.random((20, 9, 9))])
    radii = np.array([splines.light_radius(kernel) for kernel in found])
    count = 40
    arguments = (
        found.astype(np.float32).reshape(20, -1),
        radii,
        rng.integers(0, 20, count),
        rng.random(count),
        rng.normal(size=(count, 2, 2)),
        np.array([0, 15, 15, 40]),
        rng.normal(size=(3, 2)) * 0.3,
        13,
    )

    fast, plain = splines.sums(*arguments), splines.sums(*arguments, engine="scipy")

    assert np.abs(fast - plain).max() < 1e-6 * np.abs(plain).max()
    assert np.abs(plain).max() > 0


@pytest.mark.parametrize("count", [1, 7])
def test_compiled_and_plain_neighbours_are_the_same(count: int) -> None:
    pytest.importorskip("numba")
    rng = np.random.default_rng(6)
    where = np.array(
        [va.point(p, SETTINGS.with_channel(CHANNELS[i % 3])) for i, p in enumerate(places(300, 3))]
    )
    where[::5, 3] = np.nan  # some do not know their aperture
    votes = np.where(rng.random(300) < 0.2, 0.0, rng.random(300))
    scale = np.array([0.03, 0.2, 0.2, 0.5, 20.0, 0.25, 0.5])
    asked = [FieldPosition(0.0, 0.0), *places(count, 4)][-count:]

    def near(engine: splines.Engine) -> Answers:
        index = SampleIndex.of(where)
        return Neighbourhood(index, votes, scale, NadarayaWatson(), engine).near(asked, SETTINGS)

    fast, plain = near("auto"), near("scipy")

    assert np.array_equal(fast.starts, plain.starts)
    assert min(plain.counts) > 1
    for first, last in itertools.pairwise(plain.starts):
        mine, other = np.argsort(fast.rows[first:last]), np.argsort(plain.rows[first:last])
        assert np.array_equal(fast.rows[first:last][mine], plain.rows[first:last][other])
        assert fast.weights[first:last][mine] == pytest.approx(plain.weights[first:last][other], rel=1e-9)


def test_compiled_and_plain_removal_of_negatives_are_the_same() -> None:
    pytest.importorskip("numba")
    ripples = np.random.default_rng(9).normal(0.3, 1.0, (4, 9, 9))
    ripples[1] = np.abs(ripples[1])
    before = ripples.copy()

    plain = local_frame._without_negatives(ripples, "scipy")
    fast = local_frame._without_negatives(ripples.copy(), "auto")

    assert np.abs(fast - plain).max() < 1e-12
    assert plain.min() == 0.0
    assert fast.sum(axis=(1, 2)) == pytest.approx(before.sum(axis=(1, 2)))
    assert np.array_equal(fast[1], before[1])


@pytest.mark.parametrize("finer", [1, 2])
@pytest.mark.parametrize("engine", ["auto", "scipy"])
def test_spline_goes_through_the_pixels(finer: int, engine: splines.Engine) -> None:
    kernel = np.random.default_rng(2).random((11, 11))
    found = splines.coefficients(kernel, finer).astype(np.float32).reshape(1, -1)
    row, whole, at = np.zeros(1, dtype=np.intp), np.array([0, 1]), np.eye(2)[None] * finer

    read = splines.sums(
        found, np.full(1, 99.0), row, np.ones(1), at, whole, np.zeros((1, 2)), 11, engine=engine
    )

    assert np.abs(read[0] - kernel).max() < 1e-6


@pytest.mark.parametrize("method", ["nadaraya-watson", "combined"])
def test_many_places_at_once_are_the_same_as_one_by_one(samples: list[PsfSample], method: str) -> None:
    model, asked = LensModel.fit(samples[:144], ModelSettings(method=method)), places(9, 5)

    together = model.kernels(asked, SETTINGS, SIZE)

    for where, kernel in zip(asked, together, strict=True):
        alone = model.query(where, SETTINGS, SIZE).kernel
        assert np.abs(kernel - alone).max() < 1e-9


def test_a_sample_takes_25_bytes_a_pixel_and_joins_without_a_copy_of_the_others(
    samples: list[PsfSample],
) -> None:
    model = LensModel.fit(samples)
    pixels = SIZE * SIZE * len(samples)

    assert model.nbytes < 25 * pixels + 8 * 800 * SIZE * SIZE

    more = [replace(sample, photo="more") for sample in samples[:2]]

    tracemalloc.start()
    grown = model.added(more)
    size, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()

    assert size < 4 * pixels
    assert len(grown.samples) == len(samples) + 2
