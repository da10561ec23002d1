"""Red and blue between the pixels of a mosaic, led by green, behind a lens that blurs each differently."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.jit import jit
from lensmodel.core.types import Planes
from lensmodel.correction.compiled.common import Number, Real, smooth
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.scene_power import wiener_spectrum
from lensmodel.correction.tiles.canvas import Canvas

_WINDOW: Final = 2.0
"""Standard deviation in pixels of the windows in which a colour is a straight line over green: about ten
of red or blue, few enough for a line and enough against noise (chosen). Gaussian, because a square holds
more or fewer of them depending on where it begins, which shows as the mosaic's pattern beside
coloured edges."""

_RIDGE: Final = 0.02
"""Share of the squared mean light of a window that is added to the variance of green in it: where green
is flat, the slope is that of a constant hue (chosen)."""

_GAUSSIAN: Final = np.exp(-0.5 * (np.arange(-8, 9) / _WINDOW) ** 2).astype(np.float32)
_BETWEEN: Final = np.array([0.25, 0.5, 0.25], dtype=np.float32)
"""Bilinear interpolation over every second pixel, once divided by the same filter of the mask."""


def refilled(
    y: Planes,
    K: NDArray[np.complex64],
    noise: NDArray[np.float32],
    variance: NDArray[np.float32],
    sensors: Sequence[Sensor],
    canvas: Canvas,
) -> None:
    """Fill in red and blue where no pixel measured them, in place, as the lens would show them.

    Demosaicing copies fine detail from green into red and blue. Behind a lens that is sharp in green and
    soft in blue, as most are, that detail is sharper than blue light can be, and undoing blue's blur on
    it makes coloured edges of it. So the detail is blurred first as the colour itself is: with x_g Wiener's
    estimate of green, each colour is predicted from p = K_c x_g by residual interpolation [1]_, a line
    y = a p + b in each window, and the residual at measured pixels is interpolated. No frequency of p is
    stronger than in green itself: a blue that is believed to be sharper would get the mosaic's own pattern::

        y_c = a p + b + interpolated( y_c - a p - b )

    Parameters
    ----------
    y : Planes, shape (3, rows, cols)
        The canvas, scaled to equal light.
    K : ndarray, shape (3, rows, cols / 2 + 1)
        Transfer functions.
    noise, variance : ndarray, shape (3,)
        Variances of noise and data.
    sensors : sequence of Sensor
        Which pixels each colour measured.
    canvas : Canvas

    References
    ----------
    .. [1] D. Kiku, Y. Monno, M. Tanaka, M. Okutomi, "Residual interpolation for color image demosaicking",
       ICIP 2013, section 3.
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
        lines(y[c], p, known, _GAUSSIAN, np.float32(_RIDGE), predicted)
        residual = known * (y[c] - predicted)
        share, between = np.empty_like(p), np.empty_like(p)
        smooth(known, _BETWEEN, share, wrapped=True)
        smooth(residual, _BETWEEN, between, wrapped=True)
        predicted += between / np.maximum(share, np.float32(1e-3))
        np.copyto(y[c][canvas.data], predicted[canvas.data], where=~measured)


@jit
def lines(y: Real, p: Real, known: Real, weights: Real, least: Number, out: Real) -> None:
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
