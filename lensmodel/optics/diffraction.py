"""The kernel of a lens that only diffracts, in front of square pixels."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.psf import as_kernel
from lensmodel.core.types import WAVELENGTH_NM, Channel, Kernel

_GRID: Final = 128


def diffraction_otf(
    rows: NDArray[np.floating], cols: NDArray[np.floating], f_number: float, pitch_um: float, channel: Channel
) -> NDArray[np.float64]:
    """Transfer function of a round pupil and a pixel's box.

    With v = f lambda N / p, f in cycles/pixel::

        OTF = 2 / pi (arccos v - v sqrt(1 - v²)) sinc(f_row) sinc(f_col)

    Source: J. W. Goodman, "Introduction to Fourier Optics", eq. 6-32 of the third edition.

    Parameters
    ----------
    rows, cols : ndarray
        Frequencies in cycles/pixel, broadcasting together.
    f_number : float
        Aperture.
    pitch_um : float
        Pixel pitch in micrometres.
    channel : {"r", "g", "b"}
        Colour, for the wavelength.
    """
    v = np.hypot(rows, cols) * WAVELENGTH_NM[channel] / 1000.0 * f_number / pitch_um
    v = np.minimum(v, 1.0)
    round_pupil = 2.0 / np.pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v))
    return np.asarray(round_pupil * np.sinc(rows) * np.sinc(cols), dtype=np.float64)


def diffraction_kernel(size: int, f_number: float, pitch_um: float, channel: Channel) -> Kernel:
    """Kernel of `diffraction_otf`, as pixels sample it."""
    f = fft.fftfreq(_GRID)
    whole = fft.ifft2(diffraction_otf(f[:, None], f[None, :], f_number, pitch_um, channel)).real
    half = size // 2
    index = np.arange(-half, half + 1)
    return as_kernel(np.maximum(whole[np.ix_(index, index)], 0.0))
