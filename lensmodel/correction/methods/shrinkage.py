"""Shrinkage of gradients towards zero: the proximal map of |w|^alpha."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError

DEGREE = 9  # of the polynomial: a shorter one misses the bend at the jump, each term costs a step (chosen)
_REACH = 24.0  # largest argument, in widths of the shrinkage: beyond, hardly anything is taken off (chosen)
_SHARP = 1e-6  # share of a jump that float32 resolves


@dataclass(frozen=True, slots=True, eq=False)
class Shrinkage:
    """The minimiser of t |w|^alpha + (w - v)² / 2, by one polynomial for all t.

    With s = t^(1 / (2 - alpha)) the substitution w = s u leaves t = 1::

        prox_t(v) = s prox_1(v / s),      prox_1(v) = v - p(1 / v)  beyond the jump, else 0

    What is subtracted from v is smooth in 1 / v, so a short polynomial p suffices: unlike a table it
    runs in vector registers. Beyond 24 s the subtraction is held constant.

    Parameters
    ----------
    alpha : float
        Exponent of the hyper-Laplacian in (0, 1]; 1 is soft thresholding.
    jump : float
        |v| up to which the answer is 0, for t = 1.
    terms : ndarray
        Coefficients of p, highest power first.
    ramp : float
        Share of the jump over which the answer rises from 0 instead. A rounding error decides on which
        side of a jump a gradient falls, and steps that follow make a visible pixel of it.
    """

    alpha: float
    jump: float
    terms: NDArray[np.float32]
    ramp: float = 0.0

    @staticmethod
    @lru_cache(maxsize=16)  # one fit per exponent, not one per tile
    def of(alpha: float, ramp: float = 0.0) -> Shrinkage:
        """Fit the polynomial to the answers found by Newton steps.

        D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors", NIPS 2009.
        """
        if not 0.0 < alpha <= 1.0:
            raise InvalidInputError(f"alpha must lie in (0, 1], got {alpha}")
        # Where the energies of w = 0 and of the other minimum are equal the answer jumps.
        jump_w = (2.0 * (1.0 - alpha)) ** (1.0 / (2.0 - alpha))
        jump = jump_w + alpha * jump_w ** (alpha - 1.0) if alpha < 1.0 else 1.0
        low, high = 1.0 / _REACH, 1.0 / jump
        nodes = np.cos(np.pi * (np.arange(400) + 0.5) / 400)
        inverse = low + (high - low) * (nodes + 1.0) / 2.0
        v = 1.0 / inverse
        w = v.copy()
        for _ in range(40):
            slope = alpha * w ** (alpha - 1.0) + w - v
            bend = alpha * (alpha - 1.0) * w ** (alpha - 2.0) + 1.0
            w = np.clip(w - slope / np.where(np.abs(bend) < 1e-3, 1e-3, bend), max(jump_w, 1e-9), v)
        terms = np.polynomial.Polynomial.fit(inverse, v - w, DEGREE).convert().coef[::-1]
        return Shrinkage(alpha, float(jump), terms.astype(np.float32), ramp)

    @property
    def edge(self) -> float:
        """1 / v for t = 1 where the answer begins to rise."""
        return 1.0 / self.jump

    @property
    def steepness(self) -> float:
        """Slope of the ramp that begins at `edge`, per 1 / v."""
        return self.jump / max(1.0 - 1.0 / (1.0 + self.ramp), _SHARP)

    def scale(self, threshold: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """The scale s for a threshold t."""
        return np.asarray(np.power(threshold, 1.0 / (2.0 - self.alpha)), dtype=np.float32)

    def __call__(self, v: NDArray[np.float32], scale: NDArray[np.float32] | float) -> NDArray[np.float32]:
        """Shrink `v`, any shape, with the scale s that broadcasts against it."""
        size = np.maximum(np.abs(v), 1e-20)
        below = scale / size
        subtracted = np.polyval(self.terms, np.clip(below, 1.0 / _REACH, self.edge))
        share = np.clip((self.edge - below) * self.steepness, 0.0, 1.0)
        return np.asarray(np.sign(v) * (size - scale * subtracted) * share, dtype=np.float32)
