"""Kernels as cubic splines on a grid twice as fine as the pixel; `loops.sums` reads them.

A sample is stored once, as the coefficients of a spline. An answer reads the splines of the neighbours
at its own pixels q::

    f(q) = sum_i w_i |M_i| S_i(M_i (q - shift)),    S(p) = sum_k c_k B3(p_r - k_r) B3(p_c - k_c)

so turns and scales between two places cost one resampling, at the question. A cubic spline on the pixels
themselves would be off by 0.7 percent of the peak where a Gaussian of 1.1 px is turned by 45 degrees; a
spline of degree 7 is off by 0.09 percent. It fills the finer grid. Kernels so narrow that the pixels do not
hold them (their spectrum reaches the Nyquist frequency) ripple between the pixels with a high degree, and
are filled with the cubic one.

Source: M. Unser, "Splines: a perfect fit for signal and image processing", IEEE Signal Processing
Magazine 16, 1999.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import scipy  # `interpolate` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

_LIGHT = 1e-6  # of the peak: fainter pixels do not widen the spline
_REACH = 2.0 * 2.0**0.5  # of a coefficient, along the diagonal

FINER = 2
"""Coefficients for each pixel along an axis; 1 where memory is short."""

# Degrees: near the band limit where light is smooth, short where it is narrow (chosen)
_SMOOTH, _NARROW = 7, 3
_ALIASED = (0.05, 0.2)  # contrast at the Nyquist frequency: below, above
_MARGIN = 8  # pixels: the spline's response has fallen to 3e-5 there


@lru_cache(maxsize=16)
def _refining(side: int, degree: int, finer: int) -> NDArray[np.float64]:
    """Matrix from the pixels of an axis to the coefficients of the finer grid."""
    half = side // 2
    reach = half * finer
    pixels = np.zeros((side + 2 * _MARGIN, side))
    pixels[_MARGIN : _MARGIN + side] = np.eye(side)
    through = scipy.interpolate.make_interp_spline(
        np.arange(-half - _MARGIN, half + _MARGIN + 1), pixels, k=degree
    )
    matrix = _inverse(2 * reach + 1) @ through(np.arange(-reach, reach + 1) / finer)
    matrix.setflags(write=False)
    return np.asarray(matrix)


def _inverse(side: int) -> NDArray[np.float64]:
    """Inverse of the matrix that samples a cubic B-spline of `side` coefficients, zeros around."""
    sampling = np.diag(np.full(side, 4.0)) + np.diag(np.ones(side - 1), 1) + np.diag(np.ones(side - 1), -1)
    return np.asarray(np.linalg.inv(sampling / 6.0))


def coefficients(kernel: NDArray[np.floating], finer: int = FINER) -> NDArray[np.float64]:
    """Coefficients of the spline through the pixels of a kernel, `(k, k)` to `(finer (k - 1) + 1,) * 2`."""
    turns = 1.0 - 2.0 * (np.arange(kernel.shape[0]) % 2)
    contrast = max(abs(float(turns @ kernel.sum(axis=1))), abs(float(turns @ kernel.sum(axis=0))))
    low, high = _ALIASED
    narrow = min(max((contrast / float(kernel.sum()) - low) / (high - low), 0.0), 1.0)
    spline = np.zeros(())
    for share, degree in ((1.0 - narrow, _SMOOTH), (narrow, _NARROW)):
        if share > 0:
            refining = _refining(kernel.shape[0], degree, finer)
            spline = spline + share * (refining @ kernel @ refining.T)
    return np.asarray(spline, dtype=np.float64)


def light_radius(kernel: NDArray[np.floating]) -> float:
    """Distance in steps of the grid from the middle beyond which a spline is practically zero."""
    middle = kernel.shape[0] // 2
    rows, cols = np.nonzero(np.abs(kernel) > _LIGHT * np.abs(kernel).max())
    return float(np.hypot(rows - middle, cols - middle).max()) + _REACH
