"""The transfer function of a lens that only diffracts, in front of square pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import WAVELENGTH_NM, Channel


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

    Returns
    -------
    ndarray of float64
        Of the shape to which `rows` and `cols` broadcast; real, 1 at frequency 0.
    """
    v = np.hypot(rows, cols) * WAVELENGTH_NM[channel] / 1000.0 * f_number / pitch_um
    v = np.minimum(v, 1.0)
    round_pupil = 2.0 / np.pi * (np.arccos(v) - v * np.sqrt(1.0 - v * v))
    return np.asarray(round_pupil * np.sinc(rows) * np.sinc(cols), dtype=np.float64)
