"""Waves and grain in flat places, compiled; see `ringing` and `grain` of `lensmodel.correction.audit`."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.audit.compiled.nearby import extremes, into_blocks
from lensmodel.correction.compiled.common import Real


@jit
def flat_waves(
    y: Real, x: Real, sigma: Real, reaches: tuple[int, int], limits: Real, side: int, out: Real
) -> None:
    """Sums over blocks of wave², step² and 1 where the photo is flat beside a step: three planes into `out`.

    `limits` are noise and share of the step up to which it is flat, and the noise from which a step counts.
    """
    rows, cols = y.shape
    noise, share, strong = limits
    edge_extremes = (np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32))
    photo_extremes = (np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32))
    result_extremes = (np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32))
    extremes(y, reaches[1], edge_extremes[0], edge_extremes[1])
    extremes(y, reaches[0], photo_extremes[0], photo_extremes[1])
    extremes(x, reaches[0], result_extremes[0], result_extremes[1])
    strip = np.empty((3, cols), np.float32)
    out[:] = np.float32(0.0)
    for block in range(out.shape[1]):
        strip[:] = np.float32(0.0)
        for i in range(block * side, min(block * side + side, rows)):
            for j in range(cols):
                step = edge_extremes[1][i, j] - edge_extremes[0][i, j]
                swing = photo_extremes[1][i, j] - photo_extremes[0][i, j]
                wave = result_extremes[1][i, j] - result_extremes[0][i, j]
                grain = sigma[i, j]
                flat = np.float32((swing <= noise * grain + share * step) & (step > strong * grain))
                strip[0, j] += flat * wave * wave
                strip[1, j] += flat * step * step
                strip[2, j] += flat
        into_blocks(strip, side, out[:, block])


@jit
def _detail(plane: Real, scale: int, side: int, out: Real) -> None:
    """Sums over blocks of the square of the difference of second differences; rims repeat."""
    rows, cols = plane.shape
    two, share = np.float32(2.0), np.float32(1.0 / 36.0)
    line, strip = np.empty(cols + 2 * scale, np.float32), np.empty((1, cols), np.float32)
    for block in range(out.shape[0]):
        strip[:] = np.float32(0.0)
        for i in range(block * side, min(block * side + side, rows)):
            above, below = max(i - scale, 0), min(i + scale, rows - 1)
            for j in range(cols):
                line[scale + j] = plane[above, j] - two * plane[i, j] + plane[below, j]
            for j in range(scale):
                line[j] = line[scale]
                line[scale + cols + j] = line[scale + cols - 1]
            for j in range(cols):
                curved = line[j] - two * line[j + scale] + line[j + 2 * scale]
                strip[0, j] += share * curved * curved
        into_blocks(strip, side, out[block : block + 1])


@jit
def flat_grain(luma: Real, sigma: Real, scales: tuple[int, int], side: int, out: Real) -> None:
    """Sums over blocks of sigma², y and y², then of the detail of photo and result at each scale.

    `luma` has shape (2, rows, cols), `out` (7, down, across).
    """
    rows, cols = sigma.shape
    strip = np.empty((3, cols), np.float32)
    out[:] = np.float32(0.0)
    for block in range(out.shape[1]):
        strip[:] = np.float32(0.0)
        for i in range(block * side, min(block * side + side, rows)):
            for j in range(cols):
                light, grain = luma[0, i, j], sigma[i, j]
                strip[0, j] += grain * grain
                strip[1, j] += light
                strip[2, j] += light * light
        into_blocks(strip, side, out[:3, block])
    for which in range(2):
        for plane in range(2):
            _detail(luma[plane], scales[which], side, out[3 + 2 * which + plane])
