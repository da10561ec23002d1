"""A Gaussian mixture over small windows of sharp photographs."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.correction.methods.half_quadratic import half_quadratic
from lensmodel.core.types import StepHook, ignore_step

_SHIPPED = Path(__file__).parents[2] / "data" / "epll.npz"


@dataclass(frozen=True, slots=True, eq=False)
class PatchMixture:
    """Gaussian mixture over small zero-mean windows of sharp linear light."""

    log_weights: NDArray[np.float32]  # (m,)
    vectors: NDArray[np.float32]  # (m, d, d), eigenvectors in columns
    values: NDArray[np.float32]  # (m, d), eigenvalues

    @classmethod
    def load(cls, path: Path = _SHIPPED) -> PatchMixture:
        """Read weights and packed covariances, as `train_epll` wrote them."""
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
            score = (
                self.log_weights[j]
                - 0.5 * np.log(noisy).sum()
                - np.float32(0.5) * np.einsum("nd,nd->n", turned, turned)
            )
            better = score > best
            best[better], which[better] = score[better], j
        out = np.empty_like(flat)
        for j in np.unique(which):
            own = which == j
            gain = self.values[j] / (self.values[j] + np.float32(variance))
            out[own] = (flat[own] @ (self.vectors[j] * gain)) @ self.vectors[j].T
        return out + mean

    def cleaned(
        self, x: NDArray[np.float32], variance: float, turn: int = 0, step: int = 3
    ) -> NDArray[np.float64]:
        """Clean the windows of a picture for white noise and average them.

        One window in `step`² is used, on a grid that moves with `turn`.
        """
        side = math.isqrt(self.values.shape[1])
        starts = []
        for axis in (0, 1):
            last = x.shape[axis] - side
            grid = np.arange((turn * (axis + 1)) % step, last, step)
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

    def restored(
        self,
        y: NDArray[Any],
        transfer: NDArray[np.complexfloating[Any, Any]],
        weight: float,
        betas: Sequence[float],
        step: int,
        on_step: StepHook = ignore_step,
    ) -> NDArray[Any]:
        """Restore a blurred grid by its expected patch log likelihood [1]_, with half-quadratic splitting.

        For growing beta: clean all windows for noise of variance 1/beta, average them to z, then solve::

            (w |K|² + beta) X = w conj(K) Y + beta Z

        References
        ----------
        .. [1] D. Zoran and Y. Weiss, "From learning models of natural image patches to whole image
           restoration", ICCV 2011, eq. (4) to (6).
        """
        data, power = weight * np.conj(transfer) * fft.rfft2(y), weight * np.square(np.abs(transfer))
        return half_quadratic(y, data, power, betas, self.spectrum_of_cleaned(betas, step), on_step)

    def spectrum_of_cleaned(
        self, betas: Sequence[float], step: int
    ) -> Callable[[NDArray[Any], int], NDArray[np.complexfloating[Any, Any]]]:
        """Return the target of `half_quadratic`: x cleaned for noise of variance 1/beta of the turn."""
        return lambda x, turn: fft.rfft2(self.cleaned(x.astype(np.float32), 1.0 / betas[turn], turn, step))


@lru_cache(maxsize=1)
def shipped_mixture() -> PatchMixture:
    """Return the mixture that was fitted to the development photographs of the benchmark."""
    return PatchMixture.load()
