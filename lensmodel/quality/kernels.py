"""What a kernel says about sharpness: MTF along a direction, MTF50."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Kernel
from lensmodel.quality.edge import crossing

_FREQUENCIES: Final = 513  # from 0 to 1 cycle/pixel: steps of 1/512


def mtf_from_kernel(kernel: Kernel, angle: float, frequencies: ArrayLike) -> NDArray[np.float64]:
    """Contrast that a kernel leaves of waves whose normal has an angle, by frequency in cycles/pixel.

    It is the modulus of the transfer function along a line::

        MTF(f) = | sum k(row, col) exp(-2 pi i f (col cos(angle) - row sin(angle))) |

    At field angle phi, `phi` gives the tangential MTF (contrast along u), `phi + pi/2` the sagittal one.
    """
    k = as_kernel(kernel)
    f = np.atleast_1d(np.asarray(frequencies, dtype=np.float64))
    along_rows, along_cols = (_waves(f * step, k.shape[0]) for step in (math.sin(angle), -math.cos(angle)))
    # over rows, then over columns: a plan for all three factors would take longer than one frequency
    return np.abs(np.einsum("fc,fc->f", along_rows @ k, along_cols))


def _waves(frequencies: NDArray[np.float64], side: int) -> NDArray[np.complex128]:
    """exp(2 pi i f t) at each pixel t of a side, 0 in the middle; one half is the conjugate of the other."""
    upward = np.exp(2j * np.pi * np.outer(frequencies, np.arange(1, side // 2 + 1)))
    return np.concatenate([upward[:, ::-1].conj(), np.ones((frequencies.size, 1)), upward], axis=1)


def mtf50_from_kernel(kernel: Kernel, angle: float) -> float:
    """Frequency in cycles/pixel where the contrast along `angle` falls to one half, 1.0 if never."""
    f = np.linspace(0.0, 1.0, _FREQUENCIES)
    return crossing(f, mtf_from_kernel(kernel, angle, f), 0.5)


def tangential_sagittal_mtf50(kernel: Kernel, phi: float) -> tuple[float, float]:
    """MTF50 along u and along v of a kernel at field angle `phi`, cycles/pixel."""
    return mtf50_from_kernel(kernel, phi), mtf50_from_kernel(kernel, phi + math.pi / 2.0)
