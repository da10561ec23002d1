"""Small symmetric filters along rows and columns."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import ZERO, Real


@jit
def smooth(plane: Real, weights: Real, out: Real, wrapped: bool) -> None:
    """Filter a plane with odd `weights` along rows and columns; it continues periodically, or with zeros."""
    rows, cols = plane.shape
    half = weights.size // 2
    line = np.empty(cols + 2 * half, np.float32)
    middle = line[half : half + cols]
    for i in range(rows):
        line[:] = ZERO
        for k in range(-half, half + 1):
            row = i + k
            if wrapped:
                row %= rows
            elif row < 0 or row >= rows:
                continue
            weight = weights[k + half]
            for j in range(cols):
                middle[j] += weight * plane[row, j]
        if wrapped:
            for j in range(half):
                line[j] = line[(j - half) % cols + half]
                line[half + cols + j] = line[j % cols + half]
        out[i] = ZERO
        for k in range(2 * half + 1):
            weight = weights[k]
            for j in range(cols):
                out[i, j] += weight * line[j + k]
