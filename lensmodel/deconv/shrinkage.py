"""Shrinkage of gradients towards zero: the proximal map of |w|^alpha."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.errors import InvalidInputError

_KNOTS = 2048
_REACH = 24.0


@dataclass(frozen=True, slots=True, eq=False)
class Shrinkage:
    """The minimiser of t |w|^alpha + (w - v)² / 2, by one table for all t.

    With s = t^(1 / (2 - alpha)) the substitution w = s u leaves t = 1, so that
    ``prox_t(v) = s prox_1(v / s)``. Beyond the table |v| - alpha |v|^(alpha - 1) is exact enough.

    Parameters
    ----------
    alpha : float
        Exponent of the hyper-Laplacian in (0, 1]; 1 is soft thresholding.
    jump : float
        |v| up to which the answer is 0, for t = 1.
    table : ndarray
        Answers for t = 1 on an even grid from the jump on.
    """

    alpha: float
    jump: float
    table: NDArray[np.float32]

    @classmethod
    def of(cls, alpha: float) -> Shrinkage:
        """Build the table by Newton steps from v, beyond the jump only.

        D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors", NIPS 2009.
        """
        if not 0.0 < alpha <= 1.0:
            raise InvalidInputError(f"alpha must lie in (0, 1], got {alpha}")
        # Where the energies of w = 0 and of the other minimum are equal the answer jumps.
        jump_w = (2.0 * (1.0 - alpha)) ** (1.0 / (2.0 - alpha))
        jump = jump_w + alpha * jump_w ** (alpha - 1.0) if alpha < 1.0 else 1.0
        v = np.linspace(jump, jump + _REACH, _KNOTS + 1)
        w = v.copy()
        for _ in range(40):
            safe = np.maximum(w, 1e-6)
            slope = alpha * safe ** (alpha - 1.0) + w - v
            bend = alpha * (alpha - 1.0) * safe ** (alpha - 2.0) + 1.0
            w = np.clip(w - slope / np.where(np.abs(bend) < 1e-3, 1e-3, bend), jump_w, v)
        return cls(alpha, float(jump), w.astype(np.float32))

    def scale(self, threshold: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """S for a threshold t."""
        return np.asarray(np.power(threshold, 1.0 / (2.0 - self.alpha)), dtype=np.float32)

    def __call__(self, v: NDArray[np.float32], scale: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Shrink `v`, any shape, with the scale s that broadcasts against it."""
        ratio = np.abs(v) / np.maximum(scale, np.float32(1e-12))
        past = ratio - np.float32(self.jump)
        place = np.clip(past, 0.0, np.float32(_REACH)) * np.float32(_KNOTS / _REACH)
        low = np.minimum(place.astype(np.int32), _KNOTS - 1)
        share = place - low
        near = self.table[low] * (1 - share) + self.table[low + 1] * share
        tail = self.table[-1] - np.float32(_REACH)
        shrunk = np.where(past < np.float32(_REACH), near, past + tail)
        shrunk = np.where(past > 0.0, shrunk, np.float32(0.0))
        return np.asarray(np.copysign(shrunk * scale, v), dtype=np.float32)
