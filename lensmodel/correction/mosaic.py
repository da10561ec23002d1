"""Of a mosaic: red and blue between their pixels, and the grain that a prior took."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Planes
from lensmodel.correction.blur import ONE, ZERO, Canvas, Mask, Real, smooth
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.expected_gain import wiener_spectrum

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
        guide /= np.maximum(np.abs(guide) / light, ONE)
        p = np.asarray(fft.irfft2(guide, shape), dtype=np.float32)
        predicted = _lines(y[c], p, known)
        residual = smooth(known * (y[c] - predicted), _BETWEEN, True)
        predicted += residual / np.maximum(smooth(known, _BETWEEN, True), np.float32(1e-3))
        np.copyto(y[c][canvas.data], predicted[canvas.data], where=~measured)


def _lines(y: Real, p: Real, known: Real) -> Real:
    """A p + b of each window's least squares over known pixels, its slope pulled to that of one hue."""
    a, b = known * p, known * y
    share, mean_p, mean_y, py, pp = (smooth(part, _GAUSSIAN, True) for part in (known, a, b, a * y, a * p))
    share = np.reciprocal(np.maximum(share, np.float32(1e-9)))
    mean_p *= share
    mean_y *= share
    ridge = _RIDGE * mean_p * mean_p + np.float32(1e-9)
    hue = np.clip(mean_y / np.maximum(mean_p, np.float32(1e-6)), ZERO, np.float32(8.0))
    covariance = py * share - mean_p * mean_y + ridge * hue
    slope = covariance / (pp * share - mean_p * mean_p + ridge)
    return np.asarray(mean_y + slope * (p - mean_p), dtype=np.float32)


def spread_grain(
    photo: Planes, left: Planes, clipped: Mask, sensors: Sequence[Sensor], light: Real
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
    scale = light[:, None, None]
    noise = np.array([[s.noise.shot, s.noise.read] for s in sensors], dtype=np.float32)
    variance = noise[:, :1, None] * np.maximum(photo, ZERO) + noise[:, 1:, None]
    grain = np.maximum(np.sqrt(noise[:, 0] * light + noise[:, 1]) / light, np.float32(1e-9))
    weights = _LUMA * np.sqrt(light)
    weights /= weights.sum()
    white = np.sqrt(np.square(grain) @ weights)
    square = np.einsum("c,cij", weights / light**2, variance)

    there = ONE - np.maximum.reduce(clipped, dtype=np.float32)
    luma = there * np.einsum("c,cij", weights / light, left)
    share = np.maximum(smooth(there, _BINOMIAL), np.float32(1e-3))
    fine = there * (luma - smooth(luma, _BINOMIAL) / share)
    t = np.clip((_over_noise(fine * fine, square) - _NOISE) / (_DETAIL - _NOISE), ZERO, ONE)
    kept = ONE - t * t * (np.float32(3.0) - t - t)  # 0 where the power of detail is in it
    fine = kept * _within(fine, _GRAIN * np.sqrt(square))

    left *= known
    coarse = np.empty_like(left)
    for into, plane, own in zip(coarse, left, known.astype(np.float32), strict=True):
        np.divide(smooth(plane, _BINOMIAL), np.maximum(smooth(own, _BINOMIAL), np.float32(1e-3)), out=into)
    left -= coarse
    measured = known * _within(left, _GRAIN * np.sqrt(variance)) * (ONE - kept)
    coarse /= scale
    luma = np.einsum("c,cij", weights, coarse)
    coarse -= luma
    hued = _AVERAGED * (ONE - weights - weights + np.float32(3.0) * weights**2) / light**2
    coloured = _over_noise(np.einsum("cij,cij->ij", coarse, coarse), np.einsum("c,cij", hued, variance))
    coarse *= np.maximum(ONE - _COLOURED / np.maximum(coloured, np.float32(1e-20)), ZERO)

    out = coarse + luma
    out += np.minimum(grain / white, ONE)[:, None, None] * fine
    out += np.einsum("ck,kij", np.minimum(grain[:, None] / grain, ONE) / light, measured)
    out *= scale
    out[clipped] = 0.0
    return out


def _within(planes: Real, bound: Real) -> Real:
    """Hold planes within a bound of either sign."""
    return np.minimum(np.maximum(planes, -bound), bound)


def _over_noise(power: Real, noise: Real) -> Real:
    """Power nearby over the noise nearby."""
    over: Real = np.maximum(smooth(noise, _AROUND), np.float32(1e-20))
    return np.divide(smooth(power, _AROUND), over)
