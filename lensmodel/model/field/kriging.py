"""Covariances of places and settings, for what samples say beyond a wavefront (kriging).

Aberrations are polynomials of the field vector (x, y), so in the image frame, where no kernel is turned, what
a wavefront leaves of the kernels is smooth all over the field. Each pixel of it is a Gaussian process with
Matern-3/2 covariance over (x, y)::

    c(d) = (1 + sqrt(3) d) exp(-sqrt(3) d) G(settings),   d in half-diagonals

Source: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, ch. 4;
N. Cressie, "Statistics for Spatial Data", 1993, section 3.2.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import FieldPosition

NUGGETS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Variances of a sample of vote 1, over that of the field, that cross-validation chooses from (chosen:
finely enough for a factor, which hardly matters)."""

_SETTINGS = (3, 4, 5, 6)  # columns of `variables.COLUMNS` that are no place


def field_vector(position: FieldPosition) -> NDArray[np.float64]:
    """(x, y) to the right and up, in half-diagonals."""
    return position.r * np.array([np.cos(position.phi), np.sin(position.phi)])


def as_kernels(rows: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Rows of pixels as kernels of odd side `size`, shape (q, size, size); negative pixels become zero."""
    side = round(rows.shape[1] ** 0.5)
    kernels = np.maximum(rows.reshape(-1, side, side), 0.0)
    cut, pad = max((side - size) // 2, 0), max((size - side) // 2, 0)
    kernels = kernels[:, cut : side - cut, cut : side - cut]
    kernels = kernels / np.maximum(kernels.sum(axis=(1, 2), keepdims=True), 1e-30)
    return np.pad(kernels, ((0, 0), (pad, pad), (pad, pad))) if pad else kernels


def squared_gaps(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances of places `a` (m, 2) from places `b` (n, 2), shape (m, n)."""
    x, y = np.subtract.outer(a[:, 0], b[:, 0]), np.subtract.outer(a[:, 1], b[:, 1])
    return np.asarray(x * x + y * y)


def matern(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matern-3/2 covariance of a distance in half-diagonals."""
    scaled = np.sqrt(3.0) * distance
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def settings_gap(
    where: NDArray[np.float64], asked: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared distance of settings in bandwidths; unknown ones drop out."""
    total = np.zeros(np.broadcast_shapes(where.shape[:-1], asked.shape[:-1]))
    for column in _SETTINGS:
        values = where[..., column]
        first = values.flat[0]
        if np.isnan(asked[..., column]).all() or (
            (values == first).all() and (asked[..., column] == first).all()
        ):
            continue  # most lenses are asked for at the one setting that they have: this is the fast path
        gap = (values - asked[..., column]) / scale[column]
        total += np.where(np.isnan(gap), 0.0, gap * gap)
    return total
