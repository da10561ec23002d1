"""The non-blind deconvolution that judges kernels: the same prior and settings for every kernel.

It is kept apart from `lensmodel.correction` on purpose: a judge must not change when the product does. It
takes a patch as it is, `lab.correction.methods.EpllDeconvolver` whole planes, by the same mixture and steps.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.correction.methods.mixture import shipped_mixture
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Kernel, Plane

BORDER: Final = 28
"""Pixels along the rim that do not count: light from outside the patch reaches so far."""

Spectrum = NDArray[np.complex128]

_BETAS: Final = (50.0, 100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0)
_STEP: Final = 3  # pixels between windows (chosen): all of them take nine times as long


def deconvolved(patch: Plane, kernel: Kernel, sigma: float, shift: tuple[float, float]) -> Plane:
    """Return the sharp patch, of the same shape, by its expected patch log likelihood [1]_.

    See `PatchMixture.restored`; `shift` (row, col) moves the kernel first, sub-pixel.

    References
    ----------
    .. [1] D. Zoran and Y. Weiss, "From learning models of natural image patches to whole image
       restoration", ICCV 2011, eq. (4) to (6).
    """
    y = tapered(patch, BORDER)
    otf = shifted_otf(kernel, (y.shape[0], y.shape[1]), shift)
    x = shipped_mixture().restored(y, otf, 1.0 / (sigma * sigma), _BETAS, _STEP)
    return np.asarray(x[BORDER:-BORDER, BORDER:-BORDER].astype(np.float32))


def shifted_otf(kernel: Kernel, shape: tuple[int, int], shift: tuple[float, float]) -> Spectrum:
    """Transfer function of a kernel moved by `shift` pixels; exact, by phase.

    As a kernel, a sub-pixel shift by phase would ring below zero. Deconvolution needs its
    spectrum only, where the shift is just a phase.
    """
    size = kernel.shape[0]
    if size > min(shape):
        raise InvalidInputError(f"a kernel of side {size} does not fit a patch of {shape}")
    grid = np.zeros(shape)
    grid[:size, :size] = kernel / kernel.sum()
    fr, fc = fft.fftfreq(shape[0])[:, None], fft.rfftfreq(shape[1])[None, :]
    middle = size // 2
    phase = fr * (shift[0] - middle) + fc * (shift[1] - middle)
    return np.asarray(fft.rfft2(grid) * np.exp(-2j * np.pi * phase))


def tapered(patch: Plane, margin: int) -> NDArray[np.float64]:
    """Pad by mirror images that fade into each other around the edge of a torus.

    The Fourier transform takes a patch for periodic; a jump at its edge would ring far inwards.
    """
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
