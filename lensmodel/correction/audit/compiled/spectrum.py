"""Power in overlapping windows, compiled; see `lensmodel.correction.audit.spectrum`."""

from __future__ import annotations

import numpy as np
import rocket_fft
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import FORWARD, Real

Index = NDArray[np.int64]


@jit
def _power(planes: Real, top: int, hop: int, taper: Real, work: Real, power: Real) -> None:
    """Power spectra of a row of windows of each plane, less their means, under a taper."""
    count, side = work.shape[1], taper.shape[0]
    share = np.float32(1.0 / (side * side))
    for plane in range(planes.shape[0]):
        for n in range(count):
            window = planes[plane, top : top + side, n * hop : n * hop + side]
            total = np.float32(0.0)
            for i in range(side):
                for j in range(side):
                    total += window[i, j]
            mean = share * total
            for i in range(side):
                for j in range(side):
                    work[plane, n, i, j] = (window[i, j] - mean) * taper[i, j]
    half = side // 2 + 1
    spectra = np.empty((planes.shape[0], count, side, half), np.complex64)
    rocket_fft.r2c(work, spectra, np.array([3]), FORWARD, 1.0, 1)
    rocket_fft.c2c(spectra, spectra, np.array([2]), FORWARD, 1.0, 1)
    values = spectra.reshape(planes.shape[0], count, side * half)
    for plane in range(planes.shape[0]):
        for n in range(count):
            for k in range(side * half):
                value = values[plane, n, k]
                power[plane, n, k] = value.real * value.real + value.imag * value.imag


@jit
def _level(power: Real, noise: float) -> float:
    """Geometric mean of power and noise over some frequencies; a logarithm for eight of them."""
    total, product = 0.0, 1.0
    for k in range(power.size):
        product *= max(np.float64(power[k]) + noise, 1e-20)
        if k % 8 == 7:
            total += np.log(product)
            product = 1.0
    return float(np.exp((total + np.log(product)) / power.size))


@jit
def powers(
    planes: Real,
    hop: int,
    taper: Real,
    order: Index,
    starts: Index,
    edge: Index,
    noise: Real,
    bands: Real,
    line: Real,
) -> None:
    """Mean power of photo and result in bands, and how far lines stand out that the photo has not.

    Parameters
    ----------
    planes : ndarray of float32, shape (2, rows, cols)
        Photo and result, whole windows.
    hop : int
        Pixels from one window to the next.
    taper : ndarray of float32, shape (side, side)
        Weight of each pixel.
    order, starts : ndarray of int
        Frequencies band by band, and where each band begins; the last start is the end.
    edge : ndarray of int
        Frequencies among which lines are looked for.
    noise : ndarray of float32, shape (down, across)
        Power of the noise.
    bands : ndarray of float32, shape (2, bands, down, across)
        Mean power in each band.
    line : ndarray of float32, shape (down, across)
        Power of the largest line over its band, and over what it is in the photo.
    """
    side, (down, across) = taper.shape[0], line.shape
    work = np.empty((2, across, side, side), np.float32)
    power = np.empty((2, across, side * (side // 2 + 1)), np.float32)
    near_limit, unit = np.empty((2, edge.size), np.float32), np.float32(1.0)
    for i in range(down):
        _power(planes, i * hop, hop, taper, work, power)
        for j in range(across):
            for which in range(2):
                window_power = power[which, j]
                for band in range(starts.size - 1):
                    total = np.float32(0.0)
                    for k in range(starts[band], starts[band + 1]):
                        total += window_power[order[k]]
                    bands[which, band, i, j] = total / np.float32(starts[band + 1] - starts[band])
                for k in range(edge.size):
                    near_limit[which, k] = window_power[edge[k]]
            was = np.float32(1.0 / _level(near_limit[0], noise[i, j]))
            now = np.float32(1.0 / _level(near_limit[1], noise[i, j]))
            most = np.float32(0.0)
            for k in range(edge.size):
                most = max(most, now * near_limit[1, k] / max(was * near_limit[0, k], unit))
            line[i, j] = most
