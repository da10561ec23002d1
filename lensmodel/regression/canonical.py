"""Kernels in the local frame: resampled once when stored, and once more at the query.

A pixel kernel turned by linear interpolation loses its sharpness. Here it becomes a cubic spline,
sampled three times finer in its own radial frame, and meets the pixel grid again only when a
PSF is asked for.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.geometry import local_to_pixel, pixel_to_local
from lensmodel.psf import centred
from lensmodel.types import Kernel

OVERSAMPLING = 3


def to_canonical(kernel: Kernel, phi: float, half: int) -> NDArray[np.float32]:
    """Resample a kernel into the frame (v rows upwards-negative, u columns) of a place at angle `phi`.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
        In the image frame.
    phi : float
        Angle of its place.
    half : int
        Half side of the result in pixels.

    Returns
    -------
    ndarray of float32, shape (2 * 3 * half + 1,) * 2
        Values at (row -> -v, col -> u) in steps of a third of a pixel: the frame in which phi = 0.
    """
    t = np.arange(-half * OVERSAMPLING, half * OVERSAMPLING + 1) / OVERSAMPLING
    u, v = t[None, :], -t[:, None]
    drow, dcol = local_to_pixel(u, v, phi)
    middle = kernel.shape[0] // 2
    fine = ndimage.map_coordinates(
        kernel, np.stack([drow + middle, dcol + middle]), order=3, mode="grid-constant", cval=0.0
    )
    return np.asarray(fine, dtype=np.float32)


def from_canonical(fine: NDArray[np.floating], phi: float, size: int) -> Kernel:
    """Sample a canonical kernel at the pixels of a place at angle `phi`; centred, sum 1."""
    half = size // 2
    t = np.arange(-half, half + 1)
    u, v = pixel_to_local(t[:, None], t[None, :], phi)
    middle = fine.shape[0] // 2
    values = ndimage.map_coordinates(
        np.asarray(fine, dtype=np.float64),
        np.stack([middle - v * OVERSAMPLING, middle + u * OVERSAMPLING]),
        order=3,
        mode="grid-constant",
        cval=0.0,
    )
    return centred(np.maximum(values, 0.0))
