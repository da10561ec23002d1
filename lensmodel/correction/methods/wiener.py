"""The spectrum of natural images, and the linear estimate with it."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

SLOPE = 2.2
"""Exponent of the power spectrum of natural images, S(f) = c |f|^-2.2: A. Torralba, A. Oliva, "Statistics of
natural image categories", Network 14, 2003, find 1.9 to 2.6 by category."""


def wiener_spectrum(
    data: NDArray[np.float32], K: NDArray[np.complex64], noise: float, variance: float
) -> NDArray[np.complex64]:
    """Spectrum of the Wiener estimate on a periodic canvas, given the variances of noise and data.

    In the Fourier domain::

        X = conj(K) Y / ( |K|² + var / S(f) ),   S(f) = c |f|^-2.2

    where c is fitted so that the blurred prior has the variance of the data.
    """
    power = K.real**2 + K.imag**2
    decay, prior_power = prior((data.shape[0], data.shape[1]))
    blurred_prior = float(np.vdot(prior_power, power))
    scale = max(variance - noise, 0.005 * variance + 1e-12) / blurred_prior
    ratio = np.float32(noise / (scale * data.size)) * decay
    ratio[0, 0] = 0.0  # the mean is kept
    return np.asarray(fft.rfft2(data) * np.conj(K) / (power + ratio + np.float32(1e-9)))


def frequency_squared(shape: tuple[int, int]) -> NDArray[np.float32]:
    """|f|² on the `rfft2` grid, in (cycles/pixel)²; the value at zero is a tenth of the next."""
    squared = fft.fftfreq(shape[0])[:, None] ** 2 + fft.rfftfreq(shape[1])[None, :] ** 2
    squared[0, 0] = 0.1 * min(squared[0, 1], squared[1, 0])
    return squared.astype(np.float32)


@lru_cache(maxsize=8)
def prior(shape: tuple[int, int]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """1 / S(f) for c = 1, and S(f) times `frequency_counts`."""
    decay = frequency_squared(shape) ** np.float32(SLOPE / 2)
    prior_power = frequency_counts(shape) / decay
    decay.setflags(write=False)
    return decay, np.ascontiguousarray(prior_power, dtype=np.float32)


def frequency_counts(shape: tuple[int, int]) -> NDArray[np.float32]:
    """How often the whole spectrum holds each frequency of the half; the mean counts as none."""
    counts = np.full((shape[0], shape[1] // 2 + 1), 2.0, dtype=np.float32)
    counts[:, 0] = 1.0
    if shape[1] % 2 == 0:
        counts[:, -1] = 1.0
    counts[0, 0] = 0.0
    return counts
