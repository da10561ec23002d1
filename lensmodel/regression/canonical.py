"""Kernels in the local frame: resampled once when stored, and once more at the query.

A pixel kernel turned by linear interpolation loses its sharpness. Here it is a cubic spline,
sampled three times finer in its own radial frame, and meets the pixel grid again only when a PSF
is asked for. On the way in the axes may be divided by a width (see `transport`), so that kernels
of different places lie on top of each other::

    C(a, b) = s_u s_v P(s_u a, s_v b)           (u, v) = (s_u a, s_v b) in pixels

What is stored are spline coefficients: they are linear in the kernel, so their weighted mean is
the spline of the weighted mean, and a query filters nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.geometry import local_to_pixel, pixel_to_local
from lensmodel.psf import as_kernel, centroid
from lensmodel.types import Kernel

DEFAULT_OVERSAMPLING = 3
_CENTRED_PX = 5e-4
_STEPS = 6


@dataclass(frozen=True, slots=True)
class CanonicalGrid:
    """The square grid of the local frame: rows grow towards -v, columns towards u.

    Parameters
    ----------
    half : int
        Half side in reference pixels.
    oversampling : int
        Samples per reference pixel.
    """

    half: int
    oversampling: int = DEFAULT_OVERSAMPLING

    @property
    def side(self) -> int:
        """Number of samples along one side."""
        return 2 * self.half * self.oversampling + 1

    @property
    def axis(self) -> NDArray[np.float64]:
        """Coordinates of the samples along one side, in reference pixels."""
        reach = self.half * self.oversampling
        return np.arange(-reach, reach + 1) / self.oversampling

    def values(self, kernel: Kernel, phi: float, scale: tuple[float, float]) -> NDArray[np.float64]:
        """Resample a kernel of the image frame onto this grid.

        Parameters
        ----------
        kernel : Kernel, shape (k, k)
            In the image frame of a place at angle `phi`.
        phi : float
            Angle of its place in radians.
        scale : tuple of float
            Widths (s_u, s_v) by which the axes are divided.

        Returns
        -------
        ndarray, shape (side, side)
            Density of light per reference pixel.
        """
        t, middle = self.axis, kernel.shape[0] // 2
        drow, dcol = local_to_pixel(t[None, :] * scale[0], -t[:, None] * scale[1], phi)
        points = np.stack([drow + middle, dcol + middle])
        found = ndimage.map_coordinates(kernel, points, order=3, mode="grid-constant", cval=0.0)
        return np.asarray(found * (scale[0] * scale[1]), dtype=np.float64)

    def coefficients(self, kernel: Kernel, phi: float, scale: tuple[float, float]) -> NDArray[np.float32]:
        """Spline coefficients of `values`, flat, float32: what is stored of a sample."""
        spline = ndimage.spline_filter(self.values(kernel, phi, scale), order=3, mode="grid-constant")
        return np.asarray(spline, dtype=np.float32).ravel()

    def sampled(
        self,
        coefficients: NDArray[np.floating],
        phi: float,
        scale: tuple[float, float],
        size: int,
        shift: tuple[float, float] = (0.0, 0.0),
    ) -> NDArray[np.float64]:
        """Values at the pixels of a place at angle `phi`, the image moved by `shift` (row, col) pixels."""
        half = size // 2
        t = np.arange(-half, half + 1, dtype=np.float64)
        u, v = pixel_to_local(t[:, None] - shift[0], t[None, :] - shift[1], phi)
        middle, over = self.half * self.oversampling, self.oversampling
        points = np.stack([middle - v * (over / scale[1]), middle + u * (over / scale[0])])
        spline = np.asarray(coefficients, dtype=np.float64).reshape(self.side, self.side)
        found = ndimage.map_coordinates(
            spline, points, order=3, mode="grid-constant", cval=0.0, prefilter=False
        )
        return np.asarray(found / (scale[0] * scale[1]), dtype=np.float64)

    def kernel(
        self, coefficients: NDArray[np.floating], phi: float, scale: tuple[float, float], size: int
    ) -> Kernel:
        """Kernel of the image frame: non-negative, sum 1, centre of mass on the middle pixel.

        Centring moves the points at which the spline is read: the kernel is not resampled again.
        """
        shift = (0.0, 0.0)
        light = np.empty(0)
        for _ in range(_STEPS):
            light = _without_negatives(self.sampled(coefficients, phi, scale, size, shift))
            row, col = centroid(light)
            if math.hypot(row, col) < _CENTRED_PX:
                break
            shift = (shift[0] - row, shift[1] - col)
        return as_kernel(light)


def _without_negatives(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Nearest array, in L2, that is not negative and has the same sum.

    max(x - t, 0) with t such that the sum stays: clipping alone would keep the crests of a spline's
    ripples round a sharp kernel and drop their troughs. Source: W. Wang, M. A. Carreira-Perpinan,
    "Projection onto the probability simplex", arXiv 1309.1541, 2013.
    """
    total = float(values.sum())
    if values.min() >= 0.0 and total > 0.0:
        return values
    if total <= 0.0:
        return np.where(values == values.max(), 1.0, 0.0)
    falling = np.sort(values, axis=None)[::-1]
    excess = (np.cumsum(falling) - total) / np.arange(1, falling.size + 1)
    t = excess[np.flatnonzero(falling > excess)[-1]]
    return np.asarray(np.maximum(values - t, 0.0))
