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
    couplings: Sequence[float],
    target: Callable[[NDArray[Any], int], NDArray[np.complexfloating[Any, Any]]],
    on_step: StepHook = ignore_step,
) -> NDArray[Any]:
    """Alternate between the prior's answer to the latest x and the data, for growing coupling beta.

    ::

        X = (data + beta T(x)) / (power + beta)

    Parameters
    ----------
    y : ndarray, shape (rows, cols)
        The blurred grid, where x begins; x keeps its type.
    data, power : ndarray, shape (rows, cols // 2 + 1)
        conj(K) Y and |K|², both over the variance of the noise.
    couplings : sequence of float
        beta of each turn.
    target : callable
        From x and the number of the turn the spectrum T of what the prior makes of x.
    on_step : callable
        Called after each turn.

    Returns
    -------
    ndarray, shape (rows, cols)
        x after the last turn.
    """
    x = y
    for turn, beta in enumerate(couplings):
        spectrum = (data + beta * target(x, turn)) / (power + beta)
        x = fft.irfft2(spectrum, s=y.shape).astype(y.dtype, copy=False)
        on_step(turn + 1, len(couplings))
    return x
