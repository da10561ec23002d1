"""How inner loops are compiled; least squares for values that cannot be negative, as those of a kernel."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Final, TypeAlias, TypeVar, cast

import numba
import numpy as np
import scipy  # its parts are loaded when they are needed
from numpy.typing import NDArray

F = TypeVar("F", bound=Callable[..., Any])


def jit(function: F) -> F:
    """Compile without the interpreter's lock, keep the machine code on disk."""
    fastmath = {"nsz", "contract", "reassoc", "arcp"}
    compiled = numba.njit(cache=True, nogil=True, fastmath=fastmath, error_model="numpy")(function)
    return cast("F", compiled)


_Vector: TypeAlias = NDArray[np.float64]

_LIFT: Final = 1e-6  # of the largest eigenvalue, by which all are lifted (chosen, far below any noise)


def nonnegative_least_squares(
    a: NDArray[np.float64], b: NDArray[np.float64], start: NDArray[np.float64], steps: int = 200
) -> NDArray[np.float64]:
    """Minimise k'Ak/2 - b'k over k >= 0 by FISTA; scipy's `nnls` wants the matrix of residuals."""
    if not a.any():
        return start.copy()
    first = np.ones(len(a))  # else a random one
    largest = float(scipy.sparse.linalg.eigsh(a, 1, v0=first, return_eigenvectors=False)[0])
    lift, transposed = _LIFT * largest, a.T

    def gradient(k: _Vector) -> _Vector:
        return np.asarray(scipy.linalg.blas.dsymv(1.0, transposed, k)) + lift * k - b  # reads half of A

    return fista(gradient, start, 1.0 / (largest + lift), lambda k: np.maximum(k, 0.0), steps=steps)


def fista(
    gradient: Callable[[_Vector], _Vector],
    start: _Vector,
    step: float,
    project: Callable[[_Vector], _Vector],
    *,
    steps: int,
    still: float = 0.0,
) -> _Vector:
    """Minimise over a convex set by accelerated projected gradients, until no value moves by `still`.

    Source: A. Beck and M. Teboulle, "A fast iterative shrinkage-thresholding algorithm", SIAM J. Imaging
    Sciences 2, 2009.
    """
    k, momentum, t = start.copy(), start.copy(), 1.0
    for _ in range(steps):
        after = project(momentum - step * gradient(momentum))
        t_next = 0.5 * (1.0 + math.sqrt(1.0 + 4.0 * t * t))
        momentum = after + (t - 1.0) / t_next * (after - k)
        moved = float(np.abs(after - k).max()) if still else 1.0
        k, t = after, t_next
        if moved < still:
            break
    return k


def on_simplex(values: NDArray[np.float64], total: float) -> NDArray[np.float64]:
    """Nearest values that are not negative and have this sum.

    Source: J. Duchi et al., "Efficient projections onto the l1-ball for learning in high dimensions",
    ICML 2008, figure 1.
    """
    falling = np.sort(values)[::-1]
    excess = (np.cumsum(falling) - total) / np.arange(1, len(values) + 1)
    last = int(np.nonzero(falling > excess)[0][-1])
    return np.asarray(np.maximum(values - excess[last], 0.0))
