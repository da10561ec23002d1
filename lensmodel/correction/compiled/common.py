"""What compiled code shares: types, constants and transforms.

Imported only where Numba and rocket-fft are installed; `lensmodel.correction.engine` decides.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import rocket_fft
from numpy.typing import NDArray

from lensmodel.core.jit import jit

Real = NDArray[np.float32]
Complex = NDArray[np.complex64]

# In single precision, so that no sum is made in double.
ONE: Final = np.float32(1.0)
ZERO: Final = np.float32(0.0)
FORWARD: Final = True
BACK: Final = False


@jit
def to_spectrum(plane: Real, spectrum: Complex) -> None:
    """Real transform of a plane, rows first.

    Rows and columns are transformed one after the other, because one call for both allocates memory on the
    way back: a round trip takes 0.91 to 0.93 of the time this way.
    """
    rocket_fft.r2c(plane, spectrum, np.array([1]), FORWARD, 1.0, 1)
    rocket_fft.c2c(spectrum, spectrum, np.array([0]), FORWARD, 1.0, 1)


@jit
def to_plane(spectrum: Complex, plane: Real) -> None:
    """Inverse real transform, divided by the number of pixels; `spectrum` is overwritten."""
    rocket_fft.c2c(spectrum, spectrum, np.array([0]), BACK, 1.0, 1)
    rocket_fft.c2r(spectrum, plane, np.array([1]), BACK, 1.0 / plane.size, 1)
