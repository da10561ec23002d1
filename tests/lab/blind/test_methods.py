"""What every method that is compared with recovers of a kernel that is known."""

from __future__ import annotations

import numpy as np
import pytest
from blurred_scenes import SIGMA, shot, stroke

from lab.blind.methods import BlindMethod, compared
from lab.kernels import distance
from lensmodel.blind import estimators
from lensmodel.core.psf import as_kernel, delta
from lensmodel.core.types import Kernel, NoiseModel, Plane

pytestmark = pytest.mark.slow

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
