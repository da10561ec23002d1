"""Two non-blind deconvolvers that judge kernels: the same solver and settings for every kernel.

They are kept apart from `lensmodel.correction` on purpose: a judge must not change when the product
does. So there is a second shrinkage here, a table in float64 beside the polynomial in float32 of
`lensmodel.correction.methods.shrinkage`, and a second `deconvolve` by the mixture of
`lab.correction.methods`, of patches as they are and not of photos.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Final, Protocol

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.correction.methods.half_quadratic import growing, half_quadratic
from lab.correction.methods.mixture import shipped_mixture
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.registry import Registry
from lensmodel.core.types import Kernel, Plane

BORDER: Final = 28
"""Pixels along the rim that do not count: light from outside the patch reaches so far."""

Spectrum = NDArray[np.complex128]


class Judge(Protocol):
    """Non-blind deconvolution of one patch by one kernel."""

    @property
    def version(self) -> int:
        """Grows when results change."""

    def deconvolve(self, patch: Plane, kernel: Kernel, sigma: float, shift: tuple[float, float]) -> Plane:
        """Return the sharp patch, same shape; `shift` (row, col) moves the kernel first, sub-pixel."""


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


_WEIGHT: Final = 0.06  # over the variance of the noise: lambda (chosen)
_BETAS: Final = (
    1.0,
    256.0,
    2.0 * math.sqrt(2.0),
)  # from, to, and by which factor: as in the paper of the prior
_EXPONENT: Final = 2.0 / 3.0


class HyperLaplacian:
    """Deconvolution under a hyper-Laplacian prior on gradients, by half-quadratic splitting.

    Minimises, over the latent x with auxiliary gradients w::

        lambda/2 |k * x - y|² + sum |w|^(2/3) + beta/2 |grad x - w|²,   lambda = weight / sigma²

    with beta growing from 1 to 256.

    References
    ----------
    .. [1] D. Krishnan and R. Fergus, "Fast image deconvolution using hyper-Laplacian priors",
       NIPS 2009, eq. (3) to (5).
    """

    version = 1

    def deconvolve(self, patch: Plane, kernel: Kernel, sigma: float, shift: tuple[float, float]) -> Plane:
        """Return the sharp patch; see `Judge`."""
        y = tapered(patch, BORDER)
        otf = shifted_otf(kernel, (y.shape[0], y.shape[1]), shift)
        fr, fc = fft.fftfreq(y.shape[0])[:, None], fft.rfftfreq(y.shape[1])[None, :]
        # Forward differences on the torus.
        dr, dc = np.exp(2j * np.pi * fr) - 1.0, np.exp(2j * np.pi * fc) - 1.0
        lam = _WEIGHT / (sigma * sigma)
        data, power = lam * np.conj(otf) * fft.rfft2(y), lam * np.square(np.abs(otf))
        laplacian = np.square(np.abs(dr)) + np.square(np.abs(dc))
        betas = growing(*_BETAS)

        def led_back(x: NDArray[np.float64], turn: int) -> Spectrum:
            spectrum = fft.rfft2(x)
            total = np.zeros_like(spectrum)
            for d in (dr, dc):
                gradient = fft.irfft2(d * spectrum, s=x.shape)
                total += np.conj(d) * fft.rfft2(_tabled_shrinkage(gradient, betas[turn]))
            return total

        return _inner(half_quadratic(y, data, power, betas, led_back, curvature=laplacian, floor=1e-12))


_TABLE_REACH: Final = 1.5  # where tables end at least: gradients of scenes in 0..1 hardly go beyond (chosen)


@lru_cache(maxsize=32)
def _shrinkage_table(beta: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Minimiser of |w|^a + beta/2 (w - v)² where it is not 0: from the jump upwards.

    With s = beta^(-1 / (2 - a)), both minima cost the same at w = s (2 - 2a)^(1 / (2 - a)). Nothing may be
    interpolated across the jump: between 0 and that w lies no minimum.
    """
    scale = beta ** (-1.0 / (2.0 - _EXPONENT))
    least = scale * (2.0 - 2.0 * _EXPONENT) ** (1.0 / (2.0 - _EXPONENT))
    jump = least + _EXPONENT / beta * least ** (_EXPONENT - 1.0)
    v = np.linspace(jump, max(_TABLE_REACH, 2.0 * jump), 3001)
    w = v.copy()
    for _ in range(30):
        slope = _EXPONENT * w ** (_EXPONENT - 1.0) + beta * (w - v)
        curvature = _EXPONENT * (_EXPONENT - 1.0) * w ** (_EXPONENT - 2.0) + beta
        w = np.clip(w - slope / curvature, least, v)
    return v, w


def _tabled_shrinkage(v: NDArray[np.float64], beta: float) -> NDArray[np.float64]:
    grid, value = _shrinkage_table(beta)
    size = np.abs(v)
    # Beyond the table the power hardly moves the minimum.
    beyond = size - _EXPONENT / beta * np.maximum(size, grid[-1]) ** (_EXPONENT - 1.0)
    inside = np.where(size < grid[0], 0.0, np.interp(size, grid, value))
    return np.copysign(np.where(size > grid[-1], beyond, inside), v)


def _inner(x: NDArray[np.float64]) -> Plane:
    return x[BORDER:-BORDER, BORDER:-BORDER].astype(np.float32)


_EPLL_BETAS: Final = (50.0, 100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0)
_EPLL_STEP: Final = 3  # pixels between windows (chosen): all of them take nine times as long


class Epll:
    """Expected patch log likelihood [1]_ of one patch, see `PatchMixture.restored`.

    `lab.correction.methods.EpllDeconvolver` restores whole planes by the same steps.

    References
    ----------
    .. [1] D. Zoran and Y. Weiss, "From learning models of natural image patches to whole image
       restoration", ICCV 2011, eq. (4) to (6).
    """

    version = 1

    def deconvolve(self, patch: Plane, kernel: Kernel, sigma: float, shift: tuple[float, float]) -> Plane:
        """Return the sharp patch; see `Judge`."""
        y = tapered(patch, BORDER)
        otf = shifted_otf(kernel, (y.shape[0], y.shape[1]), shift)
        return _inner(shipped_mixture().restored(y, otf, 1.0 / (sigma * sigma), _EPLL_BETAS, _EPLL_STEP))


judges: Registry[Judge] = Registry("non-blind judge", {"hyper-laplacian": HyperLaplacian, "epll": Epll})


def squared_error(a: Plane, b: Plane) -> float:
    """Sum of squared differences, the rim of `BORDER` pixels left out."""
    inner = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))
    return float(np.square(a[inner].astype(np.float64) - b[inner]).sum())
