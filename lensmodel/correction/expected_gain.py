"""Expected gain of a correction, and its plan: which share of each kernel gains most in a cell.

The power of the scene at each frequency is fitted to a part of the photo.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.numerics import jit
from lensmodel.core.psf import delta
from lensmodel.core.types import Planes, Zone
from lensmodel.correction.blur import ONE, ZERO, Complex, Number, Real, UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.posterior import GRID, WIDEST, PsfPosterior

SLOPE = 2.2
"""Exponent of the power spectrum of natural images, S(f) = c |f|^-2.2: A. Torralba, A. Oliva, "Statistics of
natural image categories", Network 14, 2003, find 1.9 to 2.6 by category."""

_EDGES: Final = (0.05, 0.08, 0.12, 0.17, 0.24)
_MIDDLES: Final = np.sqrt(np.array(_EDGES[1:]) * _EDGES[:-1])
"""Rings of frequencies that scenes are fitted to, cycles/pixel: above, demosaicing has a part (chosen)."""

_SLOPES: Final = (2.0, 5.0)  # of sharp detail, and of what is out of focus (chosen)

_SOFT: Final = (3.0, 4.0)
"""Slopes between which a scene counts more and more as out of focus (chosen: detail in focus lies below)."""

_MOSAIC_NOISE: Final = np.array([[4.8, 4.0, 3.0, 2.0], [2.35, 2.2, 2.05, 1.75], [4.5, 3.7, 2.8, 1.9]])
"""Noise power of a developed mosaic's colours in each ring, over its variance (measured on an even area):
demosaicing spreads what few pixels saw, and would pass for detail in focus if it counted as white."""

_BLOCKS: Final = 3  # along each side of a tile: enough for a mean (chosen)


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
    blocks = np.stack([planes[:, i : i + GRID[0], j : j + GRID[1]] for i in rows for j in cols], axis=1)
    spectra = fft.rfft2((blocks - blocks.mean(axis=(2, 3), keepdims=True)) * _window())
    power = spectra.real**2 + spectra.imag**2
    rings = power.reshape(*power.shape[:2], -1) @ _rings().T.astype(np.float32)
    return np.asarray(rings / (GRID[0] * GRID[1]), dtype=np.float64)


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


WORTH_DB: Final = 0.1  # expected gain below which a place is left as it is: not seen (chosen)

_SHARES: Final = np.array([1.0, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.35, 0.2, 0.1, 0.0], dtype=np.float32)
"""Shares of a kernel to try, the last if all others may harm; finer steps change the error by a hundredth."""

_SHARPER: Final = 3.0  # sigmas of width tried out of focus (chosen: with 2, twice as many such blocks lose)

_LEAST: Final = 1e-30  # keeps divisions finite, far below any power
_EVERY: Final = 3  # of the rows and columns suffices for a mean; odd, to meet all colours of a mosaic
_MOST: Final = 0.7  # of a mosaic's error that a change is credited with (chosen: none takes all of it away)


@dataclass(frozen=True, slots=True)
class CellForecast:
    """Expected squared error of one cell before and after, and how sure its PSF is."""

    zone: Zone
    before: float
    after: float
    psf_error: float

    @property
    def gain_db(self) -> float:
        """Expected gain in decibels; 0 where there is nothing."""
        there = self.after > 0.0 and self.before > 0.0
        return 10.0 * math.log10(self.before / self.after) if there else 0.0

    def changed(
        self, photo: Planes, solution: Planes, result: Planes, *, mosaic: bool, least: float = WORTH_DB
    ) -> CellForecast | None:
        """The forecast of a cell whose `solution` became `result` after limit and audit.

        The error of a posterior mean is orthogonal to it, so the error falls by the mean square of the
        change: by as large a share of what is forecast as is left of the solution's. A mosaic determines less
        than full planes do, for which the forecast is made: there the change itself counts. None where the
        change is so small that the error cannot have fallen by `least` decibels.
        """
        scale = GRID[0] * GRID[1] / photo[0].size
        change, made = (
            scale * float(np.square(planes - photo).sum(dtype=np.float64)) for planes in (result, solution)
        )
        if change < (1.0 - 10.0 ** (-0.1 * least)) * self.before:
            return None
        if mosaic:
            return replace(self, after=(1.0 - min(change / self.before, _MOST)) * self.before)
        return self.weakened(min(change / made, 1.0) if made > 0.0 else 0.0)

    def weakened(self, share: float) -> CellForecast:
        """The forecast where only this share of the error that was to fall does."""
        return replace(self, after=self.before - share * (self.before - self.after))


@dataclass(frozen=True, slots=True)
class Plan:
    """The share of each channel's kernel to use in a cell (the rest is a point), and the expected error.

    `softness` says how far the scene is out of focus, 0 to 1.
    """

    shares: tuple[float, ...]
    forecast: CellForecast
    softness: float


def plan(
    zone: Zone,
    tile: Planes,
    posteriors: Sequence[PsfPosterior],
    offsets: Sequence[tuple[float, float]],
    sensors: Sequence[Sensor],
    returned: float = 0.0,
) -> Plan:
    """Choose the share of each kernel that leaves the least expected error in this scene.

    With the scene's power S, the noise n, the mean K and the variance D of the transfer function, the share s
    of the kernel (the rest is a point), and the part t of the unexplained residual that is added back
    (in `whole_photo`)::

        K_s = s K + (1 - s),    W = K_s* S / (|K_s|² S + n),    G = W + t (1 - K_s W)
        before = sum_f S ( |1 - K|² + D ) + n,    after = sum_f S ( |1 - G K|² + |G|² D ) + |G|² n

    Detail in focus gains at many frequencies, at which a kernel errs this way and that. What is out of focus
    gains at a few low ones, and is lost there altogether if the kernel is too wide. There no share is taken
    that would do harm if the true kernel were narrower by z standard deviations w of ln |K|, short of a
    point, less noise counting as no gain; if all would, s is 0. Nothing fine is there but grain, so t fills
    up what W leaves of it::

        H = K |K|^-min( z w, 1 ),    t ( 1 - min( |W|², 1 ) )

    `offsets` are the lateral shifts of the channels, `(row, col)` in pixels; `returned` is t.
    """
    rings = ring_power(tile).mean(axis=1)
    scenes = []
    for c, (posterior, sensor) in enumerate(zip(posteriors, sensors, strict=True)):
        point = UniformBlur(delta(1), offsets[c]).spectrum(GRID)
        known = posterior.kernel.shape[0] <= WIDEST
        K = UniformBlur(posterior.kernel, offsets[c]).spectrum(GRID) if known else point
        noise = float(sensor.variance(tile[c, ::_EVERY, ::_EVERY].mean()))
        seen = noise_power(noise, c, mosaic=sensor.measured is not None)
        law = scene_law(rings[c], K.real**2 + K.imag**2 + posterior.variance, seen)
        scenes.append((K, point, posterior, noise, *law))
    slope = float(np.median([slope for *_, slope in scenes]))
    soft = min(max((slope - _SOFT[0]) / (_SOFT[1] - _SOFT[0]), 0.0), 1.0)
    before = after = 0.0
    shares: list[float] = []
    for K, point, posterior, noise, level, slope in scenes:
        S = level * np.exp(np.float32(-0.5 * slope) * _log_squared())
        D, times = posterior.variance, frequency_counts(GRID)
        narrower = np.float32(min(_SHARPER * soft * posterior.width_error, 1.0))
        H = K * np.clip(np.abs(K), np.float32(1e-6), ONE) ** -narrower if soft > 0.0 else K
        before += float((times * (S * (np.abs(ONE - K) ** 2 + D) + noise)).sum(dtype=np.float64))
        scalars = (np.float32(value) for value in (noise, returned, soft))
        left, harm = _remaining(K, H, point, S, D, times, *scalars)
        harmless = (harm <= 0.0) | (soft == 0.0)
        harmless[-1] = not harmless[:-1].any()  # by a point only noise is taken
        best = int(np.argmin(np.where(harmless, left, np.inf)))
        shares.append(float(_SHARES[best]))
        after += float(left[best])
    error = float(np.mean([posterior.error for posterior in posteriors]))
    forecast = CellForecast(zone, before, after, error)
    return Plan(tuple(shares), forecast, soft)


@jit
def _power(z: Number) -> Number:
    """|z|²."""
    return z.real * z.real + z.imag * z.imag


@jit
def _remaining(
    K: Complex, H: Complex, point: Complex, S: Real, D: Real, times: Real, n: Number, t: Number, soft: Number
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Squared error that each share of a kernel should leave, and its rise if H is true; see `plan`."""
    left, harm = np.zeros(_SHARES.size), np.zeros(_SHARES.size)
    for number in range(_SHARES.size):
        share = _SHARES[number]
        for i in range(K.shape[0]):
            part, rise = ZERO, ZERO
            for j in range(K.shape[1]):
                k, s = share * K[i, j] + (ONE - share) * point[i, j], S[i, j]
                power = _power(k)
                weight = s / max(s * power + n, np.float32(_LEAST))
                back = t * (ONE - soft * min(power * weight * weight, ONE))
                G = np.conj(k) * weight + back * (ONE - power * weight)
                kept = _power(G)
                part += times[i, j] * (s * (_power(ONE - G * K[i, j]) + kept * D[i, j]) + kept * n)
                change = _power(ONE - G * H[i, j]) - _power(ONE - H[i, j])
                rise += times[i, j] * (s * change + max(kept - ONE, ZERO) * n)
            left[number] += part
            harm[number] += rise
    return left, harm
