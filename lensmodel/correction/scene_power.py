"""Power of natural scenes at each frequency, fitted to a part of a photo, and the linear estimate with it."""

from __future__ import annotations

import math
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.numerics import jit
from lensmodel.core.types import Planes
from lensmodel.correction.posterior import GRID
from lensmodel.correction.transforms import Complex, Real, to_spectrum

SLOPE = 2.2
"""Exponent of the power spectrum of natural images, S(f) = c |f|^-2.2: A. Torralba, A. Oliva, "Statistics of
natural image categories", Network 14, 2003, find 1.9 to 2.6 by category."""

_EDGES: Final = (0.05, 0.08, 0.12, 0.17, 0.24)
_MIDDLES: Final = np.sqrt(np.array(_EDGES[1:]) * _EDGES[:-1])
"""Rings of frequencies to which a scene's power is fitted, cycles/pixel: above them demosaicing has a part in
it (chosen)."""

_SLOPES: Final = (2.0, 5.0)
"""Least and greatest slope a: of sharp photographs of detail, and of what is out of focus (chosen)."""

_SOFT: Final = (3.0, 4.0)
"""Slopes between which a scene counts more and more as out of focus (chosen: detail in focus lies below)."""

_MOSAIC_NOISE: Final = np.array([[4.8, 4.0, 3.0, 2.0], [2.35, 2.2, 2.05, 1.75], [4.5, 3.7, 2.8, 1.9]])
"""Noise power of a developed mosaic's colours in each ring, over its variance (measured on an even area):
demosaicing spreads what few pixels saw, and would pass for detail in focus if it counted as white."""

_BLOCKS: Final = 3  # along each side of a tile: enough for a mean (chosen)


def scene_power(level: float, slope: float) -> Real:
    """Power of a scene on the `rfft2` grid of `GRID`, S = c |f|^-a with c and a of `scene_law`."""
    return np.asarray(level * np.exp(np.float32(-0.5 * slope) * _log_squared()), dtype=np.float32)


def softness(slope: float) -> float:
    """How far a scene of this slope is out of focus, 0 to 1."""
    return min(max((slope - _SOFT[0]) / (_SOFT[1] - _SOFT[0]), 0.0), 1.0)


def noise_power(variance: float, channel: int, *, mosaic: bool) -> NDArray[np.float64]:
    """Mean power of noise in each ring, of a colour of a developed mosaic or of full planes."""
    return variance * (_MOSAIC_NOISE[channel] if mosaic else np.ones(len(_MIDDLES)))


def scene_law(
    measured: NDArray[np.float64], transferred: NDArray[np.floating], noise: NDArray[np.float64]
) -> tuple[float, float]:
    """Power of the scene behind a blur, S = c |f|^-a, as c and a.

    Scaled so that white noise has its variance as power. c and a are fitted to rings of the photo's own
    spectrum that blur and demosaicing leave intact: a soft scene, or one without detail, has nothing that a
    correction could restore. `measured` and `noise` are mean powers of a part of the photo in each ring, of
    `ring_power` and `noise_power`; `transferred` is the expected |H|² of its blur, `(64, 33)`.
    """
    transmitted = _rings() @ transferred.ravel().astype(np.float64)
    power = np.maximum(measured - noise, 0.1 * noise + 1e-12) / np.maximum(transmitted, 1e-3)
    x, y = np.log(_MIDDLES), np.log(power)
    # rings with more noise than scene say little about the slope
    weight = 1.0 / (0.05 + (noise / np.maximum(measured, 1e-12)) ** 2)
    weight /= weight.sum()
    mean_x, mean_y = weight @ x, weight @ y
    slope = float(weight @ ((x - mean_x) * (y - mean_y)) / (weight @ (x - mean_x) ** 2))
    slope = min(max(-slope, _SLOPES[0]), _SLOPES[1])
    return math.exp(mean_y + slope * mean_x), slope


def ring_power(planes: Planes) -> NDArray[np.float64]:
    """Power of each plane in each ring, `(planes, blocks, rings)`; 1 for white noise of variance 1."""
    missing = [max(g - n, 0) for g, n in zip(GRID, planes.shape[1:], strict=True)]
    if any(missing):
        planes = np.pad(planes, [(0, 0), *((0, m) for m in missing)], "reflect")
    rows, cols = (
        np.linspace(0, n - g, min(max(n // g, 1), _BLOCKS)).astype(int)
        for n, g in zip(planes.shape[1:], GRID, strict=True)
    )
    power = np.empty((len(planes), len(rows) * len(cols), GRID[0], GRID[1] // 2 + 1), dtype=np.float32)
    _block_power(planes, rows, cols, _window(), power)
    rings = power.reshape(*power.shape[:2], -1) @ _rings().T.astype(np.float32)
    return np.asarray(rings / (GRID[0] * GRID[1]), dtype=np.float64)


@jit
def _block_power(
    planes: Planes, rows: NDArray[np.intp], cols: NDArray[np.intp], window: Real, power: Real
) -> None:
    """Power of windowed blocks of planes, less their means."""
    height, width = window.shape
    block, spectrum = np.empty((height, width), np.float32), np.empty((height, width // 2 + 1), np.complex64)
    for c in range(planes.shape[0]):
        for k, top in enumerate(rows):
            for l, left in enumerate(cols):
                into = power[c, k * len(cols) + l]
                block[:] = planes[c, top : top + height, left : left + width]
                block -= block.mean()
                block *= window
                to_spectrum(block, spectrum)
                for i in range(height):
                    for j in range(spectrum.shape[1]):
                        value = spectrum[i, j]
                        into[i, j] = value.real * value.real + value.imag * value.imag


@lru_cache(maxsize=1)
def _window() -> Real:
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in GRID))
    return np.asarray(window / np.sqrt(np.mean(window**2)), dtype=np.float32)


@lru_cache(maxsize=1)
def _log_squared() -> Real:
    """Logarithm of |f|² on the grid; the mean has no power."""
    squared = frequency_squared(GRID)
    squared[0, 0] = np.inf
    return np.log(squared)


@lru_cache(maxsize=1)
def _rings() -> NDArray[np.float64]:
    """Weights of each ring's frequencies, by how often the whole spectrum holds them; their sum is 1."""
    modulus, times = np.sqrt(frequency_squared(GRID)), frequency_counts(GRID)
    rings = [times * ((modulus >= low) & (modulus < high)) for low, high in pairwise(_EDGES)]
    return np.array([(ring / ring.sum()).ravel() for ring in rings])


def wiener_spectrum(data: Real, K: Complex, noise: float, variance: float) -> Complex:
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


def frequency_squared(shape: tuple[int, int]) -> Real:
    """|f|² on the `rfft2` grid, in (cycles/pixel)²; the value at zero is a tenth of the next."""
    squared = fft.fftfreq(shape[0])[:, None] ** 2 + fft.rfftfreq(shape[1])[None, :] ** 2
    squared[0, 0] = 0.1 * min(squared[0, 1], squared[1, 0])
    return squared.astype(np.float32)


@lru_cache(maxsize=8)
def prior(shape: tuple[int, int]) -> tuple[Real, Real]:
    """1 / S(f) for c = 1, and S(f) times `frequency_counts`."""
    decay = frequency_squared(shape) ** np.float32(SLOPE / 2)
    prior_power = frequency_counts(shape) / decay
    return decay, np.ascontiguousarray(prior_power, dtype=np.float32)


def frequency_counts(shape: tuple[int, int]) -> Real:
    """How often the whole spectrum holds each frequency of the half; the mean counts as none."""
    counts = np.full((shape[0], shape[1] // 2 + 1), 2.0, dtype=np.float32)
    counts[:, 0] = 1.0
    if shape[1] % 2 == 0:
        counts[:, -1] = 1.0
    counts[0, 0] = 0.0
    return counts
