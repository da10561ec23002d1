"""From a wavefront to a PSF on pixels: Fourier optics with exact sampling.

The field behind the exit pupil is transformed, its intensity is integrated over square pixels::

    E(x) = sum_p A(p) exp(2 pi i W(p)) exp(-2 pi i p . x / (2 lambda N)),   |p| <= 1
    k(pixel) = integral over the pixel of sum_lambda s(lambda) |E(x)|^2

A ray through p lands at x = 2 lambda N grad W: a positive gradient outwards throws light outwards.

|E|^2 is band limited to 1 / (lambda N). It is sampled finely enough to carry that band, the pixel
is its exact spectrum sinc(fx) sinc(fy), and a matrix Fourier transform then evaluates the result
at the middles of the pixels, wherever the kernel is to be centred. Nothing is interpolated, so
nothing adds blur or ringing; summing an intensity oversampled k times instead would need k = 20
at f/1.4, where the speckle of the PSF is 20 times finer than a pixel.

Sources: J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, ch. 5 and 6;
R. Soummer et al., "Fast computation of Lyot-style coronagraph propagation", Optics Express 15,
2007, eq. 1 (the matrix Fourier transform).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.psf import as_kernel, centroid
from lensmodel.core.types import Kernel

REFERENCE_UM: Final = 0.54
"""Wavelength in micrometres in which wavefront errors are counted."""

_MIN_SAMPLES: Final = 96  # across the pupil, to draw its edge well
_MAX_SAMPLES: Final = 640  # across the transform: memory (chosen)
_WRAP_MARGIN: Final = 1.2  # period of the discrete transform over the extent of the light
_CENTRED_PX: Final = 5e-4  # pixels: far below what any test asks
_DETAILED_CUTOFF: Final = 3.5  # cycles/pixel

Wavefront = Callable[[NDArray[np.float32], NDArray[np.float32], float], NDArray[np.float32]]
"""`W(px, py, wavelength_um)` in reference waves on arrays that broadcast; px right, py up."""

Amplitude = Callable[[NDArray[np.float32], NDArray[np.float32], float], NDArray[np.float32]]
"""`A(px, py, step)`, transmission 0..1 of the pupil; `step` is the sample distance."""


def disc(
    px: NDArray[np.float32],
    py: NDArray[np.float32],
    step: float,
    *,
    radius: float = 1.0,
    center: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float32]:
    """Disc with an edge one sample wide.

    Its area does not jump with the sampling, and the diffraction wings of a hard edge, which would
    wrap around, fade beyond one period of the discrete transform.
    """
    dx, dy = px - np.float32(center[0]), py - np.float32(center[1])
    rho = np.sqrt(dx * dx + dy * dy)
    return np.clip((np.float32(radius) - rho) / np.float32(step) + np.float32(0.5), 0.0, 1.0)


def coordinates(samples: int, step: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Pupil coordinates px `(1, samples)` to the right and py `(samples, 1)` upwards."""
    p = ((np.arange(samples) - (samples - 1) / 2.0) * step).astype(np.float32)
    return p[None, :], -p[:, None]


@dataclass(frozen=True, slots=True)
class PixelOtf:
    """Transfer function of lens and pixel together, for light of one colour channel.

    Parameters
    ----------
    values : ndarray, shape (q, q // 2 + 1), complex64
        On an `rfft2` grid; at zero frequency 1 less the light that diffraction throws beyond the
        period.
    period : float
        Period in pixels of the image that it describes: frequencies are multiples of 1 / period.
    """

    values: NDArray[np.complex64]
    period: float

    def kernel(self, size: int, shift: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
        """Share of the light in `(size, size)` pixels, the image moved by `shift` (row, col) pixels."""
        rows, half = self.values.shape
        x = np.arange(size) - size // 2
        row_f = fft.fftfreq(rows, 1.0 / rows) / self.period
        col_f = np.arange(half) / self.period
        along_rows = np.exp(2j * np.pi * np.outer(x - shift[0], row_f)).astype(np.complex64)
        along_cols = np.exp(2j * np.pi * np.outer(col_f, x - shift[1])).astype(np.complex64)
        along_cols[1:] *= 2.0  # the other half plane is the conjugate
        light = ((along_rows @ self.values) @ along_cols).real.astype(np.float64)
        return light / self.period**2

    def centred(self, size: int, guess: tuple[float, float], offset: tuple[float, float]) -> Kernel:
        """Kernel whose centre of mass lies at `offset` (row, col) pixels from the middle one.

        `guess` is where it would lie without a shift. The centre of mass is that of the finite
        array, as everywhere in this library; light beyond the array does not count.
        """
        shift = (offset[0] - guess[0], offset[1] - guess[1])
        light = np.empty(0)
        for _ in range(8):
            light = np.maximum(self.kernel(size, shift), 0.0)
            row, col = centroid(light)
            error = (row - offset[0], col - offset[1])
            if math.hypot(*error) < _CENTRED_PX:
                break
            shift = (shift[0] - error[0], shift[1] - error[1])
        return as_kernel(light)


def pixel_otf(
    wavefront: Wavefront,
    amplitude: Amplitude,
    spectrum: Sequence[tuple[float, float]],
    *,
    size: int,
    pitch_um: float,
    f_number: float,
    spread_um: float = 0.0,
) -> PixelOtf:
    """Transfer function of a pupil seen through square pixels, summed over wavelengths.

    Parameters
    ----------
    wavefront, amplitude : callable
        Pupil function.
    spectrum : sequence of (wavelength_um, weight)
        Light of the colour channel; weights sum to 1.
    size : int
        Side in pixels of the largest kernel that will be asked for.
    pitch_um : float
        Pixel pitch in micrometres.
    f_number : float
        Working f-number N.
    spread_um : float
        Largest ray error in micrometres: light farther out must not wrap into the kernel.

    Returns
    -------
    PixelOtf

    Notes
    -----
    At fast apertures, where the band reaches beyond `_DETAILED_CUTOFF` cycles/pixel, its outermost
    quarter is left to alias into frequencies that the pixel passes at less than 12 percent.
    """
    shortest = min(wave for wave, _ in spectrum)
    extent = max(size * pitch_um, size * pitch_um / 2.0 + spread_um) * _WRAP_MARGIN
    unit = shortest * f_number  # micrometres of period a pupil sample
    period_um = min(max(extent, _MIN_SAMPLES * unit), max(_MAX_SAMPLES * unit, size * pitch_um))
    cutoff = pitch_um / unit
    factor = 2.0 if cutoff < _DETAILED_CUTOFF else 1.5
    grid = int(fft.next_fast_len(math.ceil(factor * (period_um / unit + 2.0)), real=True))
    image = np.zeros((grid, grid), dtype=np.float32)
    for wave, weight in spectrum:
        step = 2.0 * wave * f_number / period_um
        samples = math.ceil(2.0 / step) + 1
        px, py = coordinates(samples, step)
        angle = np.float32(2.0 * np.pi * REFERENCE_UM / wave) * wavefront(px, py, wave)
        transmitted = amplitude(px, py, step)
        pupil = np.empty(angle.shape, dtype=np.complex64)
        np.multiply(transmitted, np.cos(angle), out=pupil.real)
        np.multiply(transmitted, np.sin(angle), out=pupil.imag)
        # the rows beyond the pupil are empty: transform the others first
        field = fft.fft(fft.fft(pupil, n=grid, axis=1), n=grid, axis=0, overwrite_x=True)
        # Parseval: sum |E|^2 = grid^2 sum A^2; and sum A, not sum A^2, is the area of the pupil
        total = float(transmitted.sum(dtype=np.float64)) * grid**2
        image += np.float32(weight / total) * (np.square(field.real) + np.square(field.imag))
    otf = fft.rfft2(image, overwrite_x=True)
    if grid % 2 == 0:  # the highest frequency has no mirror image: shifted, it would break symmetry
        otf[grid // 2, :] = 0.0
        otf[:, grid // 2] = 0.0
    period = period_um / pitch_um
    row_f, col_f = fft.fftfreq(grid, 1.0 / grid) / period, np.arange(grid // 2 + 1) / period
    otf *= np.sinc(row_f).astype(np.float32)[:, None]
    otf *= np.sinc(col_f).astype(np.float32)[None, :]
    return PixelOtf(otf, period)
