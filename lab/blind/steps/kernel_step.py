"""The kernel step: least squares over valid convolutions, k >= 0, pooled over any number of images.

Valid means that only pixels count where every pixel of the kernel meets data; nothing wraps.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.blind.estimator import PsfEstimate, finished
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Kernel

Floats = NDArray[np.float32]
Spectrum = NDArray[np.complex64]
Kernelish = NDArray[np.float64]

_TINY = 1e-12  # keeps divisions finite: far below any power
_EIGHT_NEIGHBOURS = np.ones((3, 3), dtype=np.int_)  # pixels that touch at a corner belong together


@dataclass(frozen=True, slots=True)
class Grid:
    """Shapes of one valid convolution y = k * x, and its products by FFT."""

    frame: tuple[int, int]  # shape of y
    side: int  # odd side of k; x is wider than y by `side - 1`

    @property
    def latent(self) -> tuple[int, int]:
        """Shape of x."""
        return self.frame[0] + self.side - 1, self.frame[1] + self.side - 1

    @property
    def fast(self) -> tuple[int, int]:
        """Shape of the transforms: nothing of the valid part wraps."""
        rows, cols = self.latent
        return int(fft.next_fast_len(rows, real=True)), int(fft.next_fast_len(cols, real=True))

    def spectrum(self, values: NDArray[np.floating]) -> Spectrum:
        """Transform of an array whose first pixel lies at the origin."""
        return fft.rfft2(values.astype(np.float32), self.fast)

    def frame_spectrum(self, residual: Floats) -> Spectrum:
        """Transform of an array on the frame, at its place behind the first `side - 1` pixels."""
        reach = self.side - 1
        return fft.rfft2(np.pad(residual, ((reach, 0), (reach, 0))), self.fast)

    def valid(self, product: Spectrum) -> Floats:
        """Valid part of a convolution given by the product of two spectra."""
        reach = self.side - 1
        full = fft.irfft2(product, self.fast)
        return full[reach : reach + self.frame[0], reach : reach + self.frame[1]]

    def blurred(self, kernel: Kernelish, x: Floats) -> Floats:
        """Return k * x on the frame."""
        return self.valid(self.spectrum(kernel) * self.spectrum(x))

    def back(self, kernel_spectrum: Spectrum, residual: Floats) -> Floats:
        """Adjoint in x: from the frame to the latent plane."""
        rows, cols = self.latent
        return fft.irfft2(self.frame_spectrum(residual) * np.conj(kernel_spectrum), self.fast)[:rows, :cols]

    def onto_kernel(self, x_spectrum: Spectrum, residual: Floats) -> Kernelish:
        """Adjoint in k: sum_p e(p) x(p - u) for every kernel pixel u."""
        product = self.frame_spectrum(residual) * np.conj(x_spectrum)
        return fft.irfft2(product, self.fast)[: self.side, : self.side].astype(np.float64)

    def reach_of(self, kernel: Kernelish) -> Floats:
        """w_i = sum_j k_j² over the kernel pixels by which latent pixel i reaches the frame."""
        ones = np.ones(self.frame, dtype=np.float32)
        return np.maximum(self.back(self.spectrum(kernel**2), ones), _TINY)

    def sums_of(self, variance: Floats) -> Kernelish:
        """sum_i c_i for every kernel pixel j, over the latent pixels that j carries into the frame."""
        total = np.zeros((self.latent[0] + 1, self.latent[1] + 1))
        total[1:, 1:] = variance.astype(np.float64).cumsum(axis=0).cumsum(axis=1)
        high, wide = self.frame
        boxes = total[high:, wide:] - total[:-high, wide:] - total[high:, :-wide] + total[:-high, :-wide]
        return boxes[::-1, ::-1]


def conjugate_gradients(
    applied: Callable[[Any], Any],
    residual: NDArray[Any],
    start: NDArray[Any],
    steps: int,
    *,
    inverse: Callable[[Any], Any] = lambda residual: residual,
    least: float = _TINY,
) -> NDArray[Any]:
    """Solve A x = b from a start with its residual b - A x; `inverse` is about that of A, `least` ends it."""
    x, ready = start, inverse(residual)
    direction, power = ready, float(np.vdot(residual, ready))
    for _ in range(steps):
        if power <= least:
            break
        product = applied(direction)
        length = power / max(float(np.vdot(direction, product)), 1e-30)
        x = x + length * direction
        residual = residual - length * product
        ready = inverse(residual)
        before, power = power, float(np.vdot(residual, ready))
        direction = ready + power / before * direction
    return x


@dataclass(frozen=True, slots=True, eq=False)
class Term:
    """One summand w (|y - k * x|² + sum_j q_j k_j²) of the kernel step."""

    grid: Grid
    y: Floats
    x: Floats
    weight: float  # w
    quadratic: Kernelish | float = 0.0  # (side, side), q


def least_squares_kernel(
    terms: Sequence[Term], kernel: Kernelish, *, turns: int = 2, steps: int = 80
) -> Kernelish:
    """Minimise the sum of terms over k >= 0, from `kernel` on.

    The normal matrix of the valid convolution is nearly Toeplitz. Each turn takes the exact gradient
    at k and the nearest Toeplitz matrix, by which accelerated projected gradients run on a small
    FFT; a few turns come to the exact minimum, where the matrix no longer matters.
    """
    side = kernel.shape[0]
    n = int(fft.next_fast_len(2 * side, real=True))
    correlation, diagonal = np.zeros((n, n)), np.zeros((side, side))
    spectra = []
    for term in terms:
        spectra.append(term.grid.spectrum(term.x))
        correlation += term.weight * _mean_correlation(term, n)
        diagonal += term.weight * term.quadratic
    # Cutting the correlation at the kernel's side can leave negative power.
    toeplitz = np.maximum(fft.rfft2(correlation).real, 0.0)
    step = 1.0 / (float(toeplitz.max()) + float(diagonal.max()) + _TINY)

    def applied(k: Kernelish) -> Kernelish:
        return fft.irfft2(toeplitz * fft.rfft2(k, (n, n)), (n, n))[:side, :side] + diagonal * k

    k = np.array(kernel)
    for _ in range(turns):
        target = applied(k) - diagonal * k
        for term, spectrum in zip(terms, spectra, strict=True):
            grid = term.grid
            residual = term.y - grid.valid(grid.spectrum(k) * spectrum)
            target += term.weight * grid.onto_kernel(spectrum, residual)
        momentum, t = k, 1.0
        for _ in range(steps):
            after = np.maximum(momentum - step * (applied(momentum) - target), 0.0)
            t_next = 0.5 * (1.0 + np.sqrt(1.0 + 4.0 * t * t))
            momentum = after + (t - 1.0) / t_next * (after - k)
            k, t = after, t_next
    return k


def _mean_correlation(term: Term, n: int) -> Kernelish:
    """Mean over u of sum_p x(p - u) x(p - u - d) with p on the frame, for |d| < side, wrapped to n x n.

    A pixel counts by the share of shifts u that carry it into the frame, the root of it in either factor.
    """
    grid = term.grid
    rows, cols = (np.convolve(np.ones(length), np.full(grid.side, 1.0 / grid.side)) for length in grid.frame)
    weighted = np.sqrt(np.outer(rows, cols)) * term.x
    high, wide = (int(fft.next_fast_len(length + grid.side, real=True)) for length in grid.latent)
    full = fft.irfft2(np.abs(fft.rfft2(weighted, (high, wide))) ** 2, (high, wide))
    lags = np.arange(-(grid.side - 1), grid.side)
    wrapped = np.zeros((n, n))
    wrapped[np.ix_(lags % n, lags % n)] = full[np.ix_(lags % high, lags % wide)]
    return wrapped


def cleaned(kernel: NDArray[np.float64], threshold: float, least_mass: float = 0.0) -> Kernel:
    """Drop values below `threshold` times the peak and islands below `least_mass` of the sum."""
    kept = np.maximum(kernel, 0.0)
    if not kept.max() > 0:
        raise NotEnoughEvidenceError("the kernel vanished; the patches hold no detail beyond the noise")
    kept = np.where(kept >= threshold * kept.max(), kept, 0.0)
    if least_mass > 0.0:
        label, count = ndimage.label(kept > 0, _EIGHT_NEIGHBOURS)
        mass = np.bincount(label.ravel(), weights=kept.ravel(), minlength=count + 1)
        mass[0] = 0.0
        heavy = mass >= min(least_mass * float(mass.sum()), float(mass.max()))
        heavy[0] = False
        kept = np.where(heavy[label], kept, 0.0)
    return as_kernel(kept)


def unsure(kernel: Kernel, size: int) -> PsfEstimate:
    """An estimate of odd side `size` whose method does not say how far it is off."""
    return finished(kernel, size=size, error=math.nan)
