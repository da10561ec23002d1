"""Local statistics of a picture: what is signal, what is noise."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

_WINDOW = 7
_UNSURE = np.float32(0.1)  # share of the noise that a variance over so few pixels cannot tell from signal


def smoothed(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Local mean of a plane over some 13 pixels.

    Two running means cost the same at any width, unlike a Gaussian.
    """
    once = ndimage.uniform_filter(plane, _WINDOW, mode="nearest")
    return np.asarray(ndimage.uniform_filter(once, _WINDOW, mode="nearest"), dtype=np.float32)


def signal_variance(plane: NDArray[np.float32], noise: NDArray[np.float32] | float) -> NDArray[np.float32]:
    """Local variance of a plane less that of its noise; never below a tenth of the noise.

    Parameters
    ----------
    plane : ndarray, shape (h, w)
        Linear light.
    noise : ndarray or float
        Variance of its noise.
    """
    mean = smoothed(plane)
    local = smoothed(plane * plane) - mean * mean
    return np.asarray(np.maximum(local - noise, 0.0) + _UNSURE * noise + np.float32(1e-12), dtype=np.float32)
