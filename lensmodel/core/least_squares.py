"""Least squares for values that cannot be negative, as those of a kernel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def nonnegative_least_squares(
    a: NDArray[np.float64], b: NDArray[np.float64], start: NDArray[np.float64], steps: int = 200
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 by accelerated projected gradients (FISTA).

    Parameters
    ----------
    a : ndarray, shape (n, n)
        Symmetric; directions of negative curvature, which noise correction can leave, are lifted.
    b, start : ndarray, shape (n,)
        Where A is zero, nothing is known and the start is returned.
    """
    if not a.any():
        return start.copy()
    eigenvalues = np.linalg.eigvalsh(a)
    largest = float(eigenvalues[-1])
    lift = max(1e-6 * largest - float(eigenvalues[0]), 0.0)
    step = 1.0 / (largest + lift)
    k, momentum, t = start.copy(), start.copy(), 1.0
    for _ in range(steps):
        after = np.maximum(momentum - step * (a @ momentum + lift * momentum - b), 0.0)
        t_next = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
        momentum = after + (t - 1.0) / t_next * (after - k)
        k, t = after, t_next
    return k
