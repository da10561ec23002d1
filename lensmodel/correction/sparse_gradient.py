"""Noise-aware MAP restoration with a sparse-gradient prior, three colours together.

Half-quadratic splitting: gradients shrunk towards zero, then planes solved for, in turns.
D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors", NIPS 2009, eq. 3 to 5.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.types import CHANNELS, Plane, Planes
from lensmodel.correction.blur import (
    BLOCK,
    ONE,
    ZERO,
    Canvas,
    Complex,
    Number,
    Real,
    UniformBlur,
    block_sums,
    interpolated,
    to_plane,
    to_spectrum,
    transfers,
)
from lensmodel.correction.deconvolver import Sensor, Solution
from lensmodel.correction.expected_gain import prior, wiener_spectrum
from lensmodel.correction.mosaic import refill, spread_grain
from lensmodel.correction.richardson_lucy import Lights, fill_canvas

_DEGREE: Final = 9  # of the polynomial: a shorter one misses the bend at the jump (chosen)
_LARGEST: Final = 24.0  # argument, in widths of the shrinkage: beyond, hardly anything is taken off (chosen)
_REACH: Final = np.float32(1.0 / _LARGEST)
_RAMP: Final = 0.1
"""Share of the jump over which the answer rises (chosen: with none, rounding makes visible pixels)."""


Prox = tuple[Number, Number, Real]
"""1 / v where the answer of `shrinkage` begins to rise, slope of the ramp that begins there per 1 / v, and
coefficients of p, highest power first."""


@lru_cache(maxsize=16)  # one fit per exponent, not one per tile
def shrinkage(alpha: float) -> Prox:
    """The minimiser of t |w|^alpha + (w - v)² / 2, by one polynomial for all t.

    With s = t^(1 / (2 - alpha)) the substitution w = s u leaves t = 1::

        prox_t(v) = s prox_1(v / s),      prox_1(v) = v - p(1 / v)  beyond the jump, else 0

    What is subtracted from v is smooth in 1 / v, so a short polynomial p, fitted to the answers of Newton
    steps, suffices: unlike a table it runs in vector registers. Beyond 24 s the subtraction is held constant.
    """
    if not 0.0 < alpha <= 1.0:
        raise InvalidInputError(f"alpha must lie in (0, 1], got {alpha}")
    # Where the energies of w = 0 and of the other minimum are equal the answer jumps.
    jump_w = (2.0 * (1.0 - alpha)) ** (1.0 / (2.0 - alpha))
    jump = jump_w + alpha * jump_w ** (alpha - 1.0) if alpha < 1.0 else 1.0
    low, high = 1.0 / _LARGEST, 1.0 / jump
    nodes = np.cos(np.pi * (np.arange(400) + 0.5) / 400)
    inverse = low + (high - low) * (nodes + 1.0) / 2.0
    v = 1.0 / inverse
    w = v.copy()
    for _ in range(40):
        slope = alpha * w ** (alpha - 1.0) + w - v
        bend = alpha * (alpha - 1.0) * w ** (alpha - 2.0) + 1.0
        w = np.clip(w - slope / np.where(np.abs(bend) < 1e-3, 1e-3, bend), max(jump_w, 1e-9), v)
    terms = np.polynomial.Polynomial.fit(inverse, v - w, _DEGREE).convert().coef[::-1]
    steepness = jump / (1.0 - 1.0 / (1.0 + _RAMP))
    return np.float32(1.0 / jump), np.float32(steepness), terms.astype(np.float32)


@jit
def shrink(v: Number, scale: Number, prox: Prox) -> Number:
    """Shrink one gradient by s = `scale`; see `shrinkage`."""
    edge, steepness, terms = prox
    size = max(abs(v), np.float32(1e-20))
    below = scale / size
    inverse = min(max(below, _REACH), edge)
    subtracted = ZERO
    for k in range(_DEGREE + 1):
        subtracted = subtracted * inverse + terms[k]
    kept = (size - scale * subtracted) * min(max((edge - below) * steepness, ZERO), ONE)
    return kept if v >= ZERO else -kept


# Luma, and two chroma directions, orthonormal.
_OPPONENT: Final = np.array(
    [
        [1 / np.sqrt(3)] * 3,
        [1 / np.sqrt(2), 0.0, -1 / np.sqrt(2)],
        [-1 / np.sqrt(6), 2 / np.sqrt(6), -1 / np.sqrt(6)],
    ],
    dtype=np.float32,
)


@jit
def _shrink_row(slopes: Real, scale: Real, factors: Real, prox: Prox, kept: Real) -> None:
    """Rotate three gradients to luma and chroma, shrink each, rotate back."""
    kept[:] = ZERO
    for k in range(3):
        red, green, blue = _OPPONENT[k]
        for j in range(scale.size):
            along = red * slopes[0, j] + green * slopes[1, j] + blue * slopes[2, j]
            left = shrink(along, scale[j] * factors[k], prox)
            kept[0, j] += red * left
            kept[1, j] += green * left
            kept[2, j] += blue * left


@jit
def _pull_of(  # noqa: C901 - loops over rows and colours, one pass over memory
    x: Real, scale: Real, factors: Real, prox: Prox, pull: Real
) -> None:
    """sum_j F_j^T prox(F_j x) of three planes, periodic forward differences, into `pull`."""
    channels, height, width = x.shape
    slopes = np.empty((channels, width), np.float32)
    kept = np.empty((channels, width), np.float32)
    pull[:] = ZERO
    for i in range(height):
        below = i + 1 if i + 1 < height else 0
        for c in range(channels):
            for j in range(width):
                slopes[c, j] = x[c, below, j] - x[c, i, j]
        _shrink_row(slopes, scale[i], factors, prox, kept)
        for c in range(channels):
            for j in range(width):
                pull[c, below, j] += kept[c, j]
                pull[c, i, j] -= kept[c, j]
        for c in range(channels):
            for j in range(width - 1):
                slopes[c, j] = x[c, i, j + 1] - x[c, i, j]
            slopes[c, width - 1] = x[c, i, 0] - x[c, i, width - 1]
        _shrink_row(slopes, scale[i], factors, prox, kept)
        for c in range(channels):
            pull[c, i, 0] += kept[c, width - 1]
            for j in range(width):
                pull[c, i, j] -= kept[c, j]
            for j in range(1, width):
                pull[c, i, j] += kept[c, j - 1]


@jit
def _drifted(x: Real, drift: Complex, down: Real, across: Real, work: Real, D: Complex, E: Complex) -> None:
    """What the change of the kernel adds to the prediction, as a spectrum, into `E`."""
    height, width = x.shape
    for way in range(2):
        for i in range(height):
            for j in range(width):
                work[i, j] = x[i, j] * (down[i] if way == 0 else across[j])
        to_spectrum(work, D)
        for i in range(height):
            for j in range(D.shape[1]):
                term = drift[way, i, j] * D[i, j]
                E[i, j] = term if way == 0 else E[i, j] + term


@jit
def _predict(X: Complex, K: Complex, E: Complex, P: Complex) -> None:
    """Spectrum of the estimate X blurred by K, and what the change of the kernel adds to it, into `P`."""
    for i in range(P.shape[0]):
        for j in range(P.shape[1]):
            P[i, j] = K[i, j] * X[i, j]
    if E.shape[0] > 0:
        P += E


@jit
def half_quadratic(  # noqa: C901 - one pass over memory per loop
    y: Real,
    known: NDArray[np.bool_],
    K: Complex,
    noise: Real,
    X: Complex,
    gradient_power: Real,
    scale: Real,
    factors: Real,
    couplings: Real,
    prox: Prox,
    moved: tuple[Complex, Real, Real],
) -> tuple[Real, Real]:
    """Half-quadratic steps of `SparseGradient` on a canvas, from the spectrum X of a first estimate.

    `known` marks the pixels that hold data: where all do, none needs a prediction. `moved` is the change of K
    per pixel down and across, empty where there is none, and the distances down and across from where the
    kernel is K; what it contributes is recomputed in the first step and half way. Returned are the planes and
    what they make of the data, blurred again.
    """
    channels, height, width = y.shape
    half, steps, whole = width // 2 + 1, couplings.size, known.all()
    drift, down, across = moved
    x, explained = np.empty_like(y), np.empty_like(y)
    S = np.empty((channels, height, half), np.complex64)  # of the data, and of what is predicted between them
    drifts = drift.shape[0] > 0
    E = np.zeros((channels, height, half) if drifts else (0, 0, 0), np.complex64)
    D = np.empty((height, half), np.complex64)
    P = np.empty((height, half), np.complex64)
    pull = np.empty_like(x)
    work = np.empty((height, width), np.float32)
    for c in range(channels):
        to_spectrum(y[c], S[c])
        P[:] = X[c]
        to_plane(P, x[c])
    for step in range(steps):
        _pull_of(x, scale, factors[step], prox, pull)
        for c in range(channels):
            if drifts and (step == 0 or step == steps // 2):
                _drifted(x[c], drift[c], down, across, work, D, E[c])
            if not whole:
                _predict(X[c], K[c], E[c] if drifts else D[:0], P)
                S[c] = P
                to_plane(P, work)
                for i in range(height):
                    for j in range(width):
                        work[i, j] = y[c, i, j] - work[i, j] if known[c, i, j] else ZERO
                to_spectrum(work, D)
                S[c] += D
            to_spectrum(pull[c], P)
            weight = couplings[step] * noise[c]
            for i in range(height):
                for j in range(half):
                    k = K[c, i, j]
                    power = k.real * k.real + k.imag * k.imag
                    spectrum = S[c, i, j]
                    if drifts:
                        spectrum -= E[c, i, j]
                    P[i, j] = (np.conj(k) * spectrum + weight * P[i, j]) * (
                        ONE / (power + weight * gradient_power[i, j])
                    )
            X[c] = P
            to_plane(P, x[c])
    for c in range(channels):
        _predict(X[c], K[c], E[c] if drifts else D[:0], P)
        to_plane(P, explained[c])
    return x, explained


_LIGHT_STEPS: Final = 20  # for the light of clipped pixels, and for that beyond the frame (chosen)
_TYPICAL_CONTRAST: Final = np.float32(0.02)
"""Variance over squared light at which kappa is `weight`: its unit."""
_SCENE: Final = 0.2
"""Least variance over squared light for the determined share (chosen: else flat cells keep noise)."""
# See `_reliance` (chosen on lenses of development seeds: measured once, no command repeats it)
_OPEN, _SLOPE, _LEAST = 0.25, 0.87, 0.4
# Range of the weight of the prior between texture and flat places (chosen on the same lenses, as those)
_BUSIEST, _CALMEST = 0.7, 50.0
_DARK: Final = np.float32(0.02)  # of a tile's mean light, below which the prior stops following it (chosen)
_UNSURE: Final = np.float32(0.1)  # of the noise, counted as signal: few pixels do not resolve it (chosen)


@dataclass(frozen=True, slots=True)
class SparseGradient:
    r"""Maximum a posteriori under Poisson-Gaussian noise and heavy-tailed gradients.

    With the channels c scaled to equal light and T the orthonormal luma-chroma rotation::

        min  sum_c |y_c - k_c * x_c|² / (2 var_c)  +  sum_{j,i} kappa_i |(T f_j * x)_i / level|^alpha

    solved by half-quadratic splitting (`half_quadratic`) with auxiliary gradients w, whose coupling b grows::

        w = T' prox( T f_j * x ; kappa / b ),
        X_c = ( conj(K) Y~ + b var sum_j conj(F_j) W_j ) / ( |K|² + b var sum_j |F_j|² )

    Three departures from Krishnan and Fergus (NIPS 2009, eq. 3 to 5): the threshold follows the noise
    variance pixel by pixel, and the local light and contrast (gradients of a scene scale with both);
    chroma is shrunk harder than luma, because edges of all colours coincide; and unmeasured pixels take the
    model's own prediction as data, Y~ = F x, which maximises the likelihood of what was measured. Such a
    guess converges too slowly for lights above the clipping level: see `Lights`, which removes them first.
    """

    # kappa of luma; where the data say little about the gradients, it is lowered to as little as 0.4 of that
    weight: float = 2.0
    mosaic_weight: float = 4.0  # the same for a mosaic: the prior must also fill in two colours of three
    chroma: float = 2.5  # kappa of chroma over that of luma
    alpha: float = 0.67
    steps: int = 8
    coupling: float = 1.5  # first b, in units of one over the squared light
    growth: float = 3.0  # its factor per step

    def __post_init__(self) -> None:
        if not (self.weight > 0.0 and self.chroma > 0.0 and self.coupling > 0.0 and self.growth >= 1.0):
            raise InvalidInputError(f"weights of the prior must be positive, got {self}")

    def deconvolve(self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor) -> Plane:
        """Deconvolve one plane; see `Deconvolver`."""
        # as three equal colours, each of which adds its datum but not its gradients to the sum
        more = len(CHANNELS) ** (1.0 - self.alpha / 2.0)
        alike = replace(self, weight=more * self.weight, mosaic_weight=more * self.mosaic_weight)
        return alike.deconvolve_planes(np.stack([blurred] * 3), [blur] * 3, [sensor] * 3).planes[0]

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Solution:
        """Restore the colours together; see `restore_planes`."""
        lights = Lights.of(blurred, blurs, sensors, _LIGHT_STEPS)
        rest = blurred if lights is None else lights.rest
        light = np.maximum(rest.mean(axis=(1, 2)), 1e-4).astype(np.float32)
        scale = light[:, None, None]
        canvas = Canvas.around(rest, blurs, surrounded=all(sensor.surrounded for sensor in sensors))
        recorded = rest if lights is None else rest + lights.glow
        var = (
            np.stack([s.variance(_local_means(p)) for s, p in zip(sensors, recorded, strict=True)]) / scale**2
        )
        noise = np.maximum(var.mean(axis=(1, 2)), np.float32(1e-9))
        luma = (rest / scale).mean(axis=0)
        mean = _local_means(luma)
        level = np.maximum(mean, _DARK)
        calm = _calm(_local_means(luma * luma) - mean * mean, level, var.mean(axis=0) / len(rest), self.alpha)
        threshold = (var / noise[:, None, None]).mean(axis=0) * calm / level ** np.float32(self.alpha)
        power = np.float32(1.0 / (2.0 - self.alpha))  # of a threshold, for the scale of `shrinkage`
        threshold = interpolated(threshold**power, BLOCK, canvas.rows, canvas.cols)
        couplings = self.coupling * self.growth ** np.arange(self.steps)
        K, rates = transfers(blurs, canvas.shape, max(rest.shape[1:]) / 2.0)
        variance = (rest.reshape(len(rest), -1).var(axis=1) / light**2).astype(np.float32)
        mosaic = any(sensor.measured is not None for sensor in sensors)
        weights = np.full(len(rest), self.mosaic_weight if mosaic else self.weight, dtype=np.float64)
        if not mosaic and lights is None:
            # beside removed lights the rest is no natural scene: the prior keeps its weight
            weights *= _reliance(K[1], canvas.shape, noise[1], variance[1])
        weights[1:] *= self.chroma
        y = fill_canvas(canvas, rest, light, K, blurs, sensors, _LIGHT_STEPS)
        if mosaic:
            refill(y, K, noise, variance, sensors, canvas)
        x, explained = half_quadratic(
            y,
            _known(sensors, canvas),
            K,
            noise,
            np.stack([wiener_spectrum(*each) for each in zip(y, K, noise, variance, strict=True)]),
            _gradient_power(canvas.shape),
            canvas.filled(threshold[None], np.ones(1, dtype=np.float32))[0],
            (weights[None, :] / couplings[:, None]).astype(np.float32) ** power,
            couplings.astype(np.float32),
            shrinkage(self.alpha),
            (rates, *_from_middle(canvas, blurs[0])),
        )
        restored = x[:, *canvas.data] * scale
        left = rest - explained[:, *canvas.data] * scale
        clipped = blurred >= np.array([[[min(s.clip, 1e9)]] for s in sensors], dtype=np.float32)
        left[clipped] = 0.0
        if mosaic:
            left = spread_grain(blurred, left, clipped, sensors, light)
        return Solution(restored if lights is None else lights.put_back(blurred, restored), left)


def _from_middle(canvas: Canvas, blur: UniformBlur) -> tuple[Real, Real]:
    """Rows and columns from where the kernel is K, in pixels; constant beyond the ends of the data."""
    origin = blur.drift.origin if blur.drift else (0.0, 0.0)
    down, across = (
        (np.clip(np.arange(length) - canvas.margin, 0, extent - 1) - middle).astype(np.float32)
        for length, extent, middle in zip(canvas.shape, (canvas.rows, canvas.cols), origin, strict=True)
    )
    return down, across


def _reliance(K: Complex, shape: tuple[int, int], noise: np.float32, variance: np.float32) -> float:
    """Factor on kappa by the share of a natural scene's gradients that the data determine.

    The most probable picture is not the mean of the probable ones: gradients that the data leave open all
    come out as zero, so where the blur is wide and the noise strong the prior must weigh less. The share is
    sum |F|² S W / sum |F|² S, with S the scene's spectrum (in a flat cell, that of an average scene) and
    W = |K|² S / (|K|² S + noise) the part of it that Wiener's filter keeps.
    """
    prior_power = prior(shape)[1]
    blurred_prior = prior_power * (K.real**2 + K.imag**2)
    signal = max(float(variance - noise), _SCENE)
    level = np.float32(
        float(noise) * float(blurred_prior.sum(dtype=np.float64)) / (signal * shape[0] * shape[1])
    )
    gradients = prior_power * _gradient_power(shape)
    share = float((gradients * (blurred_prior / (blurred_prior + level))).sum() / gradients.sum())
    return min(max(_OPEN + _SLOPE * share, _LEAST), 1.0)


def _known(sensors: Sequence[Sensor], canvas: Canvas) -> NDArray[np.bool_]:
    """Where the canvas holds data.

    A margin that will be cut off counts as data: its faded pixels are as good as any guess,
    and where everything is known the steps need no prediction.
    """
    known = np.full((len(sensors), *canvas.shape), all(s.surrounded for s in sensors), dtype=np.bool_)
    for plane, sensor in zip(known, sensors, strict=True):
        plane[canvas.data] = True if sensor.measured is None else sensor.measured
    return known


def _calm(local: Real, level: Real, noise: Real, alpha: float) -> Real:
    """How much smoother than an average scene each block is: the factor on kappa.

    The maximum-likelihood kappa of a hyper-Laplacian is proportional to E|g|^-alpha; gradients
    scale with the local contrast, so it is (typical over local variance of the signal)^(alpha / 2).
    Without it the flat parts of a picture keep the noise that the inverse of a wide kernel amplifies.
    """
    signal = np.maximum(local - noise, 0.0) + _UNSURE * noise + np.float32(1e-12)
    calm = (_TYPICAL_CONTRAST * level**2 / signal) ** np.float32(alpha / 2)
    return np.asarray(np.clip(calm, _BUSIEST, _CALMEST), dtype=np.float32)


@lru_cache(maxsize=8)
def _gradient_power(shape: tuple[int, int]) -> Real:
    """sum_j |F_j|² of the two forward differences."""
    rows = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.fftfreq(shape[0]))
    cols = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.rfftfreq(shape[1]))
    return (rows[:, None] + cols[None, :]).astype(np.float32)


def _local_means(plane: Real) -> Real:
    """Means over blocks of 4 pixels, smoothed: over about 13 pixels."""
    counts = (np.minimum(BLOCK, extent - np.arange(0, extent, BLOCK)) for extent in plane.shape)
    plane = block_sums(plane, BLOCK) / np.outer(*counts).astype(np.float32)
    for axis in (0, 1):
        plane = ndimage.convolve1d(plane, [1 / 6, 4 / 6, 1 / 6], axis=axis, mode="nearest")
    return np.asarray(plane, dtype=np.float32)
