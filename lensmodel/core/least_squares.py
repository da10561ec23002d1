"""Least squares for values that cannot be negative, as those of a kernel."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are needed
from numpy.typing import NDArray

_LEAST: Final = 1e-6  # of the largest eigenvalue: the least that is left (chosen, far below any noise)
_FEW: Final = 256  # unknowns up to which all eigenvalues take no longer than the largest and least (chosen)


def nonnegative_least_squares(
    a: NDArray[np.float64],
    b: NDArray[np.float64],
    start: NDArray[np.float64],
    steps: int = 200,
    *,
    smallest: float = -np.inf,
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 by accelerated projected gradients (FISTA)."""
    if not a.any():
        return start.copy()
    largest, lift = _largest_and_lift(a, smallest)
    step = 1.0 / (largest + lift)
    k, momentum, t = start.copy(), start.copy(), 1.0
    for _ in range(steps):
        after = np.maximum(momentum - step * (_product(a, momentum) + lift * momentum - b), 0.0)
        t_next = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
        momentum = after + (t - 1.0) / t_next * (after - k)
        k, t = after, t_next
    return k


def _largest_and_lift(a: NDArray[np.float64], smallest: float) -> tuple[float, float]:
    """Largest eigenvalue, and what all are lifted by so that none is below `_LEAST` of that.

    All eigenvalues of a kernel of 55 x 55 pixels take ten times as long as to find out by a Cholesky
    factor that none is too small, as is usual.
    """
    if len(a) > _FEW:
        start = np.ones(len(a))
        largest = float(scipy.sparse.linalg.eigsh(a, 1, v0=start, return_eigenvectors=False)[0])
        least = _LEAST * largest
        if largest > 0.0 and (smallest > least or _positive(a - least * np.eye(len(a)))):
            return largest, 0.0
    eigenvalues = np.linalg.eigvalsh(a)
    largest = float(eigenvalues[-1])
    return largest, max(_LEAST * largest - float(eigenvalues[0]), 0.0)


def _product(a: NDArray[np.float64], k: NDArray[np.float64]) -> NDArray[np.float64]:
    """A k of a symmetric matrix; of a large one only a half is read."""
    return np.asarray(scipy.linalg.blas.dsymv(1.0, a.T, k) if len(a) > _FEW else a @ k)


def _positive(a: NDArray[np.float64]) -> bool:
    """Whether a symmetric matrix is positive definite; it is overwritten."""
    try:
        scipy.linalg.cholesky(a, overwrite_a=True, check_finite=False)
    except np.linalg.LinAlgError:
        return False
    return True
