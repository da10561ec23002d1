"""The methods that predict sharp edges and fit the kernel to them: what each of them recovers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import signal

from lab.blind.methods import compared
from lab.scenes import dead_leaves
from lensmodel.blind import PsfEstimator
from lensmodel.core.psf import as_kernel, centred, delta, distance, gaussian
from lensmodel.core.types import Kernel, NoiseModel, Plane

pytestmark = pytest.mark.slow  # a method to compare with, of the laboratory

SIGMA = 0.005
NOISE = NoiseModel.white(SIGMA)


@dataclass(frozen=True)
class Method:
    """A method, and how alike the truth its kernels of motion blur are at least."""

    estimator: PsfEstimator
    ncc: float

    def kernel(self, *patches: Plane, noise: NoiseModel = NOISE, size: int = 15) -> Kernel:
        return self.estimator.estimate(patches, [noise] * len(patches), size=size).kernel


@pytest.fixture(scope="module", params=[("cho-lee", 0.85), ("xu-jia", 0.75)], ids=lambda p: p[0])
def method(request: pytest.FixtureRequest) -> Method:
    name, ncc = request.param
    return Method(compared.create(name), ncc)


def shot(kernel: Kernel, *, side: int = 128, seed: int = 0, sigma: float = SIGMA) -> Plane:
    rng = np.random.default_rng(seed)
    scene = dead_leaves(side + kernel.shape[0] - 1, side + kernel.shape[0] - 1, rng, largest=40.0)[1]
    y = signal.fftconvolve(scene.astype(np.float64), kernel, mode="valid")
    return (y + rng.normal(0, sigma, y.shape)).astype(np.float32)


def stroke() -> Kernel:
    """A stroke with a corner: no symmetry that could hide a flip."""
    kernel = np.zeros((13, 13))
    kernel[3, 3:9] = 1.0
    kernel[3:10, 9] = np.linspace(1.0, 0.3, 7)
    return centred(signal.convolve(kernel, gaussian(3, 0.3 * np.eye(2)), mode="same"))


@pytest.fixture(scope="module")
def patch() -> Plane:
    return shot(stroke(), seed=1)


@pytest.fixture(scope="module")
def found(method: Method, patch: Plane) -> Kernel:
    return method.kernel(patch)


def test_a_bent_stroke_is_recovered_from_one_patch(method: Method, found: Kernel) -> None:
    assert distance(found, stroke()).ncc > method.ncc
    assert distance(found, as_kernel(stroke()[::-1, ::-1])).ncc < distance(found, stroke()).ncc
    assert distance(delta(15), stroke()).ncc < 0.5


def test_the_kernel_turns_with_the_patch(method: Method, patch: Plane, found: Kernel) -> None:
    turned = method.kernel(np.ascontiguousarray(np.rot90(patch)))

    # Forward differences lie half a pixel off the pixel, on the other side of it after a turn.
    assert distance(turned, np.rot90(found)).ncc > 0.95
