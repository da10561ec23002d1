"""Kernels that are made up, and how far two are apart."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import scipy

from lensmodel.core.psf import as_kernel, correlation_peak, whole_peak
from lensmodel.core.types import Kernel


def gaussian(size: int, covariance: npt.ArrayLike) -> Kernel:
    """Gaussian kernel of a covariance in px², axes (row, col), integrated over the pixel: 5 x 5 samples."""
    over = 5
    cov = np.asarray(covariance, dtype=np.float64) + np.eye(2) * 1e-4
    t = (np.arange(size * over) - size * over // 2) / over
    inverse = np.linalg.inv(cov)
    rows, cols = t[:, None], t[None, :]
    power = inverse[0, 0] * rows**2 + 2 * inverse[0, 1] * rows * cols + inverse[1, 1] * cols**2
    fine = np.exp(-0.5 * power)
    return as_kernel(fine.reshape(size, over, size, over).sum(axis=(1, 3)))


class KernelDistance(NamedTuple):
    """How far one kernel is from another after the best sub-pixel shift."""

    ncc: float  # normalised cross-correlation; 1 for equal shapes
    rel_l2: float  # |a - b| / |b|
    mtf_rmse: float  # root mean square difference of the moduli for |f| <= 0.5 cycles/pixel
    shift: tuple[float, float]  # the shift `(row, col)` in pixels that was applied to `a`


def distance(a: npt.NDArray[np.float64], b: npt.NDArray[np.float64]) -> KernelDistance:
    """Compare kernel `a` with the reference `b` by the peak c of their correlation, both normalised.

    By Parseval, ncc = c / (|a| |b|) and rel_l2² = (|a|² + |b|² - 2 c) / |b|².
    """
    a, b = a / a.sum(), b / b.sum()
    n = int(scipy.fft.next_fast_len(2 * max(a.shape[0], b.shape[0]), real=True))
    fa, fb = _centred_fft(a, n), _centred_fft(b, n)
    cross = fa * np.conj(fb)
    peak, c = correlation_peak(cross, whole_peak(cross))
    aa, bb = float((a * a).sum()), float((b * b).sum())
    freq = scipy.fft.fftfreq(n)
    inside = np.hypot(freq[:, None], freq[None, :]) <= 0.5
    mtf_rmse = float(np.sqrt(np.mean((np.abs(fa) - np.abs(fb))[inside] ** 2)))
    rel_l2 = math.sqrt(max(aa + bb - 2 * c, 0.0) / bb)
    return KernelDistance(c / math.sqrt(aa * bb), rel_l2, mtf_rmse, (-peak[0], -peak[1]))


def _centred_fft(kernel: npt.NDArray[np.float64], n: int) -> npt.NDArray[np.complex128]:
    half = kernel.shape[0] // 2
    grid = np.zeros((n, n))
    grid[: kernel.shape[0], : kernel.shape[1]] = kernel
    return scipy.fft.fft2(np.roll(grid, (-half, -half), axis=(0, 1)))
