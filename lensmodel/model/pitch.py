"""Kernels of one lens seen by bodies with pixels of different size.

Light falls on the sensor in micrometres; a pixel of pitch p samples it after integrating over p. From
pitch p to q the spectrum is that of the kernel times the ratio of the two pixels::

    K_q(f) = K_p(f) sinc(q f) / sinc(p f),     f in cycles / micrometre, on both axes

and is read at the new pixels by its own Fourier series. Beyond its Nyquist frequency nothing is known.

The unit of p may also be the half-diagonal of the frame: for pictures of one sensor in several sizes, and for
bodies of one format whose pixel pitch no file names.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, as_kernel
from lensmodel.core.types import Kernel
from lensmodel.model.answer import HALF_DIAGONAL

_SAME = 0.005  # of the pitch: what rounding in metadata changes
_PADDED = 2  # times the kernel, so that its images do not overlap
_WIDEST = 8192  # pixels of the samples along a side: memory (chosen)


def pixel_of(sample: PsfSample, unit: str) -> float | None:
    """Size of a pixel in a unit of `answer.UNITS`; None if the sample does not say."""
    if unit == HALF_DIAGONAL:
        return None if sample.half_diagonal_px is None else 1.0 / sample.half_diagonal_px
    return sample.pixel_pitch_um


def usual_pixel(samples: Sequence[PsfSample], unit: str) -> float | None:
    """Pixel that most samples have; None if no sample says."""
    known = [pixel for pixel in (pixel_of(s, unit) for s in samples) if pixel is not None]
    if not known:
        return None
    values, counts = np.unique(known, return_counts=True)
    return float(values[counts.argmax()])


def alike(a: float | None, b: float | None) -> bool:
    """Whether two pixels are one; an unknown one is the same as any other."""
    return a is None or b is None or abs(a / b - 1.0) <= _SAME


def at_pixel(samples: Sequence[PsfSample], pixel: float | None, unit: str) -> tuple[PsfSample, ...]:
    """Samples as a body of other pixels would have seen them; those of such pixels stay themselves."""
    return tuple(_seen_with(s, pixel, pixel_of(s, unit)) for s in samples)


def _seen_with(sample: PsfSample, pixel: float | None, own: float | None) -> PsfSample:
    if own is None or pixel is None or alike(own, pixel):
        return sample
    ratio = pixel / own
    pitch, half = sample.pixel_pitch_um, sample.half_diagonal_px
    return replace(
        sample,
        kernel=rescaled(sample.kernel, own, pixel, _side(sample, ratio)),
        spectrum=None,  # its frequencies are those of the other pixels
        pixel_pitch_um=None if pitch is None else pitch * ratio,
        half_diagonal_px=None if half is None else half / ratio,
    )


def side_at(sample: PsfSample, pixel: float | None, unit: str) -> int:
    """Odd side that a kernel needs with other pixels, at most twice its own."""
    own = pixel_of(sample, unit)
    if own is None or pixel is None or alike(own, pixel):
        return sample.kernel.shape[0]
    return _side(sample, pixel / own)


def _side(sample: PsfSample, ratio: float) -> int:
    side = sample.kernel.shape[0]
    return min(2 * math.ceil(side / 2 / ratio) + 1, 2 * side + 1)


def rescaled(kernel: Kernel, own: float, wanted: float, size: int) -> Kernel:
    """Kernel of a pixel pitch as one of another.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
    own, wanted : float
        Pixel that it was seen with, and the one that is asked for, in one unit.
    size : int
        Odd side of the result.

    Raises
    ------
    InvalidInputError
        If the result would cover more than 8192 pixels of the kernel's own.
    """
    ratio = wanted / own
    side = kernel.shape[0]
    reach = max(size * ratio, side)
    if reach > _WIDEST:
        raise InvalidInputError(
            f"a kernel of {size} pixels, each {ratio:.3g} times one of the samples, is wider than "
            f"{_WIDEST} of theirs; ask for smaller pixels or fewer"
        )
    period = _PADDED * (2 * math.ceil(reach / 2) + 1)
    frequency = np.fft.fftfreq(period)
    pixel = np.sinc(ratio * frequency) / np.sinc(frequency)
    into = _wave(frequency, side, -1.0) / period
    out = _wave(frequency, size, ratio)
    along = (out.T * pixel) @ into  # what is done on one axis; the spectrum itself may be huge
    resampled = (along @ kernel @ along.T).real
    return as_kernel(np.maximum(resampled, 0.0))


def _wave(frequency: NDArray[np.floating], size: int, step: float) -> NDArray[np.complex128]:
    t = np.arange(size) - size // 2
    return np.asarray(np.exp(2j * np.pi * step * np.outer(frequency, t)))
