"""Half-quadratic splitting, compiled: gradients shrunk towards zero, then planes solved for, in turns.

D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors", NIPS 2009, eq. 3 to 5.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.correction.transforms import ONE, ZERO, Complex, Number, Real, to_plane, to_spectrum

_DEGREE: Final = (
    9  # of the polynomial: a shorter one misses the bend at the jump, each term costs a step (chosen)
)
_LARGEST: Final = 24.0  # argument, in widths of the shrinkage: beyond, hardly anything is taken off (chosen)
_REACH: Final = np.float32(1.0 / _LARGEST)
_RAMP: Final = 0.1
"""Share of the jump over which the answer rises from 0 instead (chosen: with none, rounding decides what is
kept, and steps that follow make a visible pixel of it; a wide one is no longer the prior's own answer)."""


Prox = tuple[Number, Number, Real]


@dataclass(frozen=True, slots=True, eq=False)
class Shrinkage:
    """The minimiser of t |w|^alpha + (w - v)² / 2, by one polynomial for all t.

    With s = t^(1 / (2 - alpha)) the substitution w = s u leaves t = 1::

        prox_t(v) = s prox_1(v / s),      prox_1(v) = v - p(1 / v)  beyond the jump, else 0

    What is subtracted from v is smooth in 1 / v, so a short polynomial p suffices: unlike a table it
    runs in vector registers. Beyond 24 s the subtraction is held constant.
    """

    alpha: float  # exponent of the hyper-Laplacian in (0, 1]; 1 is soft thresholding
    # 1 / v for t = 1 where the answer begins to rise, slope of the ramp that begins there per 1 / v, and
    # coefficients of p, highest power first
    prox: Prox

    @classmethod
    @lru_cache(maxsize=16)  # one fit per exponent, not one per tile
    def of(cls, alpha: float) -> Shrinkage:
        """Fit the polynomial to the answers found by Newton steps."""
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
        return cls(alpha, (np.float32(1.0 / jump), np.float32(steepness), terms.astype(np.float32)))

    def scale(self, threshold: Real) -> Real:
        """The scale s for a threshold t."""
        return np.asarray(np.power(threshold, 1.0 / (2.0 - self.alpha)), dtype=np.float32)


@jit
def shrink(v: Number, scale: Number, prox: Prox) -> Number:
    """Shrink one gradient; see `Shrinkage`."""
    edge, steepness, terms = prox
    size = max(abs(v), np.float32(1e-20))
    below = scale / size
    inverse = min(max(below, _REACH), edge)
    subtracted = terms[0]
    subtracted = subtracted * inverse + terms[1]
    subtracted = subtracted * inverse + terms[2]
    subtracted = subtracted * inverse + terms[3]
    subtracted = subtracted * inverse + terms[4]
    subtracted = subtracted * inverse + terms[5]
    subtracted = subtracted * inverse + terms[6]
    subtracted = subtracted * inverse + terms[7]
    subtracted = subtracted * inverse + terms[8]
    subtracted = subtracted * inverse + terms[9]
    kept = (size - scale * subtracted) * min(max((edge - below) * steepness, ZERO), ONE)
    return kept if v >= ZERO else -kept


@jit
def _shrink_row(slopes: Real, scale: Real, factors: Real, rotation: Real, prox: Prox, kept: Real) -> None:
    """Rotate three gradients to luma and chroma, shrink each, rotate back."""
    t00, t01, t02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    t10, t11, t12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    t20, t21, t22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    f0, f1, f2 = factors[0], factors[1], factors[2]
    for j in range(scale.size):
        r, g, b, s = slopes[0, j], slopes[1, j], slopes[2, j], scale[j]
        p = shrink(t00 * r + t01 * g + t02 * b, s * f0, prox)
        q = shrink(t10 * r + t11 * g + t12 * b, s * f1, prox)
        o = shrink(t20 * r + t21 * g + t22 * b, s * f2, prox)
        kept[0, j] = t00 * p + t10 * q + t20 * o
        kept[1, j] = t01 * p + t11 * q + t21 * o
        kept[2, j] = t02 * p + t12 * q + t22 * o


@jit
def _pull_of(  # noqa: C901 - loops over rows and colours, one pass over memory
    x: Real, scale: Real, factors: Real, rotation: Real, prox: Prox, pull: Real
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
        _shrink_row(slopes, scale[i], factors, rotation, prox, kept)
        for c in range(channels):
            for j in range(width):
                pull[c, below, j] += kept[c, j]
                pull[c, i, j] -= kept[c, j]
        for c in range(channels):
            for j in range(width - 1):
                slopes[c, j] = x[c, i, j + 1] - x[c, i, j]
            slopes[c, width - 1] = x[c, i, 0] - x[c, i, width - 1]
        _shrink_row(slopes, scale[i], factors, rotation, prox, kept)
        for c in range(channels):
            pull[c, i, 0] += kept[c, width - 1]
            for j in range(width):
                pull[c, i, j] -= kept[c, j]
            for j in range(1, width):
                pull[c, i, j] += kept[c, j - 1]


@jit
def _wiener(
    Y: Complex,
    K: Complex,
    decay: Real,
    prior_power: Real,
    size: int,
    noise: Number,
    variance: Number,
    P: Complex,
) -> None:
    """Spectrum of the Wiener estimate; see `scene_power.wiener_spectrum`."""
    height, half = Y.shape
    blurred_prior = np.float64(0.0)
    for i in range(height):
        part = ZERO
        for j in range(half):
            k = K[i, j]
            part += prior_power[i, j] * (k.real * k.real + k.imag * k.imag)
        blurred_prior += part
    scale = max(variance - noise, 0.005 * variance + 1e-12) / blurred_prior
    ratio = np.float32(noise / (scale * size))
    for i in range(height):
        for j in range(half):
            k = K[i, j]
            weight = ONE / (k.real * k.real + k.imag * k.imag + ratio * decay[i, j] + np.float32(1e-9))
            P[i, j] = Y[i, j] * np.conj(k) * weight
    P[0, 0] = Y[0, 0] * np.conj(K[0, 0])


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
def half_quadratic(  # noqa: C901, PLR0912 - one pass over memory per loop
    y: Real,
    known: NDArray[np.bool_],
    K: Complex,
    noise: Real,
    variance: Real,
    prior: tuple[Real, Real],
    gradient_power: Real,
    scale: Real,
    factors: Real,
    couplings: Real,
    rotation: Real,
    prox: Prox,
    moved: tuple[Complex, Real, Real],
) -> tuple[Real, Real]:
    """Wiener start and half-quadratic steps of `SparseGradient` on a canvas.

    `known` marks the pixels that hold data: where all do, none needs a prediction. `moved` is the change of K
    per pixel down and across, empty where there is none, and the distances down and across from where the
    kernel is K; what it contributes is recomputed in the first step and half way. Returned are the planes and
    what they make of the data, blurred again.
    """
    channels, height, width = y.shape
    half, steps, whole = width // 2 + 1, couplings.size, known.all()
    (decay, prior_power), (drift, down, across) = prior, moved
    x, explained = np.empty_like(y), np.empty_like(y)
    S = np.empty((channels, height, half), np.complex64)  # of the data, and of what is predicted between them
    X = np.empty((0 if whole else channels, height, half), np.complex64)
    E = np.zeros((channels, height, half) if drift.shape[0] > 0 else (0, 0, 0), np.complex64)
    D = np.empty((height, half), np.complex64)
    P = np.empty((height, half), np.complex64)
    pull = np.empty_like(x)
    work = np.empty((height, width), np.float32)
    for c in range(channels):
        to_spectrum(y[c], S[c])
        _wiener(S[c], K[c], decay, prior_power, height * width, noise[c], variance[c], P)
        if not whole:
            X[c] = P
        to_plane(P, x[c])
    for step in range(steps):
        _pull_of(x, scale, factors[step], rotation, prox, pull)
        for c in range(channels):
            if drift.shape[0] > 0 and (step == 0 or step == steps // 2):
                _drifted(x[c], drift[c], down, across, work, D, E[c])
            if not whole:
                _predict(X[c], K[c], E[c] if drift.shape[0] > 0 else D[:0], P)
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
                    if drift.shape[0] > 0:
                        spectrum -= E[c, i, j]
                    P[i, j] = (np.conj(k) * spectrum + weight * P[i, j]) * (
                        ONE / (power + weight * gradient_power[i, j])
                    )
            if not whole:
                X[c] = P
            to_plane(P, x[c])
    for c in range(channels):
        if whole:
            to_spectrum(x[c], D)
        else:
            D[:] = X[c]
        _predict(D, K[c], E[c] if drift.shape[0] > 0 else D[:0], P)
        to_plane(P, explained[c])
    return x, explained
