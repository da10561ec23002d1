"""One pass over a plane: sums over small blocks, from which any window is put together."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import NoiseModel, Plane, StepHook
from lensmodel.estimation.patches.rmap import (
    FLAT_WINDOW,
    GROUPS,
    R_BINS,
    gradient_noise,
    r_bin,
    r_of_gradients,
    smoothed_gradients,
)

ORIENTATIONS: Final = 8
"""Bins of gradient direction over half a turn: corners need a few directions, each must hold edges enough for
a histogram (chosen)."""

BLOCKS_A_SIDE: Final = 4
"""A window is this many blocks wide, and windows start at every block: finer starts cost time and find nearly
the same windows (chosen)."""

WIDTH_BINS: Final = 28
WIDTH_STEP_PX: Final = 0.2
"""Histogram of edge widths, 0 to 5.6 px (chosen: finer than the widths of sharp and soft photos differ)."""

EDGE_SIGMAS: Final = 4.0
"""Of a gradient's noise, above which a pixel is an edge: noise alone exceeds it in one pixel of 3000
(chosen)."""
WIDTH_SIGMAS: Final = 10.0
"""The same where a width is measured: noise must not move the places where an edge begins and ends
(chosen)."""
CLIP_SHARE: Final = 0.98
"""Of the clipping level, above which a pixel is clipped: noise and demosaicing leave it a little lower
(chosen)."""
DARK_SNR: Final = 5.0
"""A pixel below this ratio of level to noise counts as dark. One percent of full range is the noise of
the published lens-blur benchmark; ten times that level would already throw out half a photo there."""

_MARGIN = 18  # half an r-map window and the smoothing
_STRIP_PIXELS = 2_000_000
"""Pixels at once, 8 MB a plane of float32: the calls cost little beside the work (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class BlockSums:
    """Sums over blocks; every array starts with axes (block row, block column).

    Parameters
    ----------
    side : int
        Side of a block in pixels.
    row, col : int
        Top-left pixel of block (0, 0).
    energy : ndarray of float32, shape (n, m, ORIENTATIONS, R_BINS)
        Squared modulus of the edge gradients by direction and r.
    tensor : ndarray of float64, shape (n, m, 3)
        Structure tensor of the edge gradients: rr, rc, cc.
    level, square : ndarray of float64, shape (n, m)
        Sums of the values and of their squares.
    clipped, dark, missing : ndarray of int64, shape (n, m)
        Pixels above 98 percent of the clip level, below `DARK_SNR`, and not finite.
    widths : ndarray of int64, shape (n, m, WIDTH_BINS)
        Histogram of local edge widths.
    width_sums : ndarray of float64, shape (n, m, ORIENTATIONS, 2)
        Count and sum of squared widths by gradient direction.
    histogram : ndarray of int64, shape (GROUPS, R_BINS)
        Edge pixels of the whole plane by orientation group and r.
    """

    side: int
    row: int
    col: int
    energy: NDArray[np.float32]
    tensor: NDArray[np.float64]
    level: NDArray[np.float64]
    square: NDArray[np.float64]
    clipped: NDArray[np.int64]
    dark: NDArray[np.int64]
    missing: NDArray[np.int64]
    widths: NDArray[np.int64]
    width_sums: NDArray[np.float64]
    histogram: NDArray[np.int64]


def intensity_scale(plane: Plane) -> float:
    """Level that counts as white: the 99.5 percentile of every eighth pixel, never below 1e-3."""
    sample = np.asarray(plane[::8, ::8])
    sample = sample[np.isfinite(sample)]
    return max(float(np.percentile(sample, 99.5)), 1e-3) if sample.size else 1.0


def measure_blocks(plane: Plane, noise: NoiseModel, side: int, clip: float, on_step: StepHook) -> BlockSums:
    """Sum over blocks of `side` pixels, in strips, so that memory does not grow with the plane.

    About 0.2 s a megapixel; the grid is centred, and incomplete blocks at the rim are left out.
    """
    height, width = plane.shape
    n, m = height // side, width // side
    row0, col0 = (height - n * side) // 2, (width - m * side) // 2
    scale = intensity_scale(plane)
    blocks = BlockSums(
        side=side,
        row=row0,
        col=col0,
        energy=np.zeros((n, m, ORIENTATIONS, R_BINS), np.float32),
        tensor=np.zeros((n, m, 3)),
        level=np.zeros((n, m)),
        square=np.zeros((n, m)),
        clipped=np.zeros((n, m), np.int64),
        dark=np.zeros((n, m), np.int64),
        missing=np.zeros((n, m), np.int64),
        widths=np.zeros((n, m, WIDTH_BINS), np.int64),
        width_sums=np.zeros((n, m, ORIENTATIONS, 2)),
        histogram=np.zeros((GROUPS, R_BINS), np.int64),
    )
    for first, last in _strips(n, max(1, _STRIP_PIXELS // (side * width))):
        _measure_strip(plane, blocks, slice(first, last), noise=noise, clip=clip, scale=scale)
        on_step(last, n)
    return blocks


def _strips(count: int, step: int) -> Iterator[tuple[int, int]]:
    for first in range(0, count, step):
        yield first, min(first + step, count)


def _measure_strip(
    plane: Plane, blocks: BlockSums, rows: slice, *, noise: NoiseModel, clip: float, scale: float
) -> None:
    side, m = blocks.side, blocks.level.shape[1]
    top, bottom = blocks.row + rows.start * side, blocks.row + rows.stop * side
    above, below = min(_MARGIN, top), min(_MARGIN, plane.shape[0] - bottom)
    values = np.array(plane[top - above : bottom + below], dtype=np.float32)
    finite = np.isfinite(values)
    if not finite.all():
        values[~finite] = 0.0
    smooth, along_rows, along_cols = smoothed_gradients(values)
    size = np.hypot(along_rows, along_cols)
    r = r_of_gradients(along_rows, along_cols, size, FLAT_WINDOW, scale)

    inner = (slice(above, values.shape[0] - below), slice(blocks.col, blocks.col + m * side))
    level = values[inner]
    blocks.missing[rows] = _block_sum(~finite[inner], side)
    blocks.level[rows] = _block_sum(level, side)
    blocks.square[rows] = _block_sum(np.square(level, dtype=np.float64), side)
    blocks.clipped[rows] = _block_sum(level >= CLIP_SHARE * clip, side)
    blocks.dark[rows] = _block_sum(smooth[inner] < _level_of_snr(noise, DARK_SNR), side)

    unit = np.sqrt(noise.variance(smooth[inner])).astype(np.float32) * np.float32(gradient_noise(1.0))
    gr, gc, modulus = along_rows[inner], along_cols[inner], size[inner]
    at = np.flatnonzero(modulus > EDGE_SIGMAS * unit)
    where = _block_numbers(at, side, m)
    gr_at, gc_at = gr.ravel()[at], gc.ravel()[at]
    orientation = _orientation(gr_at, gc_at)
    bins = r_bin(r[inner].ravel()[at])
    power = modulus.ravel()[at] ** 2
    shape = (rows.stop - rows.start, m)
    count = shape[0] * m
    key = (where * ORIENTATIONS + orientation) * R_BINS + bins
    blocks.energy[rows] = np.bincount(key, power, count * ORIENTATIONS * R_BINS).reshape(
        *shape, ORIENTATIONS, R_BINS
    )
    group = orientation // (ORIENTATIONS // GROUPS) * R_BINS + bins
    blocks.histogram[:] += np.bincount(group, minlength=GROUPS * R_BINS).reshape(GROUPS, R_BINS)
    for i, product in enumerate((gr_at * gr_at, gr_at * gc_at, gc_at * gc_at)):
        blocks.tensor[rows, :, i] = np.bincount(where, product, count).reshape(shape)
    ridge = _ridge(along_rows, along_cols, size)[inner] & (modulus > WIDTH_SIGMAS * unit)
    _measure_widths(blocks, rows, smooth, (gr, gc, modulus), np.flatnonzero(ridge), inner)


def _ridge(along_rows: Plane, along_cols: Plane, modulus: Plane) -> NDArray[np.bool_]:
    """Where no neighbour across the edge is steeper; the rim has one neighbour only and is let through."""
    center, inside = modulus[1:-1, 1:-1], (slice(1, -1), slice(1, -1))
    ridge = np.ones(modulus.shape, dtype=np.bool_)
    ridge[inside] = np.where(
        np.abs(along_rows[inside]) > np.abs(along_cols[inside]),
        (center >= modulus[:-2, 1:-1]) & (center >= modulus[2:, 1:-1]),
        (center >= modulus[1:-1, :-2]) & (center >= modulus[1:-1, 2:]),
    )
    return ridge


def _measure_widths(
    blocks: BlockSums,
    rows: slice,
    smooth: Plane,
    gradients: tuple[Plane, Plane, Plane],
    at: NDArray[np.intp],
    inner: tuple[slice, slice],
) -> None:
    """Width of the blur at edge ridges by re-blurring.

    A step blurred by a Gaussian of s and smoothed by 1 px has its steepest gradient in
    proportion to 1/sqrt(s² + 1); smoothed once more by 1 px, to 1/sqrt(s² + 2). Hence

        R² = (s² + 2) / (s² + 1),        s² = 1 / (R² - 1) - 1

    S. Zhuo and T. Sim, "Defocus map estimation from a single image", Pattern Recognition 44,
    2011, eq. (3) to (5), with the smoothing taken into account. It holds on the ridge of the
    gradient only: `at` are the pixels of the inner part that lie there.
    """
    gr, gc, modulus = gradients
    side, m = blocks.side, blocks.level.shape[1]
    again = np.asarray(ndimage.gaussian_filter(smooth, 1.0, truncate=3.0), dtype=np.float32)
    second = np.hypot(*(np.asarray(part)[inner] for part in np.gradient(again)))
    excess = np.square(modulus.ravel()[at] / np.maximum(second.ravel()[at], 1e-12)) - 1.0
    square = 1.0 / np.maximum(excess, 1e-3) - 1.0
    square = np.clip(square, 0.0, (WIDTH_BINS * WIDTH_STEP_PX) ** 2 - 1e-3)
    where = _block_numbers(at, side, m)
    shape = (rows.stop - rows.start, m)
    count = shape[0] * m
    key = where * WIDTH_BINS + (np.sqrt(square) / WIDTH_STEP_PX).astype(np.intp)
    blocks.widths[rows] = np.bincount(key, minlength=count * WIDTH_BINS).reshape(*shape, WIDTH_BINS)
    key = where * ORIENTATIONS + _orientation(gr.ravel()[at], gc.ravel()[at])
    for i, weights in enumerate((None, square)):
        blocks.width_sums[rows, :, :, i] = np.bincount(key, weights, count * ORIENTATIONS).reshape(
            *shape, ORIENTATIONS
        )


def _orientation(along_rows: NDArray[np.float32], along_cols: NDArray[np.float32]) -> NDArray[np.intp]:
    """Bin of the gradient's direction over half a turn, 0 = along columns, growing downwards."""
    angle = np.arctan2(along_rows, along_cols) * (ORIENTATIONS / np.pi)
    return np.floor(angle + 0.5).astype(np.intp) % ORIENTATIONS


def _block_numbers(at: NDArray[np.intp], side: int, m: int) -> NDArray[np.intp]:
    row, col = np.divmod(at, m * side)
    return (row // side) * m + col // side


def _block_sum(values: NDArray[np.generic], side: int) -> NDArray[np.float64]:
    n, m = values.shape[0] // side, values.shape[1] // side
    return values.reshape(n, side, m, side).sum(axis=(1, 3), dtype=np.float64)


def _level_of_snr(noise: NoiseModel, snr: float) -> float:
    """Level whose ratio to its noise is `snr`: the positive root of l² = snr² (shot l + read)."""
    half = 0.5 * snr * snr * noise.shot
    return half + float(np.sqrt(half * half + snr * snr * noise.read))
