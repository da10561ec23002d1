"""The steps of `methods.richardson_lucy`, compiled: Whyte's saturation, Biggs and Andrews' acceleration."""

from __future__ import annotations

from typing import Final

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import (
    BACK,
    FORWARD,
    ONE,
    ZERO,
    Complex,
    Number,
    Real,
    through,
)
from lensmodel.correction.deconvolver import LEAST_PREDICTED

_EPS: Final = np.float32(1e-6)  # keeps quotients finite in the dark
_LEAST: Final = np.float32(LEAST_PREDICTED)
# Of the clipping level: from here on a pixel may belong to a clipped light (chosen)
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
    latent: Real, level: Number, reach: int, clean: Real, soft: Real
) -> bool:
    """Find bright sharp pixels: mark what they reach as unclean, and their own places softly.

    Returns whether there are any. `clean` has the size of the data, `soft` that of the latent plane.
    """
    rows, cols = latent.shape
    hard = np.zeros((rows, cols), np.float32)
    any_light = False
    for i in range(rows):
        for j in range(cols):
            if latent[i, j] >= level:
                any_light = True
                for di in range(-3, 4):
                    for dj in range(-3, 4):
                        a, b = i + di, j + dj
                        if di * di + dj * dj <= 9 and 0 <= a < rows and 0 <= b < cols:
                            hard[a, b] = ONE
    if not any_light:
        return False
    # A square of the operator's reach covers the kernel without knowing its shape. One pass each
    # way that remembers the last mark costs the same for any reach.
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
def _errors(
    light: Real, data: Real, base: Number, clip: Number, bend: Real, first: Number, last: Number
) -> None:
    """Error of what a row of light predicts, in place: ( data / (R + base) - 1 ) R'.

    `bend` holds R / clip and R' at even steps of light / clip from `first` to `last`; below, the sensor
    records the light itself, above it `clip`. A logarithm and two exponentials for each pixel of
    a blown area would take ten times as long as all transforms.
    """
    brightest = ZERO
    for j in range(light.size):
        brightest = max(brightest, light[j])
    if brightest <= first * clip:  # no branch in the loop: several pixels at a time
        for j in range(light.size):
            light[j] = data[j] / max(max(light[j], ZERO) + base, _LEAST * data[j], _EPS) - ONE
        return
    top = np.float32(bend.shape[1] - 1)
    share, steps = ONE / clip, top / (last - first)
    for j in range(light.size):
        predicted = max(light[j], ZERO)
        at = min((predicted * share - first) * steps, top)
        if not at > ZERO:  # a NaN stays one
            light[j] = data[j] / max(predicted + base, _LEAST * data[j], _EPS) - ONE
        else:
            k = min(np.int32(at), np.int32(bend.shape[1] - 2))
            part = at - np.float32(k)
            recorded = clip * (bend[0, k] + part * (bend[0, k + 1] - bend[0, k]))
            slope = bend[1, k] + part * (bend[1, k + 1] - bend[1, k])
            light[j] = (data[j] / max(recorded + base, _LEAST * data[j], _EPS) - ONE) * slope


@jit
def _measured_alpha(start: Real, work: Real, share: Real, change: Real) -> Number:
    """Measure alpha of Biggs and Andrews; `change` holds that of the step before, then that of this one."""
    rows, cols = start.shape
    norm = 0.0
    product = 0.0
    for i in range(rows):
        row_product, row_norm = np.float64(0.0), np.float64(0.0)
        for j in range(cols):
            light = max(start[i, j] * max(ONE + work[i, j] * share[i, j], ZERO), _EPS)
            now, before = light - start[i, j], change[i, j]
            row_product += now * before
            row_norm += before * before
            change[i, j] = now
        product += row_product
        norm += row_norm
    if not norm > 0.0:
        return ZERO
    return np.float32(min(max(product / norm, 0.0), 1.0))


@jit
def richardson_lucy(  # noqa: C901 - one pass over memory per loop
    latent: Real,
    data: Real,
    reach: Real,
    K: Complex,
    base: Number,
    clip: Number,
    bend: Real,
    first: Number,
    last: Number,
    alphas: Real,
    adaptive: bool,
    width: int,
    lights: bool,
) -> None:
    """Accelerated saturation-aware steps; `latent` is start and result.

    The transforms live on the grid of `K`, `width` columns wide; the latent plane lies in its
    first corner, the data in the middle of the latent plane. With `adaptive` the extrapolation of each
    step is measured on the changes of the two before it, and `alphas` only gives their number.
    `bend`, `first` and `last` are those of `_errors`.
    """
    rows, cols = latent.shape
    high, wide = data.shape
    top, left = (rows - high) // 2, (cols - wide) // 2
    bottom, right = top + high, left + wide
    steps = alphas.shape[0]
    P = np.empty(K.shape, np.complex64)
    work = np.zeros((K.shape[0], width), np.float32)
    calm = np.zeros_like(work) if lights else work
    start = latent.copy()
    work[:rows, :cols] = latent
    share = ONE / reach
    clean = np.empty_like(data)
    soft = np.empty_like(latent)
    change = np.zeros_like(latent) if adaptive else soft
    for step in range(steps):
        through(work, P, K, FORWARD, 0, rows, top, bottom)
        for i in range(high):
            _errors(work[top + i, left:right], data[i], base, clip, bend, first, last)
            work[top + i, :left] = ZERO
            work[top + i, right:] = ZERO
        split = lights and _lights(start, np.float32(_LIGHT * clip), top, clean, soft)
        if split:
            for i in range(high):
                calm[top + i] = ZERO
                for j in range(wide):
                    calm[i + top, j + left] = work[i + top, j + left] * clean[i, j]
            through(calm, P, K, BACK, top, bottom, 0, rows)
        through(work, P, K, BACK, top, bottom, 0, rows)
        if split:
            for i in range(rows):
                for j in range(cols):
                    work[i, j] = calm[i, j] + (work[i, j] - calm[i, j]) * soft[i, j]
        alpha = alphas[step + 1] if step + 1 < steps else ZERO
        if adaptive:
            alpha = _measured_alpha(start, work, share, change)
        for i in range(rows):
            for j in range(cols):
                light = max(start[i, j] * max(ONE + work[i, j] * share[i, j], ZERO), _EPS)
                ahead = max(light + alpha * (light - latent[i, j]), _EPS)
                latent[i, j] = light
                start[i, j] = ahead
                work[i, j] = ahead
            work[i, cols:] = ZERO
