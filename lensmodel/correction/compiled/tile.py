"""Preparation of a tile, compiled: data on the canvas, kernels as transfer functions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import ONE, ZERO, Complex, Number, Real, transfer

Seam = tuple[NDArray[np.intp], NDArray[np.intp], Real]


@jit
def fill(planes: Real, gains: Real, margin: int, rows: Seam, cols: Seam, y: Real) -> None:
    """Place planes times `gains` on a canvas; the margin fades from one end to the other (`Canvas.fill`)."""
    channels, high, wide = planes.shape
    height, width = y.shape[1], y.shape[2]
    line = np.empty(wide, np.float32)
    for c in range(channels):
        for i in range(height):
            if i < high:
                for j in range(wide):
                    line[j] = planes[c, i, j] * gains[c]
            else:
                a, b, t = rows[0][i - high], rows[1][i - high], rows[2][i - high]
                for j in range(wide):
                    line[j] = (planes[c, a, j] * (ONE - t) + planes[c, b, j] * t) * gains[c]
            row = (i + margin) % height
            y[c, row, margin : margin + wide] = line
            for j in range(wide, width):
                t = cols[2][j - wide]
                value = line[cols[0][j - wide]] * (ONE - t) + line[cols[1][j - wide]] * t
                y[c, row, (j + margin) % width] = value


@jit
def _limit(K: Complex, rates: Complex, reach: Number) -> None:
    """Hold the change of a transfer function within half of it; see `transfers`."""
    for i in range(K.shape[0]):
        for j in range(K.shape[1]):
            k, d, a = K[i, j], rates[0, i, j], rates[1, i, j]
            change = reach * (
                np.sqrt(d.real * d.real + d.imag * d.imag) + np.sqrt(a.real * a.real + a.imag * a.imag)
            )
            allowed = np.float32(0.5) * np.sqrt(k.real * k.real + k.imag * k.imag)
            if change > allowed:
                share = allowed / max(change, np.float32(1e-9))
                rates[0, i, j] = d * share
                rates[1, i, j] = a * share


@jit
def spectra_of(taps: Real, reach: Number, width: int, K: Complex, rates: Complex) -> None:
    """Transfer functions of kernels `(channel, 1 or 3, k, k)`, and how they change, limited."""
    for c in range(taps.shape[0]):
        transfer(taps[c, 0], K[c], width)
        if taps.shape[1] > 1:
            transfer(taps[c, 1], rates[c, 0], width)
            transfer(taps[c, 2], rates[c, 1], width)
            _limit(K[c], rates[c], reach)


@jit
def block_means(  # noqa: C901 - one pass over memory
    tile: Real, gains: Real, planes: Real, luma: Real, square: Real
) -> None:
    """Means over blocks of 4 pixels of planes times `gains`, of their mean, and of its square."""
    channels, height, width = tile.shape
    share = ONE / np.float32(channels)
    line = np.empty(width, np.float32)
    sums = np.empty((channels + 2, width), np.float32)
    for row in range(luma.shape[0]):
        low, high = 4 * row, min(4 * row + 4, height)
        sums[:] = ZERO
        for i in range(low, high):
            line[:] = ZERO
            for c in range(channels):
                for j in range(width):
                    value = tile[c, i, j] * gains[c]
                    sums[c, j] += value
                    line[j] += value * share
            for j in range(width):
                sums[channels, j] += line[j]
                sums[channels + 1, j] += line[j] * line[j]
        for col in range(luma.shape[1]):
            left, right = 4 * col, min(4 * col + 4, width)
            size = np.float32((high - low) * (right - left))
            for c in range(channels + 2):
                total = ZERO
                for j in range(left, right):
                    total += sums[c, j]
                if c < channels:
                    planes[c, row, col] = total / size
                elif c == channels:
                    luma[row, col] = total / size
                else:
                    square[row, col] = total / size


@jit
def add(out: Real, at: tuple[int, int], rise: Real, run: Real, planes: Real, part: tuple[int, int]) -> None:
    """Add planes from pixel `part` on, times a weight for each row and each column, to `out` from `at` on."""
    for c in range(planes.shape[0]):
        for i in range(rise.size):
            weight, line, into = rise[i], planes[c, part[0] + i], out[c, at[0] + i]
            for j in range(run.size):
                into[at[1] + j] += weight * run[j] * line[part[1] + j]
