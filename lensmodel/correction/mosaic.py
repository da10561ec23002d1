"""Of a mosaic: red and blue between their pixels, and the grain that a prior took."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.numerics import jit
from lensmodel.core.types import Planes
from lensmodel.correction.blur import ONE, ZERO, Canvas, Number, Real, smooth
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.expected_gain import wiener_spectrum

Mask = NDArray[np.bool_]

_WINDOW: Final = 2.0
"""Sigma in pixels of windows: ten of red or blue each (chosen; squares would show the mosaic's pattern)."""
_RIDGE: Final = np.float32(0.02)
"""Share of squared light added to the variance of green: where it is flat, hue is constant (chosen)."""
_GAUSSIAN: Final = np.exp(-0.5 * (np.arange(-8, 9) / _WINDOW) ** 2).astype(np.float32)
_BETWEEN: Final = np.array([0.25, 0.5, 0.25], dtype=np.float32)  # bilinear

_GRAIN: Final = np.float32(2.5)  # sigmas within which a residual is grain (chosen: further out, the PSF errs)
_LUMA: Final = np.array([0.25, 0.6, 0.15], dtype=np.float32)  # Rec. 709 after a usual matrix
_NOISE, _DETAIL = np.float32(0.4), np.float32(0.7)  # demosaiced over sensor's power (chosen)
_AVERAGED: Final = np.array([0.3, 0.15, 0.3], dtype=np.float32)  # one over the pixels under `_BINOMIAL`
_COLOURED: Final = np.float32(0.5)
"""Times its noise by which coloured power is lowered (chosen: keeps the colour of leaves)."""
_BINOMIAL: Final = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / np.float32(16.0)
_AROUND: Final = np.full(7, 1.0 / 7.0, dtype=np.float32)


def refill(
    y: Planes,
    K: NDArray[np.complex64],
    noise: Real,
    variance: Real,
    sensors: Sequence[Sensor],
    canvas: Canvas,
) -> None:
    """Fill in red and blue where no pixel measured them, in place, as the lens would show them.

    Demosaicing copies fine detail from green into red and blue. Behind a lens that is sharp in green and
    soft in blue, as most are, that detail is sharper than blue light can be, and undoing blue's blur on
    it makes coloured edges of it. So the detail is blurred first as the colour itself is: with x_g Wiener's
    estimate of green, each colour is predicted from p = K_c x_g by residual interpolation, a line
    y = a p + b in each window, and the residual at measured pixels is interpolated. No frequency of p is
    stronger than in green itself: a blue that is believed to be sharper would get the mosaic's own pattern::

        y_c = a p + b + interpolated( y_c - a p - b )

    D. Kiku, Y. Monno, M. Tanaka, M. Okutomi, "Residual interpolation for color image demosaicking", ICIP
    2013, section 3. `y` is scaled to equal light, `noise` and `variance` are those of its colours.
    """
    shape = (y.shape[1], y.shape[2])
    green = np.asarray(fft.rfft2(y[1]), dtype=np.complex64)
    sharp = wiener_spectrum(y[1], K[1], float(noise[1]), float(variance[1]))
    light = np.maximum(np.abs(green), np.float32(1e-12))
    for c in (0, 2):
        measured = sensors[c].measured
        if measured is None:
            continue
        known = np.zeros(shape, dtype=np.float32)
        known[canvas.data] = measured
        guide = K[c] * sharp
        guide /= np.maximum(np.abs(guide) / light, np.float32(1.0))
        p = np.asarray(fft.irfft2(guide, shape), dtype=np.float32)
        predicted = np.empty_like(p)
        _lines(y[c], p, known, _GAUSSIAN, _RIDGE, predicted)
        residual = known * (y[c] - predicted)
        share, between = np.empty_like(p), np.empty_like(p)
        smooth(known, _BETWEEN, share, wrapped=True)
        smooth(residual, _BETWEEN, between, wrapped=True)
        predicted += between / np.maximum(share, np.float32(1e-3))
        np.copyto(y[c][canvas.data], predicted[canvas.data], where=~measured)


@jit
def _lines(y: Real, p: Real, known: Real, weights: Real, least: Number, out: Real) -> None:
    """A p + b of each window's least squares over known pixels, its slope pulled to that of one hue."""
    rows, cols = y.shape
    sums = np.empty((5, rows, cols), np.float32)
    part = np.empty((rows, cols), np.float32)
    tiny, small, most = np.float32(1e-9), np.float32(1e-6), np.float32(8.0)
    for number in range(5):
        for i in range(rows):
            for j in range(cols):
                k, a, b = known[i, j], p[i, j], y[i, j]
                if number == 1:
                    k *= a
                elif number == 2:
                    k *= b
                elif number == 3:
                    k *= a * b
                elif number == 4:
                    k *= a * a
                part[i, j] = k
        smooth(part, weights, sums[number], wrapped=True)
    for i in range(rows):
        for j in range(cols):
            share = np.float32(1.0) / max(sums[0, i, j], tiny)
            mean_p, mean_y = sums[1, i, j] * share, sums[2, i, j] * share
            ridge = least * mean_p * mean_p + tiny
            hue = min(max(mean_y / max(mean_p, small), np.float32(0.0)), most)
            covariance = sums[3, i, j] * share - mean_p * mean_y + ridge * hue
            slope = covariance / (sums[4, i, j] * share - mean_p * mean_p + ridge)
            out[i, j] = mean_y + slope * (p[i, j] - mean_p)


def spread_grain(
    photo: Planes, left: Planes, clipped: NDArray[np.bool_], sensors: Sequence[Sensor], light: Real
) -> Planes:
    """What a prior took of a mosaic, to be added back: grain in light of no colour; `left` is overwritten.

    In a mosaic each pixel measures one colour k; L is the mean light, n the noise of a colour over it,
    and w weighs colours as they are seen. Of the measured residual e, the means S over 5 x 5 pixels are
    coarse grain and detail, their chroma as far as it exceeds its noise (a share q). Fine grain is that
    which one sees in the photo: of the demosaiced residual d, in light of no colour, within a few
    standard deviations of the noise, f = sum w_k ( d_k - mean d_k ) / L_k. Where more than noise is in
    it, t = 0, demosaicing made detail of its own, and the measured residual counts for all colours.
    Either is never more than the grain of a colour, or grain would be coloured::

        s = sum w_k S_k / L_k,    m² = sum w_k n_k²
        r_c / L_c = s + q ( S_c / L_c - s )
                      + t min(1, n_c / m) f + (1 - t) min(1, n_c / n_k) ( e_k - S_k ) / L_k
    """
    known = ~clipped
    for c, sensor in enumerate(sensors):
        if sensor.measured is not None:
            known[c] &= sensor.measured
    noise = np.array([[s.noise.shot, s.noise.read] for s in sensors], dtype=np.float32)
    out = np.empty_like(photo)
    _spread_grain(photo, left, known, clipped, noise, light, out)
    return out


@jit
def _spread_grain(  # noqa: C901, PLR0912 - a few passes over one tile
    y: Real, left: Real, known: Mask, clipped: Mask, noise: Real, light: Real, out: Real
) -> None:
    """Fill `out` with what to add back of `left`; `known` marks the pixels that a colour was measured at."""
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
                lost = lost or clipped[c, i, j]
            variance[i, j], coloured[i, j] = square, hued
            there[i, j], luma[i, j] = ZERO if lost else ONE, ZERO if lost else total
    smooth(there, _BINOMIAL, share, wrapped=False)
    smooth(luma, _BINOMIAL, fine, wrapped=False)
    for i in range(rows):
        for j in range(cols):
            mean = fine[i, j] / max(share[i, j], np.float32(1e-3))
            fine[i, j] = luma[i, j] - mean if there[i, j] > ZERO else ZERO
    _coarse(left, known, light, weights, out, luma)
    kept = np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            kept[i, j] = fine[i, j] * fine[i, j]
            there[i, j] = (
                out[0, i, j] * out[0, i, j] + out[1, i, j] * out[1, i, j] + out[2, i, j] * out[2, i, j]
            )
    _over_noise(kept, variance, share)
    _over_noise(there, coloured, share)
    for i in range(rows):
        for j in range(cols):
            t = min(max((kept[i, j] - _NOISE) / (_DETAIL - _NOISE), ZERO), ONE)
            kept[i, j] = ONE - t * t * (np.float32(3.0) - t - t)  # 0 where the power of detail is in it
            q = max(ONE - _COLOURED / max(there[i, j], np.float32(1e-20)), ZERO)
            for c in range(channels):
                out[c, i, j] *= q
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
                if clipped[c, i, j]:
                    out[c, i, j] = ZERO


@jit
def _coarse(left: Real, known: Mask, light: Real, weights: Real, chroma: Real, luma: Real) -> None:
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
def _over_noise(power: Real, noise: Real, work: Real) -> None:
    """Turn power into that nearby over the noise nearby, in place."""
    smooth(power, _AROUND, work, wrapped=False)
    smooth(noise, _AROUND, power, wrapped=False)
    for i in range(power.shape[0]):
        for j in range(power.shape[1]):
            power[i, j] = work[i, j] / max(power[i, j], np.float32(1e-20))
