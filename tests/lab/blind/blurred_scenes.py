"""Scenes blurred by a kernel that is known, for the tests of methods that estimate it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from lab.kernels import gaussian
from lab.scenes import dead_leaves
from lensmodel.core.psf import centred
from lensmodel.core.types import Kernel, Plane

SIGMA = 0.01
"""Standard deviation of the noise of `shot`."""

OVAL = gaussian(13, [[2.0, 0.8], [0.8, 1.2]])


def scene(side: int, seed: int = 0) -> NDArray[np.float64]:
    return dead_leaves(side, side, np.random.default_rng(seed), largest=40.0)[1].astype(np.float64)


def shot(kernel: Kernel, *, side: int = 128, seed: int = 0) -> Plane:
    """One channel of a scene behind a kernel, with noise."""
    y = signal.fftconvolve(scene(side + kernel.shape[0] - 1, seed), kernel, mode="valid")
    return (y + np.random.default_rng(seed).normal(0, SIGMA, y.shape)).astype(np.float32)


def stroke() -> Kernel:
    """A stroke with a corner: no symmetry that could hide a flip."""
    kernel = np.zeros((13, 13))
    kernel[3, 3:9] = 1.0
    kernel[3:10, 9] = np.linspace(1.0, 0.3, 7)
    return centred(signal.convolve(kernel, gaussian(3, 0.3 * np.eye(2)), mode="same"))
