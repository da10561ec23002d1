"""Kernels of one lens seen by bodies with pixels of different size.

Light falls on the sensor in micrometres; a pixel of pitch p samples it after integrating over p. From
pitch p to q the spectrum is that of the kernel times the ratio of the two pixels::

    K_q(f) = K_p(f) sinc(q f) / sinc(p f),     f in cycles / micrometre, on both axes

and is read at the new pixels by its own Fourier series. Beyond its Nyquist frequency nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.psf import PsfSample, as_kernel
from lensmodel.types import Kernel

_SAME = 0.005
_PADDED = 2


def usual_pitch(samples: Sequence[PsfSample]) -> float | None:
    """Pitch that most samples have, micrometres; None if no sample says."""
    known = [s.pixel_pitch_um for s in samples if s.pixel_pitch_um is not None]
    if not known:
        return None
    values, counts = np.unique(known, return_counts=True)
    return float(values[counts.argmax()])


def alike(a: float | None, b: float | None) -> bool:
    """Whether two pitches are one; an unknown one is the same as any other."""
    return a is None or b is None or abs(a / b - 1.0) <= _SAME


def at_pitch(samples: Sequence[PsfSample], pitch_um: float | None) -> tuple[PsfSample, ...]:
    """Samples as a body of another pitch would have seen them; those of that pitch stay themselves."""
    return tuple(
        s
        if s.pixel_pitch_um is None or pitch_um is None or alike(s.pixel_pitch_um, pitch_um)
        else replace(
            s,
            kernel=rescaled(s.kernel, s.pixel_pitch_um, pitch_um, side_at(s, pitch_um)),
            spectrum=None,  # its frequencies are those of the other pixels
            evidence=None,
        )
        for s in samples
    )


def side_at(sample: PsfSample, pitch_um: float | None) -> int:
    """Odd side that a kernel needs at another pitch, at most twice its own."""
    side = sample.kernel.shape[0]
    if sample.pixel_pitch_um is None or pitch_um is None or alike(sample.pixel_pitch_um, pitch_um):
        return side
    return min(2 * math.ceil(side / 2 * sample.pixel_pitch_um / pitch_um) + 1, 2 * side + 1)


def rescaled(kernel: Kernel, pitch_um: float, wanted_um: float, size: int) -> Kernel:
    """Kernel of a pixel pitch as one of another.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
    pitch_um, wanted_um : float
        Pitch that it was seen with, and the one that is asked for, micrometres.
    size : int
        Odd side of the result.
    """
    ratio = wanted_um / pitch_um
    side = kernel.shape[0]
    reach = max(size * ratio, side)
    period = _PADDED * (2 * math.ceil(reach / 2) + 1)
    frequency = np.fft.fftfreq(period)
    pixel = np.sinc(ratio * frequency) / np.sinc(frequency)
    into = _wave(frequency, side, -1.0) / period
    out = _wave(frequency, size, ratio)
    spectrum = into @ kernel @ into.T * np.outer(pixel, pixel)
    found = (out.T @ spectrum @ out).real
    return as_kernel(np.maximum(found, 0.0))


def _wave(frequency: NDArray[np.floating], size: int, step: float) -> NDArray[np.complex128]:
    t = np.arange(size) - size // 2
    return np.asarray(np.exp(2j * np.pi * step * np.outer(frequency, t)))
