"""What the prior took of the data, as light to add back; see `SparseGradient`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import ONE, ZERO, Real, smooth

_GRAIN = np.float32(3.0)
"""Standard deviations of the noise within which a residual is grain (chosen: noise exceeds them in one pixel
of 400; further out, it is an error of the PSF that must not be added back)."""

_BINOMIAL = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / np.float32(16.0)


@jit
def spread_grain(  # noqa: C901, PLR0912 - a few passes over one tile
    y: Real, left: Real, known: NDArray[np.bool_], clip: Real, noise: Real, light: Real, out: Real
) -> None:
    """Fill `out` with what to add back of `left`, the residual of a mosaic; see `SparseGradient`."""
    channels, rows, cols = y.shape
    least = np.float32(1e-12)
    grain = np.empty(channels, np.float32)
    for c in range(channels):
        grain[c] = max(np.sqrt(noise[c, 0] * light[c] + noise[c, 1]) / light[c], np.float32(1e-9))
    share, there = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    for k in range(channels):
        for i in range(rows):
            for j in range(cols):
                there[i, j] = ONE if known[k, i, j] else ZERO
        smooth(there, _BINOMIAL, share, wrapped=False)
        smooth(left[k], _BINOMIAL, out[k], wrapped=False)
        for i in range(rows):
            for j in range(cols):
                out[k, i, j] /= max(share[i, j], np.float32(1e-3))
                left[k, i, j] = left[k, i, j] - out[k, i, j] if known[k, i, j] else ZERO
    for i in range(rows):
        for k in range(channels):
            for j in range(cols):
                if not known[k, i, j]:
                    continue
                within = _GRAIN * np.sqrt(max(noise[k, 0] * max(y[k, i, j], ZERO) + noise[k, 1], least))
                fine = min(max(left[k, i, j], -within), within) / light[k]
                for c in range(channels):
                    out[c, i, j] += fine * light[c] * min(ONE, grain[c] / grain[k])
        for k in range(channels):
            for j in range(cols):
                if y[k, i, j] >= clip[k]:
                    out[k, i, j] = ZERO
