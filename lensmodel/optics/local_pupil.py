"""Kernels of one field position from the aberrations that third-order theory has there, by FFT.

With the pupil p (right, up; |p| <= 1) and q = wavelength x f-number / pixel pitch::

    E(x) = sum_p exp(i pi / q (sum_k g_k B_k(p) - p . x)),      k(pixel) = integral of |E|^2

so that g is in pixels of blur, whatever the wavelength. The terms B are |p|^4, px |p|^2, py |p|^2, |p|^2,
px^2 - py^2, 2 px py, px, py. A patch does not say at which aperture it was taken: q is fixed, at what
f/2.9 has on pixels of 4.5 µm. Diffraction hardly shows beside the aberrations that are looked for here.

Source: J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, eq. 6-20 and 6-24.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

COMA: Final = (1, 2)
"""Terms that a turn by 180 degrees negates, but for the tilts."""

_Q = 0.35  # q of `pupil` that is taken for all patches: f/2.9 at 4.5 um and 0.54 um (chosen)
_FINE = 3  # samples per pixel: at 2 the pixel lets aliases pass, more cost time in each step (chosen)

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class Pupil:
    """The pupil laid out for kernels of one side.

    Parameters
    ----------
    size : int
        Odd side of the kernels; light beyond comes in again on the other side.
    terms : ndarray of float32, shape (TERMS, n, n)
        The terms B, inside the stop and outside.
    stop : ndarray of float32, shape (n, n)
        Transmission, its edge one sample wide.
    """

    size: int
    terms: NDArray[np.float32]
    stop: NDArray[np.float32]

    @classmethod
    def of(cls, size: int) -> Pupil:
        """Lay out the pupil for kernels of odd side `size`, pixels; layouts are remembered."""
        return _laid_out(size)

    def kernel(self, g: Floats) -> tuple[Floats, Floats]:
        """Kernel of sum 1, not centred, and its derivatives.

        Parameters
        ----------
        g : ndarray, shape (TERMS,)
            Pixels.

        Returns
        -------
        kernel : ndarray, shape (size, size)
        derivatives : ndarray, shape (TERMS, size, size)
        """
        angle = np.tensordot((g * (math.pi / _Q)).astype(np.float32), self.terms, axes=1)
        wave = self.stop * np.exp(1j * angle)
        waves = np.concatenate([wave[None], wave * self.terms]).astype(np.complex64)
        n = _FINE * (self.size + 1)
        fields = fft.fft2(waves, (n, n))
        # The frame begins at the middle of the light: quarter it and swap.
        light = np.empty(fields.shape, dtype=np.float32)
        light[0] = fields[0].real ** 2 + fields[0].imag ** 2
        # d|E|^2 = 2 Re(conj(E) i pi/q F) = -2 pi/q Im(conj(E) F)
        light[1:] = (fields[0].imag * fields[1:].real - fields[0].real * fields[1:].imag) * (
            2.0 * math.pi / _Q
        )
        pixels = np.roll(light, (n // 2, n // 2), axis=(1, 2))[:, 2 : n - 1, 2 : n - 1]
        side = self.size
        summed = pixels.reshape(-1, side, _FINE, side, _FINE).sum(axis=(2, 4), dtype=np.float64)
        total = float(summed[0].sum())
        kernel, change = summed[0] / total, summed[1:] / total
        return kernel, change - kernel * change.sum(axis=(1, 2))[:, None, None]


@lru_cache(maxsize=4)
def _laid_out(size: int) -> Pupil:
    step = 2.0 * _Q / (size + 1)
    n = 2 * math.ceil(1.0 / step) + 1
    along = (np.arange(n) - n // 2) * step
    px, py = np.meshgrid(along, -along)
    square = px * px + py * py
    terms = np.stack([square**2, px * square, py * square, square, px * px - py * py, 2 * px * py, px, py])
    stop = np.clip((1.0 - np.sqrt(square)) / step + 0.5, 0.0, 1.0)
    return Pupil(size, terms.astype(np.float32), stop.astype(np.float32))
