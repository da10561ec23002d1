"""What is known of every candidate window of a photo, as arrays."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.geometry import Frame
from lensmodel.core.types import NoiseModel
from lensmodel.estimation.patches.blocks import (
    BLOCKS_A_SIDE,
    ORIENTATIONS,
    WIDTH_BINS,
    WIDTH_STEP_PX,
    BlockSums,
)
from lensmodel.estimation.patches.details import SLOPE_ORDER
from lensmodel.estimation.patches.rmap import FLAT_WINDOW, R_BINS, automatic_threshold, gradient_noise

MIN_RIDGE_PIXELS: Final = 30
"""Fewer edge pixels do not give a width: nine of them would lie below its quantile (chosen)."""

WIDTH_QUANTILE: Final = 0.3
"""Soft edges of the scene widen the upper half of the widths, not the lower: on sharp photographs, half of
each defocused by a disc of 2 px, this told the halves apart better than the median or the 15th percentile.
Measured once, no command repeats it."""


@dataclass(frozen=True, slots=True, eq=False)
class Windows:
    """Candidate windows of one photo; every array has one entry a window along axis 0.

    Parameters
    ----------
    size : int
        Side of every window in pixels.
    rows, cols : ndarray of int64, shape (n,)
        Top-left pixels.
    r, phi : ndarray of float64, shape (n,)
        Field position of the centres.
    directions : ndarray of float64, shape (n, ORIENTATIONS)
        Edge energy by gradient direction where r is high enough, over the energy of noise.
    r_mean, r_kept : ndarray of float64, shape (n,)
        Mean r weighted by edge energy, and the share of the energy where r is high enough.
    eigenvalues : ndarray of float64, shape (n, 2)
        Of the structure tensor, smaller first, over that of noise.
    contrast : ndarray of float64, shape (n,)
        Variance of the signal over variance of the noise; a slope, as of a sky, is no signal.
    level, sigma : ndarray of float64, shape (n,)
        Mean level and the noise's standard deviation there.
    clipped, dark, missing : ndarray of float64, shape (n,)
        Shares of the pixels.
    width : ndarray of float64, shape (n,)
        Width of the sharper edges as the sigma of a Gaussian in pixels; NaN where edges are few.
    widest : ndarray of float64, shape (n,)
        The same of the window's widest quarter: a depth step inside the window shows there.
    elongation : ndarray of float64, shape (n, 2)
        Cosine and sine parts, over twice the angle in image axes (columns to rows), of the squared
        edge width relative to its mean; zero where unknown.
    """

    size: int
    rows: NDArray[np.int64]
    cols: NDArray[np.int64]
    r: NDArray[np.float64]
    phi: NDArray[np.float64]
    directions: NDArray[np.float64]
    r_mean: NDArray[np.float64]
    r_kept: NDArray[np.float64]
    eigenvalues: NDArray[np.float64]
    contrast: NDArray[np.float64]
    level: NDArray[np.float64]
    sigma: NDArray[np.float64]
    clipped: NDArray[np.float64]
    dark: NDArray[np.float64]
    missing: NDArray[np.float64]
    width: NDArray[np.float64]
    widest: NDArray[np.float64]
    elongation: NDArray[np.float64]

    def __len__(self) -> int:
        return int(self.rows.size)

    def take(self, index: NDArray[np.integer] | NDArray[np.bool_]) -> Windows:
        """Return the windows that `index` picks."""
        parts = {name: getattr(self, name) for name in self.__slots__ if name != "size"}
        return Windows(size=self.size, **{name: part[index] for name, part in parts.items()})


def windows_of(blocks: BlockSums, frame: Frame, noise: NoiseModel) -> Windows:
    """Put the windows together from block sums; windows start at every block."""
    size = blocks.side * BLOCKS_A_SIDE
    area = size * size
    level = _window_sum(blocks.level) / area
    variance = _window_sum(blocks.square) / area - level**2 - _slope_variance(blocks)
    noise_variance = np.maximum(noise.variance(level), 1e-12)
    gradient_power = noise_variance * gradient_noise(1.0) ** 2
    energy = _window_sum(blocks.energy)
    lowest = automatic_threshold(blocks.histogram, blocks.level.size * blocks.side**2, FLAT_WINDOW**2)
    kept = energy[..., lowest:].sum(axis=-1)
    by_r = energy.sum(axis=1)
    total = np.maximum(by_r.sum(axis=-1), 1e-12)
    rows, cols = _corners(blocks)
    half = (size - 1) / 2.0
    r, phi = frame.polar(rows + half, cols + half)
    return Windows(
        size=size,
        rows=rows,
        cols=cols,
        r=r,
        phi=phi,
        # The mean square of the modulus is twice that of a component, shared by all directions.
        directions=kept / (2.0 * gradient_power * area / ORIENTATIONS)[:, None],
        r_mean=by_r @ ((np.arange(R_BINS) + 0.5) / R_BINS) / total,
        r_kept=kept.sum(axis=-1) / total,
        eigenvalues=_eigenvalues(_window_sum(blocks.tensor)) / (area * gradient_power)[:, None],
        contrast=(variance - noise_variance) / noise_variance,
        level=level,
        sigma=np.sqrt(noise_variance),
        clipped=_window_sum(blocks.clipped) / area,
        dark=_window_sum(blocks.dark) / area,
        missing=_window_sum(blocks.missing) / area,
        width=_typical_width(_window_sum(blocks.widths)),
        widest=_widest_quarter(blocks.widths),
        elongation=_elongation(_window_sum(blocks.width_sums)),
    )


def _window_sum(values: NDArray[np.generic]) -> NDArray[np.float64]:
    """Sum of every square of blocks, windows flattened: `(n, m, ...)` to `(windows, ...)`."""
    out = np.asarray(values, dtype=np.float64)
    for axis in (0, 1):
        view = np.lib.stride_tricks.sliding_window_view(out, BLOCKS_A_SIDE, axis=axis)
        out = view.sum(axis=-1)
    return out.reshape(-1, *out.shape[2:])


def _slope_variance(blocks: BlockSums) -> NDArray[np.float64]:
    """Variance of the polynomial of order `SLOPE_ORDER` that fits the means of a window's blocks.

    With M the polynomials without the constant averaged over blocks, G their covariance over the pixels and
    m the 16 means, c = M^+ m and the variance is c' G c.
    """
    averaged, covariance = _slopes(blocks.side)
    means = np.asarray(blocks.level, dtype=np.float64) / blocks.side**2
    view = np.lib.stride_tricks.sliding_window_view(means, (BLOCKS_A_SIDE, BLOCKS_A_SIDE))
    fit = view.reshape(-1, BLOCKS_A_SIDE**2) @ np.linalg.pinv(averaged).T
    return np.asarray(np.einsum("ni,ij,nj->n", fit, covariance, fit))


@lru_cache(maxsize=4)
def _slopes(side: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    size = side * BLOCKS_A_SIDE
    t = np.linspace(-1.0, 1.0, size)
    orders = range(SLOPE_ORDER + 1)
    parts = [np.outer(t**i, t**j) for i in orders for j in orders if 0 < i + j <= SLOPE_ORDER]
    basis = np.stack([part - part.mean() for part in parts])
    averaged = basis.reshape(-1, BLOCKS_A_SIDE, side, BLOCKS_A_SIDE, side).mean(axis=(2, 4))
    flat = basis.reshape(len(parts), -1)
    return averaged.reshape(len(parts), -1).T, flat @ flat.T / size**2


def _corners(blocks: BlockSums) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    n, m = (count - BLOCKS_A_SIDE + 1 for count in blocks.level.shape)
    rows, cols = np.meshgrid(np.arange(n), np.arange(m), indexing="ij")
    return blocks.row + rows.ravel() * blocks.side, blocks.col + cols.ravel() * blocks.side


def _eigenvalues(tensor: NDArray[np.float64]) -> NDArray[np.float64]:
    rr, rc, cc = tensor.T
    mean, spread = (rr + cc) / 2.0, np.hypot((rr - cc) / 2.0, rc)
    return np.stack([np.maximum(mean - spread, 0.0), mean + spread], axis=1)


def _typical_width(histogram: NDArray[np.float64]) -> NDArray[np.float64]:
    """Quantile of binned widths, linear inside its bin."""
    total = histogram.sum(axis=1)
    below = histogram.cumsum(axis=1)
    at = np.minimum((below < WIDTH_QUANTILE * total[:, None]).sum(axis=1), WIDTH_BINS - 1)
    pick = np.arange(len(total))
    inside = np.maximum(histogram[pick, at], 1.0)
    part = 1.0 - (below[pick, at] - WIDTH_QUANTILE * total) / inside
    return np.where(total >= MIN_RIDGE_PIXELS, (at + np.clip(part, 0.0, 1.0)) * WIDTH_STEP_PX, np.nan)


def _widest_quarter(histograms: NDArray[np.int64]) -> NDArray[np.float64]:
    half = BLOCKS_A_SIDE // 2
    sums = np.asarray(histograms, dtype=np.float64)
    for axis in (0, 1):
        sums = np.lib.stride_tricks.sliding_window_view(sums, half, axis=axis).sum(axis=-1)
    n, m = sums.shape[0] - half, sums.shape[1] - half
    quarters = [sums[i : i + n, j : j + m].reshape(n * m, -1) for i in (0, half) for j in (0, half)]
    widths = np.stack([_typical_width(part) for part in quarters])
    return np.where(np.isnan(widths).all(axis=0), np.nan, np.nan_to_num(widths).max(axis=0))


def _elongation(sums: NDArray[np.float64]) -> NDArray[np.float64]:
    """Fit s² = a (1 + c cos 2t + s sin 2t) to the mean squared widths by direction."""
    angle = 2.0 * np.pi * np.arange(ORIENTATIONS) / ORIENTATIONS
    basis = np.stack([np.ones(ORIENTATIONS), np.cos(angle), np.sin(angle)], axis=1)
    count, square = sums[..., 0], sums[..., 1]
    # Directions weigh equally up to 20 pixels, so that one long edge does not decide alone.
    weight = np.minimum(count, 20.0)
    mean = square / np.maximum(count, 1.0)
    normal = np.einsum("nd,di,dj->nij", weight, basis, basis) + 1e-3 * np.eye(3)
    fit = np.linalg.solve(normal, np.einsum("nd,nd,di->ni", weight, mean, basis)[..., None])[..., 0]
    known = ((count >= 5.0).sum(axis=1) >= ORIENTATIONS // 2) & (fit[:, 0] > 1e-3)
    relative = fit[:, 1:] / np.maximum(fit[:, :1], 1e-3)
    relative /= np.maximum(np.hypot(*relative.T), 1.0)[:, None]
    return np.where(known[:, None], relative, 0.0)
