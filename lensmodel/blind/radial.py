"""The MTF of a kernel averaged over directions, and kernels that are given another one."""

from __future__ import annotations

import itertools
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.psf import as_kernel, otf
from lensmodel.types import Kernel

_GRID = 64
_EDGES = np.array([0.03, 0.08, 0.13, 0.18, 0.23, 0.28, 0.33, 0.38, 0.43, 0.5])
_FAINTEST = 0.01

Floats = NDArray[np.float64]


@lru_cache(maxsize=1)
def _rings() -> tuple[Floats, tuple[NDArray[np.bool_], ...]]:
    modulus = np.hypot(fft.fftfreq(_GRID)[:, None], fft.rfftfreq(_GRID)[None, :])
    return modulus, tuple((modulus > low) & (modulus <= high) for low, high in itertools.pairwise(_EDGES))


def radial_mtf(kernel: Kernel) -> Floats:
    """Root mean square of the transfer function over nine rings from 0.03 to 0.5 cycles/px."""
    power = np.abs(otf(kernel, (_GRID, _GRID))) ** 2
    return np.array([float(np.sqrt(power[ring].mean())) for ring in _rings()[1]])


def with_radial_mtf(kernel: Kernel, wanted: Floats) -> Kernel:
    """Give a kernel the radial MTF `wanted`; direction and phase stay its own.

    What becomes negative, or fainter than a hundredth of the peak, is cut off, so that the result
    has the wanted MTF nearly, not exactly.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
        k at most 63.
    wanted : ndarray, shape (9,)
        As `radial_mtf` gives.
    """
    side = kernel.shape[0]
    half = side // 2
    ratio = np.clip(np.log(wanted / radial_mtf(kernel)), -2.0, 2.0)
    middle = np.concatenate([[0.0], (_EDGES[:-1] + _EDGES[1:]) / 2.0])
    gain = np.exp(np.interp(_rings()[0], middle, np.concatenate([[0.0], ratio])))
    changed = fft.irfft2(otf(kernel, (_GRID, _GRID)) * gain, (_GRID, _GRID))
    changed = np.roll(changed, (half, half), (0, 1))[:side, :side]
    changed = np.where(changed > _FAINTEST * changed.max(), changed, 0.0)
    return as_kernel(changed)
