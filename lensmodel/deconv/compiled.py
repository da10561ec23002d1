"""The inner loops, compiled: three colours of one tile, with transforms into given buffers.

Imported only where Numba and rocket-fft are installed; `lensmodel.deconv.engine` decides. Every
function here has a NumPy twin that gives the same numbers.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar, cast

import numba
import numpy as np
import rocket_fft
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])
Real = NDArray[np.float32]
Complex = NDArray[np.complex64]

_REACH: Final = np.float32(1.0 / 24.0)
_ONE: Final = np.float32(1.0)
_ZERO: Final = np.float32(0.0)
_EPS: Final = np.float32(1e-6)
_LIGHT: Final = np.float32(0.9)
_FORWARD: Final = True
_BACK: Final = False


def _jit(function: F) -> F:
    """Compile without the interpreter's lock, keep the machine code on disk."""
    return cast(
        "F",
        numba.njit(
            cache=True, nogil=True, fastmath={"nsz", "contract", "reassoc", "arcp"}, error_model="numpy"
        )(function),
    )


@_jit
def _shrink(v: Any, scale: Any, jump: Any, terms: Real) -> Any:  # noqa: ANN401 - a float32 register
    size = max(abs(v), np.float32(1e-20))
    inverse = min(max(scale / size, _REACH), _ONE / jump)
    taken = terms[0]
    taken = taken * inverse + terms[1]
    taken = taken * inverse + terms[2]
    taken = taken * inverse + terms[3]
    taken = taken * inverse + terms[4]
    taken = taken * inverse + terms[5]
    taken = taken * inverse + terms[6]
    taken = taken * inverse + terms[7]
    taken = taken * inverse + terms[8]
    taken = taken * inverse + terms[9]
    kept = size - scale * taken if size > scale * jump else _ZERO
    return kept if v >= _ZERO else -kept


@_jit
def _shrink_row(
    slopes: Real, scale: Real, factors: Real, rotation: Real, jump: float, terms: Real, kept: Real
) -> None:
    """Rotate three gradients to luma and chroma, shrink each, rotate back."""
    t00, t01, t02 = rotation[0, 0], rotation[0, 1], rotation[0, 2]
    t10, t11, t12 = rotation[1, 0], rotation[1, 1], rotation[1, 2]
    t20, t21, t22 = rotation[2, 0], rotation[2, 1], rotation[2, 2]
    f0, f1, f2 = factors[0], factors[1], factors[2]
    for j in range(scale.size):
        r, g, b, s = slopes[0, j], slopes[1, j], slopes[2, j], scale[j]
        p = _shrink(t00 * r + t01 * g + t02 * b, s * f0, jump, terms)
        q = _shrink(t10 * r + t11 * g + t12 * b, s * f1, jump, terms)
        o = _shrink(t20 * r + t21 * g + t22 * b, s * f2, jump, terms)
        kept[0, j] = t00 * p + t10 * q + t20 * o
        kept[1, j] = t01 * p + t11 * q + t21 * o
        kept[2, j] = t02 * p + t12 * q + t22 * o


@_jit
def pull_of(  # noqa: C901 - loops over rows and colours, one pass over memory
    x: Real, scale: Real, factors: Real, rotation: Real, jump: float, terms: Real, pull: Real
) -> None:
    """sum_j F_j^T prox(F_j x) of three planes, periodic forward differences, into `pull`."""
    channels, height, width = x.shape
    slopes = np.empty((channels, width), np.float32)
    kept = np.empty((channels, width), np.float32)
    pull[:] = _ZERO
    for i in range(height):
        below = i + 1 if i + 1 < height else 0
        for c in range(channels):
            for j in range(width):
                slopes[c, j] = x[c, below, j] - x[c, i, j]
        _shrink_row(slopes, scale[i], factors, rotation, jump, terms, kept)
        for c in range(channels):
            for j in range(width):
                pull[c, below, j] += kept[c, j]
                pull[c, i, j] -= kept[c, j]
        for c in range(channels):
            for j in range(width - 1):
                slopes[c, j] = x[c, i, j + 1] - x[c, i, j]
            slopes[c, width - 1] = x[c, i, 0] - x[c, i, width - 1]
        _shrink_row(slopes, scale[i], factors, rotation, jump, terms, kept)
        for c in range(channels):
            pull[c, i, 0] += kept[c, width - 1]
            for j in range(width):
                pull[c, i, j] -= kept[c, j]
            for j in range(1, width):
                pull[c, i, j] += kept[c, j - 1]


@_jit
def half_quadratic(  # noqa: C901, PLR0912 - one pass over memory per loop
    x: Real,
    y: Real,
    state: NDArray[np.uint8],
    K: Complex,
    smooth: Real,
    noise: Real,
    scale: Real,
    factors: Real,
    couplings: Real,
    drift: Complex,
    down: Real,
    across: Real,
    rotation: Real,
    jump: float,
    terms: Real,
) -> None:
    """Half-quadratic steps of `SparseGradient` on a canvas; `x` is the start and the result.

    `state` is 0 where the pixel was measured, 1 where nothing was, 2 where it was clipped. `drift`
    is how K changes per pixel down and across, and empty where it does not; `down` and `across` are
    the distances from where it is K.
    """
    channels, height, width = x.shape
    half = width // 2 + 1
    axes = np.array([0, 1])
    norm = 1.0 / (height * width)
    X = np.empty((channels, height, half), np.complex64)
    D = np.empty((height, half), np.complex64)
    P = np.empty((height, half), np.complex64)
    pull = np.empty_like(x)
    work = np.empty((height, width), np.float32)
    for c in range(channels):
        rocket_fft.r2c(x[c], X[c], axes, _FORWARD, 1.0, 1)
    for step in range(couplings.shape[0]):
        pull_of(x, scale, factors[step], rotation, jump, terms, pull)
        for c in range(channels):
            for i in range(height):
                for j in range(half):
                    P[i, j] = K[c, i, j] * X[c, i, j]
            if drift.shape[0] > 0:
                for way in range(2):
                    for i in range(height):
                        for j in range(width):
                            work[i, j] = x[c, i, j] * (down[i] if way == 0 else across[j])
                    rocket_fft.r2c(work, D, axes, _FORWARD, 1.0, 1)
                    for i in range(height):
                        for j in range(half):
                            P[i, j] += drift[c, way, i, j] * D[i, j]
            rocket_fft.c2r(P, work, axes, _BACK, norm, 1)
            for i in range(height):
                for j in range(width):
                    kind, left = state[c, i, j], y[c, i, j] - work[i, j]
                    work[i, j] = left if kind == 0 or (kind == 2 and left > _ZERO) else _ZERO
            rocket_fft.r2c(work, D, axes, _FORWARD, 1.0, 1)
            rocket_fft.r2c(pull[c], P, axes, _FORWARD, 1.0, 1)
            weight = couplings[step] * noise[c]
            for i in range(height):
                for j in range(half):
                    k = K[c, i, j]
                    power = k.real * k.real + k.imag * k.imag
                    found = power * X[c, i, j] + np.conj(k) * D[i, j]
                    X[c, i, j] = (found + weight * P[i, j]) * (_ONE / (power + weight * smooth[i, j]))
            P[:] = X[c]
            rocket_fft.c2r(P, x[c], axes, _BACK, norm, 1)


@_jit
def _blur_marks(hard: Real, soft: Real) -> None:
    """Gaussian of sigma 3, cut at 10 pixels, zero outside; at most 1."""
    rows, cols = hard.shape
    weights = np.empty(21, np.float32)
    for k in range(21):
        weights[k] = np.exp(-np.float32((k - 10) * (k - 10)) / np.float32(18.0))
    weights /= weights.sum()
    soft[:] = _ZERO
    for i in range(rows):
        for k in range(max(0, 10 - i), min(21, rows + 10 - i)):
            weight = weights[k]
            for j in range(cols):
                soft[i, j] += weight * hard[i + k - 10, j]
    padded = np.zeros(cols + 20, np.float32)
    for i in range(rows):
        padded[10 : cols + 10] = soft[i]
        soft[i] = _ZERO
        for k in range(21):
            weight = weights[k]
            for j in range(cols):
                soft[i, j] += weight * padded[j + k]
        for j in range(cols):
            soft[i, j] = min(soft[i, j], _ONE)


@_jit
def _lights(  # noqa: C901, PLR0912 - a few passes over one small tile
    latent: Real, level: np.float32, reach: int, clean: Real, soft: Real
) -> bool:
    """Find bright sharp pixels: mark what they reach as unclean, and where they stand softly.

    Returns whether there are any. `clean` has the size of the data, `soft` that of the latent plane.
    """
    rows, cols = latent.shape
    hard = np.zeros((rows, cols), np.float32)
    found = False
    for i in range(rows):
        for j in range(cols):
            if latent[i, j] >= level:
                found = True
                for di in range(-3, 4):
                    for dj in range(-3, 4):
                        a, b = i + di, j + dj
                        if di * di + dj * dj <= 9 and 0 <= a < rows and 0 <= b < cols:
                            hard[a, b] = _ONE
    if not found:
        return False
    # A square of the operator's reach covers the kernel without knowing its shape. One pass each
    # way with the place of the last mark seen costs the same for any reach.
    across = clean.shape[1]
    wide = np.zeros((rows, across), np.uint8)
    for i in range(rows):
        last = -4 * reach - 4
        for j in range(cols):
            if hard[i, j] > _ZERO:
                last = j
            if j >= 2 * reach and j - last <= 2 * reach:
                wide[i, j - 2 * reach] = 1
    for b in range(across):
        last = -4 * reach - 4
        for i in range(rows):
            if wide[i, b]:
                last = i
            if i >= 2 * reach:
                clean[i - 2 * reach, b] = _ZERO if i - last <= 2 * reach else _ONE
    _blur_marks(hard, soft)
    return True


@_jit
def richardson_lucy(  # noqa: C901, PLR0912, PLR0915 - one pass over memory per loop
    latent: Real,
    data: Real,
    reach: Real,
    K: Complex,
    base: float,
    clip: float,
    sharpness: float,
    alphas: Real,
    width: int,
    lights: bool,
) -> None:
    """Accelerated saturation-aware steps; `latent` is start and result.

    The transforms live on the grid of `K`, `width` columns wide; the latent plane stands in its
    first corner, the data in the middle of the latent plane.
    """
    rows, cols = latent.shape
    height, half = K.shape
    high, wide = data.shape
    top, left = (rows - high) // 2, (cols - wide) // 2
    axes = np.array([0, 1])
    norm = 1.0 / (height * width)
    P = np.empty((height, half), np.complex64)
    work = np.zeros((height, width), np.float32)
    start = np.empty_like(latent)
    previous = latent.copy()
    clips = np.isfinite(clip)
    clean = np.empty_like(data)
    soft = np.empty_like(latent)
    calm = np.empty((height, width), np.float32)
    for step in range(alphas.shape[0]):
        alpha = alphas[step]
        work[:] = _ZERO
        for i in range(rows):
            for j in range(cols):
                light = max(latent[i, j] + alpha * (latent[i, j] - previous[i, j]), _EPS)
                start[i, j] = light
                work[i, j] = light
        rocket_fft.r2c(work, P, axes, _FORWARD, 1.0, 1)
        for i in range(height):
            for j in range(half):
                P[i, j] = P[i, j] * K[i, j]
        rocket_fft.c2r(P, work, axes, _BACK, norm, 1)
        for i in range(height):
            inside = top <= i < top + high
            for j in range(width):
                if inside and left <= j < left + wide:
                    predicted = max(work[i, j], _ZERO)
                    if clips and predicted > np.float32(0.7) * clip:
                        over = sharpness * (predicted / clip - _ONE)
                        # Stable softplus: log(1 + e^x) = max(x, 0) + log1p(e^-|x|).
                        bend = max(over, _ZERO) + np.log1p(np.exp(-abs(over)))
                        seen = clip * (predicted / clip - bend / sharpness)
                        slope = np.float32(0.5) * (_ONE - np.tanh(np.float32(0.5) * over))
                        work[i, j] = (data[i - top, j - left] / max(seen + base, _EPS) - _ONE) * slope
                    else:
                        work[i, j] = data[i - top, j - left] / max(predicted + base, _EPS) - _ONE
                else:
                    work[i, j] = _ZERO
        split = lights and _lights(start, np.float32(_LIGHT * clip), top, clean, soft)
        if split:
            calm[:] = _ZERO
            for i in range(high):
                for j in range(wide):
                    calm[i + top, j + left] = work[i + top, j + left] * clean[i, j]
            rocket_fft.r2c(calm, P, axes, _FORWARD, 1.0, 1)
            for i in range(height):
                for j in range(half):
                    P[i, j] = P[i, j] * np.conj(K[i, j])
            rocket_fft.c2r(P, calm, axes, _BACK, norm, 1)
        rocket_fft.r2c(work, P, axes, _FORWARD, 1.0, 1)
        for i in range(height):
            for j in range(half):
                P[i, j] = P[i, j] * np.conj(K[i, j])
        rocket_fft.c2r(P, work, axes, _BACK, norm, 1)
        if split:
            for i in range(rows):
                for j in range(cols):
                    work[i, j] = calm[i, j] + (work[i, j] - calm[i, j]) * soft[i, j]
        for i in range(rows):
            for j in range(cols):
                update = max(_ONE + work[i, j] / reach[i, j], _ZERO)
                previous[i, j] = latent[i, j]
                latent[i, j] = max(start[i, j] * update, _EPS)


@_jit
def bare_transforms(plane: Real, pairs: int) -> None:
    """Transform a plane to and fro, and nothing else: the floor that a benchmark compares with."""
    axes = np.array([0, 1])
    spectrum = np.empty((plane.shape[0], plane.shape[1] // 2 + 1), np.complex64)
    for _ in range(pairs):
        rocket_fft.r2c(plane, spectrum, axes, _FORWARD, 1.0, 1)
        rocket_fft.c2r(spectrum, plane, axes, _BACK, 1.0 / plane.size, 1)
