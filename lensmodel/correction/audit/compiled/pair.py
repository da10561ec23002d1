"""What all checks need of a tile, compiled; see `lensmodel.correction.audit.check.TilePair`."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import Real


@jit
def prepared(
    y: Real,
    x: Real,
    clip: Real,
    noise: NDArray[np.float64],
    least: float,
    written_planes: Real,
    sigma: Real,
    luma: Real,
    luma_sigma: Real,
) -> None:
    """Fill in the result as it is written, the noise, means of the colours and their noise.

    `noise` has a row (shot, read) for each of the three colours.
    """
    rows, cols = luma_sigma.shape
    zero, third = np.float32(0.0), np.float32(1.0 / 3.0)
    total = np.empty(cols, np.float32)
    for i in range(rows):
        total[:] = zero
        luma[:, i] = zero
        for c in range(3):
            shot, read, floor = np.float32(noise[c, 0]), np.float32(noise[c, 1]), np.float32(least)
            top = clip[c]
            photo, result, written, grain = y[c, i], x[c, i], written_planes[c, i], sigma[c, i]
            before, after = luma[0, i], luma[1, i]
            for j in range(cols):
                light = min(result[j], top)
                variance = max(shot * max(photo[j], zero) + read, floor)
                written[j] = light
                grain[j] = np.sqrt(variance)
                total[j] += variance
                before[j] += third * photo[j]
                after[j] += third * light
        for j in range(cols):
            luma_sigma[i, j] = third * np.sqrt(total[j])
