"""Each regression of the comparison keeps what those of the product keep."""

from __future__ import annotations

import math

import numpy as np
import pytest

from lensmodel.core.psf import PsfSample, centroid, distance, gaussian
from lensmodel.core.types import FieldPosition, Kernel, LensSettings
from lensmodel.lab.model.smoothers import COMPARED, make_known
from lensmodel.model import LensModel, ModelSettings, smoothers

SIZE = 21
GREEN = LensSettings(aperture=2.0)


def ring_kernel(position: FieldPosition) -> Kernel:
    """Gaussian, wide along v and growing outwards: the same on a ring, turned with phi."""
    c, s = math.cos(position.phi), math.sin(position.phi)
    u, v = np.array([-s, c]), np.array([-c, -s])  # (row, col)
    along, across = 0.8 + 1.2 * position.r**2, 1.0 + 2.0 * position.r**2
    return gaussian(SIZE, along**2 * np.outer(u, u) + across**2 * np.outer(v, v))


def places(count: int, seed: int) -> list[FieldPosition]:
    rng = np.random.default_rng(seed)
    r = np.sqrt(rng.uniform(0.0, 0.9, count))
    return [FieldPosition(float(a), float(p)) for a, p in zip(r, rng.uniform(-3, 3, count), strict=True)]


def fitted(method: str, photos: int) -> LensModel:
    make_known()
    samples = [
        PsfSample(ring_kernel(p), p, GREEN, photo=f"p{i}") for i in range(photos) for p in places(24, i)
    ]
    return LensModel.fit(samples, ModelSettings(method=method))


def test_the_names_join_those_of_the_product() -> None:
    make_known()

    assert set(smoothers) > set(COMPARED)


@pytest.mark.parametrize("method", sorted(COMPARED))
def test_answers_a_centred_kernel_of_sum_one(method: str) -> None:
    kernel = fitted(method, 1).query(FieldPosition(0.6, 1.0), GREEN, 33).kernel

    assert kernel.min() >= 0.0
    assert kernel.sum() == pytest.approx(1.0)
    assert np.hypot(*centroid(kernel)) < 2e-3


@pytest.mark.parametrize("method", sorted(COMPARED))
def test_follows_the_ring_family(method: str) -> None:
    model = fitted(method, 3)
    errors = [distance(model.query(p, GREEN, SIZE).kernel, ring_kernel(p)).rel_l2 for p in places(12, 99)]

    assert float(np.median(errors)) < 0.08


@pytest.mark.parametrize("method", ["transport", "transport-gaussian-process"])
def test_many_places_at_once_are_the_same_as_one_by_one(method: str) -> None:
    model, asked = fitted(method, 2), places(9, 5)

    together = model.kernels(asked, GREEN, SIZE)

    for where, kernel in zip(asked, together, strict=True):
        assert np.abs(kernel - model.query(where, GREEN, SIZE).kernel).max() < 1e-9
