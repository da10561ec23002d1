"""Richardson-Lucy steps, compiled, and the bare transforms that they are compared with."""

from __future__ import annotations

from typing import Final

import numpy as np
import rocket_fft

from lensmodel.deconv.compiled_base import BACK, FORWARD, ONE, ZERO, Complex, Real, jit

_EPS: Final = np.float32(1e-6)
_LIGHT: Final = np.float32(0.9)


@jit
def _blur_marks(hard: Real, soft: Real) -> None:
    """Gaussian of sigma 3, cut at 10 pixels, zero outside; at most 1."""
    rows, cols = hard.shape
    weights = np.empty(21, np.float32)
    for k in range(21):
        weights[k] = np.exp(-np.float32((k - 10) * (k - 10)) / np.float32(18.0))
    weights /= weights.sum()
    soft[:] = ZERO
    for i in range(rows):
        for k in range(max(0, 10 - i), min(21, rows + 10 - i)):
            weight = weights[k]
            for j in range(cols):
                soft[i, j] += weight * hard[i + k - 10, j]
    padded = np.zeros(cols + 20, np.float32)
    for i in range(rows):
        padded[10 : cols + 10] = soft[i]
        soft[i] = ZERO
        for k in range(21):
            weight = weights[k]
            for j in range(cols):
                soft[i, j] += weight * padded[j + k]
        for j in range(cols):
            soft[i, j] = min(soft[i, j], ONE)


@jit
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
                            hard[a, b] = ONE
    if not found:
        return False
    # A square of the operator's reach covers the kernel without knowing its shape. One pass each
    # way with the place of the last mark seen costs the same for any reach.
    across = clean.shape[1]
    wide = np.zeros((rows, across), np.uint8)
    for i in range(rows):
        last = -4 * reach - 4
        for j in range(cols):
            if hard[i, j] > ZERO:
                last = j
            if j >= 2 * reach and j - last <= 2 * reach:
                wide[i, j - 2 * reach] = 1
    for b in range(across):
        last = -4 * reach - 4
        for i in range(rows):
            if wide[i, b]:
                last = i
            if i >= 2 * reach:
                clean[i - 2 * reach, b] = ZERO if i - last <= 2 * reach else ONE
    _blur_marks(hard, soft)
    return True


@jit
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
        work[:] = ZERO
        for i in range(rows):
            for j in range(cols):
                light = max(latent[i, j] + alpha * (latent[i, j] - previous[i, j]), _EPS)
                start[i, j] = light
                work[i, j] = light
        rocket_fft.r2c(work, P, axes, FORWARD, 1.0, 1)
        for i in range(height):
            for j in range(half):
                P[i, j] = P[i, j] * K[i, j]
        rocket_fft.c2r(P, work, axes, BACK, norm, 1)
        for i in range(height):
            inside = top <= i < top + high
            for j in range(width):
                if inside and left <= j < left + wide:
                    predicted = max(work[i, j], ZERO)
                    if clips and predicted > np.float32(0.7) * clip:
                        over = sharpness * (predicted / clip - ONE)
                        # Stable softplus: log(1 + e^x) = max(x, 0) + log1p(e^-|x|).
                        bend = max(over, ZERO) + np.log1p(np.exp(-abs(over)))
                        seen = clip * (predicted / clip - bend / sharpness)
                        slope = np.float32(0.5) * (ONE - np.tanh(np.float32(0.5) * over))
                        work[i, j] = (data[i - top, j - left] / max(seen + base, _EPS) - ONE) * slope
                    else:
                        work[i, j] = data[i - top, j - left] / max(predicted + base, _EPS) - ONE
                else:
                    work[i, j] = ZERO
        split = lights and _lights(start, np.float32(_LIGHT * clip), top, clean, soft)
        if split:
            calm[:] = ZERO
            for i in range(high):
                for j in range(wide):
                    calm[i + top, j + left] = work[i + top, j + left] * clean[i, j]
            rocket_fft.r2c(calm, P, axes, FORWARD, 1.0, 1)
            for i in range(height):
                for j in range(half):
                    P[i, j] = P[i, j] * np.conj(K[i, j])
            rocket_fft.c2r(P, calm, axes, BACK, norm, 1)
        rocket_fft.r2c(work, P, axes, FORWARD, 1.0, 1)
        for i in range(height):
            for j in range(half):
                P[i, j] = P[i, j] * np.conj(K[i, j])
        rocket_fft.c2r(P, work, axes, BACK, norm, 1)
        if split:
            for i in range(rows):
                for j in range(cols):
                    work[i, j] = calm[i, j] + (work[i, j] - calm[i, j]) * soft[i, j]
        for i in range(rows):
            for j in range(cols):
                update = max(ONE + work[i, j] / reach[i, j], ZERO)
                previous[i, j] = latent[i, j]
                latent[i, j] = max(start[i, j] * update, _EPS)


@jit
def bare_transforms(plane: Real, pairs: int) -> None:
    """Transform a plane to and fro, and nothing else: the floor that a benchmark compares with."""
    axes = np.array([0, 1])
    spectrum = np.empty((plane.shape[0], plane.shape[1] // 2 + 1), np.complex64)
    for _ in range(pairs):
        rocket_fft.r2c(plane, spectrum, axes, FORWARD, 1.0, 1)
        rocket_fft.c2r(spectrum, plane, axes, BACK, 1.0 / plane.size, 1)
