"""Of a mosaic: red and blue between their pixels, and the grain that a prior took."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Planes
from lensmodel.correction.blur import ONE, ZERO, Canvas, Real, smooth
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.expected_gain import wiener_spectrum

_WINDOW: Final = 2.0
"""Standard deviation in pixels of the windows in which a colour is a straight line over green: about ten
of red or blue, few enough for a line and enough against noise (chosen). Gaussian, because a square holds
more or fewer of them depending on where it begins, which shows as the mosaic's pattern beside
coloured edges."""
_RIDGE: Final = np.float32(0.02)
"""Share of the squared mean light of a window that is added to the variance of green in it: where green
is flat, the slope is that of a constant hue (chosen)."""
_GAUSSIAN: Final = np.exp(-0.5 * (np.arange(-8, 9) / _WINDOW) ** 2).astype(np.float32)
_BETWEEN: Final = np.array([0.25, 0.5, 0.25], dtype=np.float32)
"""Bilinear interpolation over every second pixel, once divided by the same filter of the mask."""

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


def refill(
    y: Planes,
    K: NDArray[np.complex64],
    noise: Real,
    variance: Real,
    sensors: Sequence[Sensor],
    canvas: Canvas,
) -> None:
    """Fill in red and blue where no pixel measured them, in place, as the lens would show them.

    Demosaicing copies detail from green that is sharper than blue light can be behind most lenses, of which
    undoing blue's blur would make coloured edges. So it is blurred first as the colour itself is: with x_g
    Wiener's estimate of green, each colour is predicted from p = K_c x_g by residual interpolation, a line
    y = a p + b in each window, and the residual at measured pixels is interpolated. No frequency of p is
    stronger than in green itself, or the mosaic's own pattern would come back::

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
        predicted = _lines(y[c], p, known)
        residual = _smoothed(known * (y[c] - predicted), _BETWEEN, wrapped=True)
        predicted += residual / np.maximum(_smoothed(known, _BETWEEN, wrapped=True), np.float32(1e-3))
        np.copyto(y[c][canvas.data], predicted[canvas.data], where=~measured)


def _lines(y: Real, p: Real, known: Real) -> Real:
    """A p + b of each window's least squares over known pixels, its slope pulled to that of one hue."""
    parts = (known, known * p, known * y, known * p * y, known * p * p)
    count, *sums = (_smoothed(part, _GAUSSIAN, wrapped=True) for part in parts)
    mean_p, mean_y, product, square = (each / np.maximum(count, np.float32(1e-9)) for each in sums)
    ridge = _RIDGE * mean_p * mean_p + np.float32(1e-9)
    hue = np.clip(mean_y / np.maximum(mean_p, np.float32(1e-6)), 0.0, 8.0)
    slope = (product - mean_p * mean_y + ridge * hue) / (square - mean_p * mean_p + ridge)
    return np.asarray(mean_y + slope * (p - mean_p), dtype=np.float32)


def _smoothed(plane: Real, weights: Real, *, wrapped: bool = False) -> Real:
    """Filter a plane along rows and columns; it continues periodically, or with zeros."""
    out = np.empty_like(plane)
    smooth(plane, weights, out, wrapped)
    return out


def spread_grain(
    photo: Planes, left: Planes, clipped: NDArray[np.bool_], sensors: Sequence[Sensor], light: Real
) -> Planes:
    """What a prior took of a mosaic, to be added back: grain in light of no colour.

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
    known, bright, lost = ~clipped, light[:, None, None], clipped.any(axis=0)
    for c, sensor in enumerate(sensors):
        if sensor.measured is not None:
            known[c] &= sensor.measured
    shot, read = np.array([[s.noise.shot, s.noise.read] for s in sensors], dtype=np.float32).T
    grain = np.maximum(np.sqrt(shot * light + read) / light, np.float32(1e-9))
    w = (_LUMA * np.sqrt(light))[:, None, None]
    w /= w.sum()
    white = np.sqrt((w.ravel() * grain * grain).sum())

    noise = shot[:, None, None] * np.maximum(photo, ZERO) + read[:, None, None]
    power = noise / (bright * bright)
    variance: Real = (w * power).sum(axis=0)
    coloured: Real = (_AVERAGED[:, None, None] * (ONE - w - w + len(photo) * w * w) * power).sum(axis=0)
    fine: Real = (w * left / bright).sum(axis=0)
    fine[lost] = ZERO
    near = np.maximum(_smoothed(np.asarray(~lost, dtype=np.float32), _BINOMIAL), np.float32(1e-3))
    fine -= _smoothed(fine, _BINOMIAL) / near
    fine[lost] = ZERO

    left = np.where(known, left, ZERO)
    counted = [_smoothed(mask.astype(np.float32), _BINOMIAL) for mask in known]
    means = np.stack([_smoothed(plane, _BINOMIAL) for plane in left]) / np.maximum(counted, np.float32(1e-3))
    coarse = (w * means / bright).sum(axis=0)
    chroma = means / bright - coarse
    squares: Real = np.square(chroma).sum(axis=0)
    hue = np.maximum(_smoothed(squares, _AROUND), np.float32(1e-20))
    chroma *= np.maximum(ONE - _COLOURED * _smoothed(coloured, _AROUND) / hue, ZERO)

    ratio = _smoothed(fine * fine, _AROUND) / np.maximum(_smoothed(variance, _AROUND), np.float32(1e-20))
    t = np.clip((ratio - _NOISE) / (_DETAIL - _NOISE), ZERO, ONE)
    kept = ONE - t * t * (np.float32(3.0) - t - t)  # 1 where it is noise, 0 where it is detail
    within = _GRAIN * np.sqrt(variance)
    whole = kept * np.clip(fine, -within, within)
    within = _GRAIN * np.sqrt(noise)
    measured = known * (ONE - kept) * np.clip(left - means, -within, within) / bright
    shares = np.minimum(grain[:, None] / grain, ONE)
    own = np.minimum(grain / white, ONE)[:, None, None]
    back = coarse + chroma + own * whole + np.tensordot(shares, measured, axes=1)
    return np.asarray(np.where(clipped, ZERO, bright * back), dtype=np.float32)
