"""The residual of the photo less the re-blurred result, compiled; see `lensmodel.correction.audit.reblur`."""

from __future__ import annotations

import numpy as np
import rocket_fft
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.audit.compiled.nearby import into_blocks
from lensmodel.correction.compiled.common import BACK, FORWARD, Complex, Real


@jit
def left_over(
    y: Real,
    x: Real,
    sigma: Real,
    K: Complex,
    width: int,
    error: float,
    counted: NDArray[np.bool_],
    side: int,
    out: Real,
) -> None:
    """Sums over blocks of r², r and 1 where it counts, r = (y - K x) / sqrt(sigma² + e² (x - K x)²).

    K is a transfer function on the `rfft2` grid of planes `width` wide; three planes into `out`.
    """
    rows, cols = y.shape
    zero, share = np.float32(0.0), np.float32(error * error)
    work = np.zeros((K.shape[0], width), np.float32)
    spectrum = np.empty_like(K)
    work[:rows, :cols] = x
    rocket_fft.r2c(work, spectrum, np.array([1]), FORWARD, 1.0, 1)
    rocket_fft.c2c(spectrum, spectrum, np.array([0]), FORWARD, 1.0, 1)
    for i in range(K.shape[0]):
        for j in range(K.shape[1]):
            spectrum[i, j] *= K[i, j]
    rocket_fft.c2c(spectrum, spectrum, np.array([0]), BACK, 1.0, 1)
    # only rows of the photo are needed
    rocket_fft.c2r(spectrum[:rows], work[:rows], np.array([1]), BACK, 1.0 / work.size, 1)
    strip = np.empty((3, cols), np.float32)
    out[:] = zero
    for block in range(out.shape[1]):
        strip[:] = zero
        for i in range(block * side, min(block * side + side, rows)):
            for j in range(cols):
                reblurred, noise = work[i, j], sigma[i, j]
                blurred = x[i, j] - reblurred
                number = np.float32(counted[i, j])
                residual = number * (y[i, j] - reblurred) / np.sqrt(noise * noise + share * blurred * blurred)
                strip[0, j] += residual * residual
                strip[1, j] += residual
                strip[2, j] += number
        into_blocks(strip, side, out[:, block])
