"""Half-quadratic splitting by Fourier transform: the loop that the methods compared share."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import StepHook, ignore_step


def half_quadratic(
    y: NDArray[Any],
    data: NDArray[np.complexfloating[Any, Any]],
    power: NDArray[np.floating[Any]],
    couplings: Sequence[float | np.float32],
    target: Callable[[NDArray[Any], int], NDArray[np.complexfloating[Any, Any]]],
    on_step: StepHook = ignore_step,
    *,
    curvature: NDArray[np.floating[Any]] | float = 1.0,
) -> NDArray[Any]:
    """Alternate between the prior's answer to the latest x and the data, for growing coupling beta.

    ::

        X = (data + beta T(x)) / (power + beta C)

    Returns
    -------
    ndarray, shape (rows, cols)
        x after the last turn.
    """
    x = y
    for turn, beta in enumerate(couplings):
        spectrum = (data + beta * target(x, turn)) / (power + beta * curvature)
        x = fft.irfft2(spectrum, s=y.shape).astype(y.dtype, copy=False)
        on_step(turn + 1, len(couplings))
    return x


def growing(first: float, last: float, factor: float) -> tuple[float, ...]:
    """Return couplings from `first`, each `factor` times the one before, up to `last` and a thousandth."""
    betas = [first] if first <= last * 1.001 else []
    while betas and betas[-1] * factor <= last * 1.001:
        betas.append(betas[-1] * factor)
    return tuple(betas)
