"""What the prior took of a mosaic's data, as light to add back; see `SparseGradient`."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import ONE, ZERO, Number, Real, smooth

_GRAIN: Final = np.float32(2.5)
"""Standard deviations of the noise within which a residual is grain (chosen: noise exceeds them in one pixel
of 400; further out, it is an error of the PSF that must not be added back)."""

_LUMA: Final = np.array([0.25, 0.6, 0.15], dtype=np.float32)
"""Weights of the colours of a camera in the light that is seen: those of Rec. 709 after a usual matrix."""

_NOISE, _DETAIL = np.float32(0.4), np.float32(0.7)
"""Power of the demosaiced grain over that of the sensor's noise, up to which it is noise, and from which it
is detail that demosaicing made (chosen: in even places nine of ten have .1 to .45)."""

_AVERAGED: Final = np.array([0.3, 0.15, 0.3], dtype=np.float32)
"""Noise power of the mean of a Bayer mosaic's colours under `_BINOMIAL`: one over the pixels in it."""
_COLOURED: Final = np.float32(0.5)
"""Times its noise that the power of a coloured residual is lowered by (chosen: of .5, .75 and 1 the most that
takes no colour from leaves)."""

_BINOMIAL: Final = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / np.float32(16.0)
_AROUND: Final = np.full(7, 1.0 / 7.0, dtype=np.float32)


@jit
def spread_grain(  # noqa: C901, PLR0912 - a few passes over one tile
    y: Real, left: Real, known: NDArray[np.bool_], clip: Real, noise: Real, light: Real, out: Real
) -> None:
    """Fill `out` with what to add back of `left`, what of a demosaiced tile is not explained.

    `known` marks the pixels that a colour was measured at.
    """
    channels, rows, cols = y.shape
    grain, weights = np.empty(channels, np.float32), np.empty(channels, np.float32)
    for c in range(channels):
        grain[c] = max(np.sqrt(noise[c, 0] * light[c] + noise[c, 1]) / light[c], np.float32(1e-9))
        weights[c] = _LUMA[c] * np.sqrt(light[c])
    weights /= weights.sum()
    white = np.sqrt((weights * grain * grain).sum())
    own = np.minimum(grain / white, ONE)
    luma, fine = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    variance, coloured = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    there, share = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            total, square, hued, lost = ZERO, ZERO, ZERO, False
            for c in range(channels):
                power = (noise[c, 0] * max(y[c, i, j], ZERO) + noise[c, 1]) / (light[c] * light[c])
                total += weights[c] * left[c, i, j] / light[c]
                square += weights[c] * power
                w = weights[c]
                hued += _AVERAGED[c] * (ONE - w - w + np.float32(channels) * w * w) * power
                lost = lost or y[c, i, j] >= clip[c]
            variance[i, j], coloured[i, j] = square, hued
            there[i, j], luma[i, j] = ZERO if lost else ONE, ZERO if lost else total
    smooth(there, _BINOMIAL, share, wrapped=False)
    smooth(luma, _BINOMIAL, fine, wrapped=False)
    for i in range(rows):
        for j in range(cols):
            mean = fine[i, j] / max(share[i, j], np.float32(1e-3))
            fine[i, j] = luma[i, j] - mean if there[i, j] > ZERO else ZERO
    _coarse(left, known, light, weights, out, luma)
    _without_noise(out, coloured, share, there)
    kept = _share_of_noise(fine, variance, share, there)
    for i in range(rows):
        for j in range(cols):
            within = _GRAIN * np.sqrt(variance[i, j])
            whole = kept[i, j] * min(max(fine[i, j], -within), within)
            for c in range(channels):
                out[c, i, j] = light[c] * (luma[i, j] + out[c, i, j] + own[c] * whole)
        for k in range(channels):
            for j in range(cols):
                if not known[k, i, j]:
                    continue
                within = _GRAIN * np.sqrt(noise[k, 0] * max(y[k, i, j], ZERO) + noise[k, 1])
                measured = (ONE - kept[i, j]) * min(max(left[k, i, j], -within), within) / light[k]
                for c in range(channels):
                    out[c, i, j] += measured * light[c] * min(ONE, grain[c] / grain[k])
        for c in range(channels):
            for j in range(cols):
                if y[c, i, j] >= clip[c]:
                    out[c, i, j] = ZERO


@jit
def _coarse(
    left: Real, known: NDArray[np.bool_], light: Real, weights: Real, chroma: Real, luma: Real
) -> None:
    """Local means of the measured residuals as luma and chroma, over the light; they are taken off `left`."""
    channels, rows, cols = left.shape
    mask, there = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    luma[:] = ZERO
    for c in range(channels):
        for i in range(rows):
            for j in range(cols):
                mask[i, j] = ONE if known[c, i, j] else ZERO
                if not known[c, i, j]:
                    left[c, i, j] = ZERO
        smooth(mask, _BINOMIAL, there, wrapped=False)
        smooth(left[c], _BINOMIAL, chroma[c], wrapped=False)
        for i in range(rows):
            for j in range(cols):
                mean = chroma[c, i, j] / max(there[i, j], np.float32(1e-3))
                left[c, i, j] -= mean
                chroma[c, i, j] = mean / light[c]
                luma[i, j] += weights[c] * chroma[c, i, j]
    for c in range(channels):
        for i in range(rows):
            for j in range(cols):
                chroma[c, i, j] -= luma[i, j]


@jit
def _without_noise(chroma: Real, noise: Real, power: Real, work: Real) -> None:
    """Lower chroma as far as noise explains its power nearby, in place."""
    channels, rows, cols = chroma.shape
    for i in range(rows):
        for j in range(cols):
            square = ZERO
            for c in range(channels):
                square += chroma[c, i, j] * chroma[c, i, j]
            work[i, j] = square
    smooth(work, _AROUND, power, wrapped=False)
    smooth(noise, _AROUND, work, wrapped=False)
    for i in range(rows):
        for j in range(cols):
            share = max(ONE - _COLOURED * work[i, j] / max(power[i, j], np.float32(1e-20)), ZERO)
            for c in range(channels):
                chroma[c, i, j] *= share


@jit
def _share_of_noise(fine: Real, variance: Real, power: Real, work: Real) -> Real:
    """1 where the power of `fine` nearby is that of noise, 0 where it is that of detail."""
    rows, cols = fine.shape
    kept = np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            work[i, j] = fine[i, j] * fine[i, j]
    smooth(work, _AROUND, power, wrapped=False)
    smooth(variance, _AROUND, work, wrapped=False)
    span: Number = ONE / (_DETAIL - _NOISE)
    for i in range(rows):
        for j in range(cols):
            ratio = power[i, j] / max(work[i, j], np.float32(1e-20))
            t = min(max((ratio - _NOISE) * span, ZERO), ONE)
            kept[i, j] = ONE - t * t * (np.float32(3.0) - t - t)
    return kept
