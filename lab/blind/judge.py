"""The non-blind deconvolution that judges kernels: the same prior and settings for every kernel.

It is kept apart from `lensmodel.correction` on purpose: a judge must not change when the product does. Its
prior is a Gaussian mixture over small windows of development photographs (`lab.training.blind_data`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.cases import DATA
from lensmodel.core.types import Kernel, Plane

BORDER: Final = 28  # pixels along the rim that do not count: light from outside the patch reaches so far

Spectrum = NDArray[np.complex128]

_BETAS: Final = (50.0, 100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0)
_STEP: Final = 3  # pixels between windows (chosen): all of them take nine times as long


@dataclass(frozen=True, slots=True, eq=False)
class PatchMixture:
    """Gaussian mixture over small zero-mean windows of sharp linear light."""

    log_weights: NDArray[np.float32]  # (m,)
    vectors: NDArray[np.float32]  # (m, d, d), eigenvectors in columns
    values: NDArray[np.float32]  # (m, d), eigenvalues

    @classmethod
    def load(cls, path: Path = DATA / "epll.npz") -> PatchMixture:
        """Read weights and packed covariances, as `lab.training.blind_data` wrote them."""
        with np.load(path, allow_pickle=False) as stored:
            weights, packed = stored["weights"].astype(np.float64), stored["covariances"].astype(np.float64)
        side = (math.isqrt(8 * packed.shape[1] + 1) - 1) // 2
        covariances = np.zeros((len(weights), side, side))
        at = np.tril_indices(side)
        covariances[:, at[0], at[1]] = packed
        covariances[:, at[1], at[0]] = packed
        values, vectors = np.linalg.eigh(covariances)
        return cls(
            np.log(weights / weights.sum()).astype(np.float32),
            vectors.astype(np.float32),
            np.maximum(values, 1e-9).astype(np.float32),
        )

    def denoised(self, windows: NDArray[np.float32], variance: float) -> NDArray[np.float32]:
        """Most likely clean windows, `(n, d)`: the likeliest component's Wiener filter."""
        mean = windows.mean(axis=1, keepdims=True)
        flat = windows - mean
        best = np.full(len(flat), -np.inf, dtype=np.float32)
        which = np.zeros(len(flat), dtype=np.intp)
        for j in range(len(self.log_weights)):
            noisy = self.values[j] + np.float32(variance)
            turned = flat @ (self.vectors[j] / np.sqrt(noisy))
            likeness = np.float32(0.5) * np.einsum("nd,nd->n", turned, turned)
            score = self.log_weights[j] - 0.5 * np.log(noisy).sum() - likeness
            better = score > best
            best[better], which[better] = score[better], j
        out = np.empty_like(flat)
        for j in np.unique(which):
            own = which == j
            gain = self.values[j] / (self.values[j] + np.float32(variance))
            out[own] = (flat[own] @ (self.vectors[j] * gain)) @ self.vectors[j].T
        return out + mean

    def cleaned(self, x: NDArray[np.float32], variance: float, turn: int) -> NDArray[np.float64]:
        """Clean windows of a picture for white noise and average them; their grid moves with `turn`."""
        side = math.isqrt(self.values.shape[1])
        starts = []
        for axis in (0, 1):
            last = x.shape[axis] - side
            grid = np.arange((turn * (axis + 1)) % _STEP, last, _STEP)
            starts.append(np.unique(np.concatenate([[0], grid, [last]])))
        view = np.lib.stride_tricks.sliding_window_view(x, (side, side))
        windows = view[np.ix_(*starts)].reshape(-1, side * side)
        clean = self.denoised(windows, variance).reshape(len(starts[0]), len(starts[1]), side, side)
        total, count = np.zeros(x.shape), np.zeros(x.shape)
        for i in range(side):
            for j in range(side):
                at = np.ix_(starts[0] + i, starts[1] + j)
                total[at] += clean[:, :, i, j]
                count[at] += 1.0
        return total / count


_mixture = cache(PatchMixture.load)


def deconvolved(patch: Plane, kernel: Kernel, sigma: float, shift: tuple[float, float]) -> Plane:
    """Return the sharp patch, of the same shape, by its expected patch log likelihood.

    `shift` (row, col) moves the kernel K first, sub-pixel. For growing beta, windows are cleaned for noise of
    variance 1/beta and averaged to z, then (|K|² / sigma² + beta) X = conj(K) Y / sigma² + beta Z. Source: D.
    Zoran and Y. Weiss, "From learning models of natural image patches to whole image restoration", ICCV 2011.
    """
    y = tapered(patch, BORDER)
    otf, weight = shifted_otf(kernel, (y.shape[0], y.shape[1]), shift), 1.0 / (sigma * sigma)
    data, power = weight * np.conj(otf) * fft.rfft2(y), weight * np.square(np.abs(otf))
    x = y
    for turn, beta in enumerate(_BETAS):
        clean = fft.rfft2(_mixture().cleaned(x.astype(np.float32), 1.0 / beta, turn))
        x = fft.irfft2((data + beta * clean) / (power + beta), s=y.shape)
    return np.asarray(x[BORDER:-BORDER, BORDER:-BORDER].astype(np.float32))


def shifted_otf(kernel: Kernel, shape: tuple[int, int], shift: tuple[float, float]) -> Spectrum:
    """Transfer function of a kernel moved by `shift` pixels, by phase: as a kernel it would ring."""
    size = kernel.shape[0]
    grid = np.zeros(shape)
    grid[:size, :size] = kernel / kernel.sum()
    fr, fc = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :]
    middle = size // 2
    phase = fr * (shift[0] - middle) + fc * (shift[1] - middle)
    return np.asarray(fft.rfft2(grid) * np.exp(-2j * np.pi * phase))


def tapered(patch: Plane, margin: int) -> NDArray[np.float64]:
    """Pad by mirror images that fade into each other around the edge of a torus."""
    padded = np.pad(np.asarray(patch, dtype=np.float64), margin, mode="reflect")
    for axis in (0, 1):
        length = padded.shape[axis]
        t = np.arange(length)
        edge = np.minimum(t, length - 1 - t)
        weight = 0.5 + 0.5 * np.clip((edge + 0.5) / margin, 0.0, 1.0)
        shape = [1, 1]
        shape[axis] = length
        weight = weight.reshape(shape)
        padded = weight * padded + (1.0 - weight) * np.flip(padded, axis=axis)
    return padded


def squared_error(a: Plane, b: Plane) -> float:
    """Sum of squared differences, the rim of `BORDER` pixels left out."""
    inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    return float(np.square(a[inner].astype(np.float64) - b[inner]).sum())
