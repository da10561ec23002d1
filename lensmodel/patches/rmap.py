"""The r-map of Xu and Jia: where edges tell about the blur, and where fine texture misleads."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Plane

SMOOTHING_PX: Final = 1.0  # of the Gaussian before every gradient: noise would enter r's denominator
FLAT_CONSTANT: Final = 0.5  # suppresses flat regions, for intensities of 0..1 (Xu and Jia)
WINDOW: Final = 25  # pixels: the window for which that was chosen
R_BINS: Final = 16  # of the histogram of r: finer than its threshold has to be (chosen)
GROUPS: Final = 4  # of gradient directions: Xu and Jia 2010, sec. 3.1


def smoothed_gradients(plane: Plane) -> tuple[Plane, Plane, Plane]:
    """Return the smoothed plane and its central differences along rows and columns."""
    smooth = np.asarray(ndimage.gaussian_filter(plane, SMOOTHING_PX, truncate=3.0), dtype=np.float32)
    along_rows, along_cols = (np.asarray(part, dtype=np.float32) for part in np.gradient(smooth))
    return smooth, along_rows, along_cols


def gradient_noise() -> float:
    """Standard deviation of one smoothed gradient component for white noise of 1, by the filter itself."""
    impulse = np.zeros((17, 17), dtype=np.float32)
    impulse[8, 8] = 1.0
    _, response, _ = smoothed_gradients(impulse)
    return math.sqrt(float(np.square(response, dtype=np.float64).sum()))


def r_of_gradients(along_rows: Plane, along_cols: Plane, size: Plane, scale: float) -> Plane:
    """Evaluate r from gradients and their moduli; `scale` is the intensity that counts as 1."""
    pixels = float(WINDOW * WINDOW)
    sums = [ndimage.uniform_filter(part, WINDOW) * pixels for part in (along_rows, along_cols, size)]
    return np.asarray(np.hypot(sums[0], sums[1]) / (sums[2] + FLAT_CONSTANT * scale), dtype=np.float32)


def r_map(plane: Plane) -> Plane:
    """Map how useful the edges around each pixel are for kernel estimation, 0..1.

    With N(x) the 25 x 25 neighbourhood of x::

        r(x) = | sum_N grad B | / ( sum_N |grad B| + 0.5 )

    The numerator is the modulus of a vector sum: the two flanks of a bar narrower than the blur cancel, so
    that r is small on fine texture, which misleads estimation from edges, and large at long isolated steps.
    The constant holds down flat regions.

    Source: L. Xu and J. Jia, "Two-phase kernel estimation for robust motion deblurring", ECCV 2010, eq. (2);
    here the plane is smoothed by a Gaussian of 1 px first.
    """
    _, along_rows, along_cols = smoothed_gradients(plane)
    return r_of_gradients(along_rows, along_cols, np.hypot(along_rows, along_cols), 1.0)


def automatic_threshold(histogram: NDArray[np.int64], pixels: int, kernel_pixels: int) -> int:
    """Highest r-bin from which on 0.5 sqrt(N_I N_k) pixels of each direction lie (Xu and Jia, sec. 3.1)."""
    wanted = 0.5 * math.sqrt(float(pixels) * float(kernel_pixels))
    kept = histogram[:, ::-1].cumsum(axis=1)[:, ::-1]
    enough = np.flatnonzero((kept >= wanted).all(axis=0))
    return int(enough[-1]) if enough.size else 0
