"""The transforms of a Richardson-Lucy step and nothing else; imported only where Numba is installed."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import Real, to_plane, to_spectrum


@jit
def bare_transforms(plane: Real, pairs: int) -> None:
    """Transform a plane forth and back, and nothing else: the lower bound that a benchmark compares with."""
    spectrum = np.empty((plane.shape[0], plane.shape[1] // 2 + 1), np.complex64)
    for _ in range(pairs):
        to_spectrum(plane, spectrum)
        to_plane(spectrum, plane)
