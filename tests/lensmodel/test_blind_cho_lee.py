from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy import signal

from lensmodel.blind.cho_lee import ChoLee
from lensmodel.psf import as_kernel, centred, delta, distance, gaussian, resized
from lensmodel.simulate import dead_leaves, load_scene
from lensmodel.types import Kernel, NoiseModel, Plane

SIGMA = 0.005
NOISE = NoiseModel.white(SIGMA)
DATA = Path(__file__).parent / "data" / "levin09.npz"


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


def test_a_bent_stroke_is_recovered_from_one_patch() -> None:
    found = ChoLee().estimate([shot(stroke(), seed=1)], [NOISE], size=15)

    assert distance(found.kernel, stroke()).ncc > 0.85
    assert distance(found.kernel, as_kernel(stroke()[::-1, ::-1])).ncc < distance(found.kernel, stroke()).ncc
    assert distance(delta(15), stroke()).ncc < 0.5


def test_sharp_patches_give_a_kernel_like_a_point() -> None:
    found = ChoLee().estimate([shot(delta(3), sigma=0.0)], [NoiseModel.white(0.0)], size=11)

    assert distance(found.kernel, delta(11)).ncc > 0.8


def test_the_kernel_turns_with_the_patch() -> None:
    y = shot(stroke(), seed=1)

    straight = ChoLee().estimate([y], [NOISE], size=15).kernel
    turned = ChoLee().estimate([np.ascontiguousarray(np.rot90(y))], [NOISE], size=15).kernel

    # Forward differences lie half a pixel off the pixel, on the other side of it after a turn.
    assert distance(turned, np.rot90(straight)).ncc > 0.95


def test_affine_change_of_intensity_changes_little() -> None:
    y = shot(stroke(), seed=1)

    plain = ChoLee().estimate([y], [NOISE], size=15).kernel
    other = ChoLee().estimate([0.5 * y + np.float32(0.1)], [NoiseModel.white(0.5 * SIGMA)], size=15).kernel

    assert distance(other, plain).ncc > 0.999


def test_patches_of_different_shape_share_one_kernel() -> None:
    patches = [shot(stroke(), seed=1), shot(stroke(), seed=2, side=112)]

    found = ChoLee().estimate(patches, [NOISE] * 2, size=15)

    assert distance(found.kernel, stroke()).ncc > 0.85


@pytest.mark.slow
def test_motion_blur_is_recovered_from_a_photo(shared_data: Path) -> None:
    photo = load_scene(shared_data / "sharp" / "s11_coast_structure.png")[1]
    scores = []
    for number in range(8):
        truth = levin(number)
        half = truth.shape[0] // 2
        scene = photo[372 - half : 628 + half, 622 - half : 878 + half].astype(np.float64)
        y = signal.fftconvolve(np.minimum(scene / np.quantile(scene, 0.995) * 0.9, 1.0), truth, mode="valid")
        y = (y + np.random.default_rng(0).normal(0, SIGMA, y.shape)).astype(np.float32)
        found = ChoLee().estimate([y], [NOISE], size=truth.shape[0])
        scores.append(distance(found.kernel, truth).ncc)

    assert np.median(scores) > 0.85
    assert min(scores) > 0.6
