"""The r-map of Xu and Jia: where gradients add up to edges, and where they cancel; and the selector by it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Plane

if TYPE_CHECKING:  # they import this module
    from lensmodel.patches.windows import Details, Windows

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


def r_bin(r: Plane) -> NDArray[np.intp]:
    """Number of the r-bin of each value, 0 to R_BINS - 1."""
    return np.minimum((r * R_BINS).astype(np.intp), R_BINS - 1)


def automatic_threshold(histogram: NDArray[np.int64], pixels: int, kernel_pixels: int) -> int:
    """Highest r-bin from which on 0.5 sqrt(N_I N_k) pixels of each direction lie (Xu and Jia, sec. 3.1)."""
    wanted = 0.5 * math.sqrt(float(pixels) * float(kernel_pixels))
    kept = histogram[:, ::-1].cumsum(axis=1)[:, ::-1]
    enough = np.flatnonzero((kept >= wanted).all(axis=0))
    return int(enough[-1]) if enough.size else 0


@dataclass(frozen=True, slots=True)
class RMapSelector:
    """Edges in every direction where the r-map is high, and signal at every frequency.

    With e the energy of the kept edges over that of noise in eight directions, e_(2) its second
    smallest entry, and S/N the spectrum over noise in 3 bands by 8 sectors::

        score = ( log10 e_(2) + mean log10 max(S/N, 1) ) / full_marks
    """

    full_marks: float = 8.0  # what counts as 1

    def score(self, windows: Windows, looked: Details) -> NDArray[np.float64]:
        """Return one score a window; see `lensmodel.Selector`."""
        information = np.maximum(looked.information, 0.0).mean(axis=(1, 2)) / np.log(10.0)
        return np.clip((edge_score(windows) + information) / self.full_marks, 0.0, 1.0)


def edge_score(windows: Windows) -> NDArray[np.float64]:
    """Decimal logarithm of the second weakest direction's edge energy over noise, at least 0."""
    return np.log10(np.maximum(np.sort(windows.directions, axis=1)[:, 1], 1.0))
