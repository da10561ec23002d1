"""From the pupil of a point to its PSF on pixels, by a matrix Fourier transform.

The light on the sensor is the sum of plane waves, and its intensity is summed over wavelengths::

    E(x, y) = sum_LM A(L, M) exp(2 pi i (W(L, M) + L x + M y) / lambda)
    k(pixel) = integral over the pixel of sum_lambda s(lambda) |E(x, y)|^2

A matrix Fourier transform takes cosines straight to points near the light, so that neither has to fit
the other's grid (R. Soummer et al., Optics Express 15, 2007, eq. 1). |E|^2 holds no frequency beyond
the width of the pupil over lambda: points stand so close that hardly anything folds back into what a pixel
passes (twice as close, kernels at f/1.8 change by 0.2 to 0.6 percent), and their running sums, splined,
give the light in pixels that lie anywhere between.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from lab.traced.wave import TracedPupil
from lensmodel.core.psf import as_kernel, centroid
from lensmodel.core.types import Kernel

Array = NDArray[np.float64]

_WRAP_MARGIN: Final = 1.25  # period of the sum over cosines over the extent of the light
_SAMPLES: Final = (96, 512)  # across the pupil: enough for its edge; more than the widest blur needs
_CENTRED_PX: Final = 5e-4  # a thousandth moves no figure, as `lensmodel.core.psf` has it
_RECENTRINGS: Final = 10  # wide tails that the array cuts off pull its centre of mass step by step
_SPARE_PX: Final = 2  # the kernel may move by so much before the light is computed anew


def kernel_of(
    pupils: Sequence[tuple[TracedPupil, float, float]],
    radius: float,
    limits: tuple[float, ...],
    *,
    size: int,
    pitch_um: float,
    focus_um: float = 0.0,
    offset: tuple[float, float] = (0.0, 0.0),
) -> tuple[Kernel, tuple[float, float]]:
    """PSF of one object point in one colour channel.

    Parameters
    ----------
    pupils : sequence of (TracedPupil, wavelength_um, weight)
        All with the same reference point.
    radius, limits
        Of the stop and the rims, mm.
    size : int
        Odd side in pixels.
    pitch_um : float
        Pixel pitch.
    focus_um : float
        Sensor behind the traced plane.
    offset : tuple of float
        Where the centre of mass shall lie, (row, col) pixels from the middle one.

    Returns
    -------
    kernel : Kernel, shape (size, size)
    center : tuple of float
        Where that middle pixel lies from the reference point, (right, up) micrometres.
    """
    center, spread = _geometric(pupils, radius, limits, focus_um)
    for _ in range(_RECENTRINGS):
        fine, step = _intensity(pupils, radius, limits, size, pitch_um, focus_um, center, spread)
        kernel, shift = _on_pixels(fine, step, size, pitch_um, offset)
        center = (center[0] + shift[1] * pitch_um, center[1] - shift[0] * pitch_um)
        if max(abs(shift[0]), abs(shift[1])) < _SPARE_PX - 0.5:
            break
    return as_kernel(kernel), center


def transmission(pupil: TracedPupil, radius: float, limits: tuple[float, ...]) -> float:
    """Area in mm^2 of the light that enters and arrives."""
    step = 2.0 * max(pupil.half) / _SAMPLES[0]
    amplitude, _ = pupil.evaluate(*pupil.grid(step), radius, limits, 0.0)
    return float((amplitude**2).sum()) * step**2 / (pupil.half[0] * pupil.half[1])


def _geometric(
    pupils: Sequence[tuple[TracedPupil, float, float]],
    radius: float,
    limits: tuple[float, ...],
    focus_um: float,
) -> tuple[tuple[float, float], float]:
    """Median of the rays (right, up), near the core, and their largest distance from it, micrometres."""
    xs, ys, ws = [], [], []
    for pupil, _, weight in pupils:
        step = 2.0 * max(pupil.half) / 64
        amplitude, path = pupil.evaluate(*pupil.grid(step), radius, limits, focus_um)
        down, along = (np.asarray(g) for g in np.gradient(path, step))
        light = np.asarray(amplitude**2 > 0.1 * amplitude.max() ** 2)
        xs.append(-along[light])
        ys.append(-down[light])
        ws.append(amplitude[light] ** 2 * (weight / (amplitude[light] ** 2).sum()))
    x, y, w = np.concatenate(xs), np.concatenate(ys), np.concatenate(ws)
    center = _median(x, w), _median(y, w)
    return center, float(np.hypot(x - center[0], y - center[1]).max())


def _median(values: Array, weights: Array) -> float:
    order = np.argsort(values)
    share = np.cumsum(weights[order]) / weights.sum()
    return float(values[order][np.searchsorted(share, 0.5)])


def _intensity(
    pupils: Sequence[tuple[TracedPupil, float, float]],
    radius: float,
    limits: tuple[float, ...],
    size: int,
    pitch_um: float,
    focus_um: float,
    center: tuple[float, float],
    spread_um: float,
) -> tuple[Array, float]:
    """Light (row, col) at points around `center`, and their distance in micrometres."""
    widest = max(max(pupil.half) / wave for pupil, wave, _ in pupils)
    # |E|^2 reaches to `2 widest`; what folds back at this distance stays above two cycles a pixel
    per_pixel = math.ceil(2.0 * widest * pitch_um) + 2
    step = pitch_um / per_pixel
    count = (size + 2 * _SPARE_PX) * per_pixel
    x = (np.arange(count) - (count - 1) / 2.0) * step
    half_window = (size / 2.0 + _SPARE_PX) * pitch_um
    extent = max(2.0 * half_window, half_window + spread_um) * _WRAP_MARGIN
    total = np.zeros((count, count))
    for pupil, wave, weight in pupils:
        width = 2.0 * max(pupil.half)
        cosine_step = width / min(max(extent * width / wave, _SAMPLES[0]), _SAMPLES[1])
        L, M = pupil.grid(cosine_step)
        amplitude, path = pupil.evaluate(L, M, radius, limits, focus_um)
        angle = (path + center[0] * L[None, :] + center[1] * M[:, None]) / wave
        angle = (2.0 * np.pi) * (angle - np.rint(angle))
        field = (amplitude * np.exp(1j * angle)).astype(np.complex64)
        along_rows = np.exp(-2j * np.pi * np.outer(x, M) / wave).astype(np.complex64)  # rows grow downwards
        along_cols = np.exp(2j * np.pi * np.outer(L, x) / wave).astype(np.complex64)
        seen = along_rows @ field @ along_cols
        # Parseval: the whole light is that of the pupil times (wave / cosine step)^2
        norm = float((amplitude**2).sum()) * (wave / cosine_step) ** 2
        total += (weight * step**2 / norm) * (np.square(seen.real) + np.square(seen.imag))
    return total, step


def _on_pixels(
    fine: Array, step: float, size: int, pitch_um: float, offset: tuple[float, float]
) -> tuple[Array, tuple[float, float]]:
    """Sum into pixels so that the centre of mass lies at `offset`; also the shift (row, col) taken."""
    count = fine.shape[0]
    sums = np.zeros((count + 1, count + 1))
    sums[1:, 1:] = fine.cumsum(axis=0).cumsum(axis=1)
    spline = _spline(count)
    edges = (np.arange(size + 1) - size / 2.0) * pitch_um / step + count / 2.0
    shift = [-offset[0], -offset[1]]
    kernel = np.empty(0)
    limit = _SPARE_PX * 0.99
    for _ in range(8):
        rows, cols = (np.diff(spline(edges + s * pitch_um / step), axis=0) for s in shift)
        kernel = np.maximum(rows @ sums @ cols.T, 0.0)
        seen = centroid(kernel)
        error = (seen[0] - offset[0], seen[1] - offset[1])
        if math.hypot(*error) < _CENTRED_PX:
            break
        shift = [min(max(s + e, -limit), limit) for s, e in zip(shift, error, strict=True)]
    return kernel, (shift[0], shift[1])


@lru_cache(maxsize=8)
def _spline(count: int) -> CubicSpline:
    return CubicSpline(np.arange(count + 1.0), np.eye(count + 1), axis=0)
