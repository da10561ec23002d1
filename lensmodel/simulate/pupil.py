"""From a wavefront to a PSF on pixels: Fourier optics with exact sampling.

The field behind the exit pupil is transformed by two matrix products, so that its samples lie
exactly where the pixels need them, whatever the f-number and the pitch::

    E(x) = sum_p A(p) exp(2 pi i W(p)) exp(-2 pi i p . x / (2 lambda N)),   |p| <= 1
    k(pixel) = integral over the pixel of sum_lambda s(lambda) |E(x)|^2

A ray through p lands at x = 2 lambda N grad W: a positive gradient outwards throws light outwards.
The integral over a pixel is a Gauss-Legendre quadrature, and the kernel is centred by a linear
phase in the pupil. Neither interpolates, so neither adds blur nor ringing.

Sources: J. W. Goodman, "Introduction to Fourier Optics", 3rd ed., 2005, ch. 5 and 6;
R. Soummer et al., "Fast computation of Lyot-style coronagraph propagation", Optics Express 15,
2007, eq. 1 (the matrix Fourier transform).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lensmodel.psf import as_kernel, centroid
from lensmodel.types import Kernel

REFERENCE_UM = 0.54
"""Wavelength in micrometres in which wavefront errors are counted."""

_MIN_SAMPLES = 96  # the soft edge of the pupil is then worth less than a thousandth of its area
_MAX_SAMPLES = 512
_WRAP_MARGIN = 1.25  # period of the discrete transform over the extent of the light
_CENTRED_PX = 2e-3

Wavefront = Callable[[NDArray[np.float32], NDArray[np.float32], float], NDArray[np.float32]]
"""`W(px, py, wavelength_um)` in reference waves on arrays that broadcast; px right, py up."""

Amplitude = Callable[[NDArray[np.float32], NDArray[np.float32], float], NDArray[np.float32]]
"""`A(px, py, step)`, transmission 0..1 of the pupil; `step` is the sample distance."""


@dataclass(frozen=True, slots=True)
class Sampling:
    """How one kernel is sampled.

    Parameters
    ----------
    size : int
        Odd side of the kernel in pixels.
    pitch_um : float
        Pixel pitch in micrometres.
    f_number : float
        Working f-number N.
    """

    size: int
    pitch_um: float
    f_number: float

    def nodes(self, wavelength_um: float) -> int:
        """Quadrature nodes a pixel: enough for all that diffraction lets through."""
        cutoff = self.pitch_um / (wavelength_um * self.f_number)  # cycles/pixel
        return min(max(math.ceil(cutoff) + 2, 3), 7)

    def pupil_samples(self, wavelength_um: float, spread_um: float) -> int:
        """Samples across the pupil so that light outside the kernel does not wrap into it."""
        window = self.size * self.pitch_um
        extent = max(window, window / 2.0 + spread_um)
        needed = _WRAP_MARGIN * extent / (wavelength_um * self.f_number)
        # multiples of 32, so that the cached transform matrices are few
        return min(max(32 * math.ceil(needed / 32.0), _MIN_SAMPLES), _MAX_SAMPLES)


@lru_cache(maxsize=64)
def _transform(size: int, nodes: int, samples: int, pixels_per_cycle: float) -> NDArray[np.complex64]:
    """Matrix `(size * nodes, samples)` of exp(-2 pi i p x / (2 lambda N)) sqrt(node weight)."""
    abscissa, weight = np.polynomial.legendre.leggauss(nodes)
    pixels = np.arange(size) - size // 2
    x = (pixels[:, None] + 0.5 * abscissa[None, :]).ravel()  # pixels
    p = _coordinates(samples).astype(np.float64)
    root = np.sqrt(np.tile(0.5 * weight, size))
    matrix = root[:, None] * np.exp(-2j * np.pi * np.outer(x / pixels_per_cycle, p))
    matrix = matrix.astype(np.complex64)
    matrix.setflags(write=False)
    return matrix


@lru_cache(maxsize=32)
def _coordinates(samples: int) -> NDArray[np.float32]:
    step = 2.0 / samples
    p = ((np.arange(samples) + 0.5) * step - 1.0).astype(np.float32)
    p.setflags(write=False)
    return p


def disc(
    px: NDArray[np.float32],
    py: NDArray[np.float32],
    step: float,
    *,
    radius: float = 1.0,
    center: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.float32]:
    """Disc with an edge one sample wide, so that its area does not jump with the sampling."""
    rho = np.hypot(px - np.float32(center[0]), py - np.float32(center[1]))
    return np.clip((radius - rho) / np.float32(step) + np.float32(0.5), 0.0, 1.0)


def intensity(
    wavefront: Wavefront,
    amplitude: Amplitude,
    sampling: Sampling,
    wavelength_um: float,
    *,
    shift: tuple[float, float] = (0.0, 0.0),
    spread_um: float = 0.0,
    nodes: int | None = None,
) -> NDArray[np.float64]:
    """Light in every pixel for one wavelength, as a share of the light through an open pupil.

    Parameters
    ----------
    wavefront, amplitude : callable
        Pupil function.
    sampling : Sampling
        Pixels and f-number.
    wavelength_um : float
        Wavelength in micrometres.
    shift : tuple of float
        `(row, col)` in pixels: the image is moved by so much, exactly.
    spread_um : float
        Largest ray error in micrometres; sets the sampling of the pupil.
    nodes : int, optional
        Quadrature nodes a pixel instead of the automatic number.

    Returns
    -------
    ndarray, shape (size, size), float64
    """
    samples = sampling.pupil_samples(wavelength_um, spread_um)
    nodes = nodes or sampling.nodes(wavelength_um)
    pixels_per_cycle = 2.0 * wavelength_um * sampling.f_number / sampling.pitch_um
    coordinates = _coordinates(samples)
    px, py = coordinates[None, :], -coordinates[:, None]  # row index grows downwards
    transmitted = amplitude(px, py, 2.0 / samples)
    phase = wavefront(px, py, wavelength_um) * np.float32(REFERENCE_UM / wavelength_um)
    # exp(-2 pi i p (x - s)): the shift theorem on the side of the pupil is exact
    phase = phase + px * np.float32(shift[1] / pixels_per_cycle)
    phase = phase - py * np.float32(shift[0] / pixels_per_cycle)
    angle = np.float32(2.0 * np.pi) * phase
    pupil = np.empty(angle.shape, dtype=np.complex64)
    pupil.real = transmitted * np.cos(angle)
    pupil.imag = transmitted * np.sin(angle)
    matrix = _transform(sampling.size, nodes, samples, pixels_per_cycle)
    field = matrix @ pupil @ matrix.T
    fine = np.square(field.real) + np.square(field.imag)
    blocks = fine.reshape(sampling.size, nodes, sampling.size, nodes)
    # Parseval: the light of an open pupil, integrated over the whole image plane
    total = math.pi * (samples / 2.0) ** 2 * pixels_per_cycle**2 * (samples / 2.0) ** 2
    return blocks.sum(axis=(1, 3), dtype=np.float64) / total


def kernel(
    wavefront: Wavefront,
    amplitude: Amplitude,
    sampling: Sampling,
    spectrum: Sequence[tuple[float, float]],
    *,
    spread_um: float = 0.0,
    guess: tuple[float, float] = (0.0, 0.0),
    offset: tuple[float, float] = (0.0, 0.0),
) -> Kernel:
    """Polychromatic kernel with its centre of mass on the middle pixel (plus `offset`).

    Parameters
    ----------
    wavefront, amplitude : callable
        Pupil function.
    sampling : Sampling
        Pixels and f-number.
    spectrum : sequence of (wavelength_um, weight)
        Light of the colour channel.
    spread_um : float
        Largest ray error in micrometres.
    guess : tuple of float
        Expected centre of mass `(row, col)` in pixels, from ray optics.
    offset : tuple of float
        Wanted centre of mass `(row, col)` in pixels, e.g. lateral colour.

    Returns
    -------
    Kernel, shape (size, size)

    Notes
    -----
    The centre of mass is that of the finite array, as everywhere in this library; it differs from
    the ray-optical one by the light that the array cuts off. One coarse pass finds the difference.
    """
    wavelengths = [wave for wave, _ in spectrum]
    middle = wavelengths[len(wavelengths) // 2]
    shift = (-guess[0], -guess[1])
    coarse = intensity(wavefront, amplitude, sampling, middle, shift=shift, spread_um=spread_um, nodes=2)
    row, col = centroid(coarse)
    shift = (shift[0] - row, shift[1] - col)
    for _ in range(3):
        fine = sum(
            weight
            * intensity(
                wavefront,
                amplitude,
                sampling,
                wave,
                shift=(shift[0] + offset[0], shift[1] + offset[1]),
                spread_um=spread_um,
            )
            for wave, weight in spectrum
        )
        row, col = centroid(np.asarray(fine))
        if max(abs(row - offset[0]), abs(col - offset[1])) < _CENTRED_PX:
            break
        shift = (shift[0] - (row - offset[0]), shift[1] - (col - offset[1]))
    return as_kernel(fine)
