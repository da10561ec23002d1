"""The methods that predict sharp edges and fit the kernel to them: what each of them recovers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from lab.blind.methods import compared
from lab.scenes import dead_leaves
from lensmodel.core.psf import as_kernel, centred, delta, distance, gaussian, resized
from lensmodel.core.types import Kernel, NoiseModel, Plane
from lensmodel.estimation import PsfEstimator
from lensmodel.simulate import load_scene

pytestmark = pytest.mark.slow  # a method to compare with, of the laboratory

SIGMA = 0.005
NOISE = NoiseModel.white(SIGMA)
DATA = Path(__file__).parents[2] / "lensmodel" / "data" / "levin09.npz"


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


def levin(number: int) -> Kernel:
    with np.load(DATA, allow_pickle=False) as stored:
        kernel = as_kernel(stored[f"k{number}"])
    return resized(centred(resized(kernel, kernel.shape[0] + 4)), kernel.shape[0])


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


def test_sharp_patches_give_a_kernel_like_a_point(method: Method) -> None:
    sharp = method.kernel(shot(delta(3), sigma=0.0), noise=NoiseModel.white(0.0), size=11)

    assert distance(sharp, delta(11)).ncc > 0.8


def test_the_kernel_turns_with_the_patch(method: Method, patch: Plane, found: Kernel) -> None:
    turned = method.kernel(np.ascontiguousarray(np.rot90(patch)))

    # Forward differences lie half a pixel off the pixel, on the other side of it after a turn.
    assert distance(turned, np.rot90(found)).ncc > 0.95


def test_affine_change_of_intensity_changes_little(method: Method, patch: Plane, found: Kernel) -> None:
    other = method.kernel(0.5 * patch + np.float32(0.1), noise=NoiseModel.white(0.5 * SIGMA))

    assert distance(other, found).ncc > 0.999


def test_patches_of_different_shape_share_one_kernel(method: Method, patch: Plane) -> None:
    shared = method.kernel(patch, shot(stroke(), seed=2, side=112))

    assert distance(shared, stroke()).ncc > method.ncc


@pytest.mark.slow
def test_motion_blur_is_recovered_from_a_photo(method: Method, shared_data: Path) -> None:
    photo = load_scene(shared_data / "sharp" / "s11_coast_structure.png")[1]
    scores = []
    for number in range(8):
        truth = levin(number)
        half = truth.shape[0] // 2
        scene = photo[372 - half : 628 + half, 622 - half : 878 + half].astype(np.float64)
        y = signal.fftconvolve(np.minimum(scene / np.quantile(scene, 0.995) * 0.9, 1.0), truth, mode="valid")
        y = (y + np.random.default_rng(0).normal(0, SIGMA, y.shape)).astype(np.float32)
        scores.append(distance(method.kernel(y, size=truth.shape[0]), truth).ncc)

    assert np.median(scores) > method.ncc
    assert min(scores) > 0.6
