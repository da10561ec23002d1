"""Samples of one lens seen by bodies whose frames or pixels differ in size.

A frame in crop mode, or of a smaller sensor, shows the middle of what the lens draws: the largest frame that
a lens was seen on is the measure of all its samples. A pixel of pitch p integrates the light over p; from
pitch p to q the spectrum is that of the kernel times the ratio of the two pixels::

    K_q(f) = K_p(f) sinc(q f) / sinc(p f),     f in cycles / micrometre, on both axes

and is read at the new pixels by its own Fourier series. Beyond its Nyquist frequency nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfSample, as_kernel, resized
from lensmodel.core.types import FieldPosition, Kernel

SAME = 0.005  # of the pitch: what rounding in metadata changes
_PADDED = 2  # times the kernel, so that its images do not overlap
_WIDEST = 8192  # pixels of the samples along a side: memory (chosen)
ALIKE: Final = 0.03  # relative difference up to which two diagonals are one (chosen): pitches are rounded


def half_diagonal_mm(sample: PsfSample) -> float | None:
    """Half diagonal that the place of a sample is counted in; None where pitch or frame is unknown."""
    pitch, pixels = sample.pixel_pitch_um, sample.half_diagonal_px
    return None if pitch is None or pixels is None else pixels * pitch / 1000.0


def circle_mm(samples: Sequence[PsfSample]) -> float | None:
    """Largest half diagonal of the frames that a lens was seen on, in mm; None where none is known."""
    return max((mm for sample in samples if (mm := half_diagonal_mm(sample)) is not None), default=None)


def on_one_circle(samples: Sequence[PsfSample]) -> tuple[PsfSample, ...]:
    """Count the places of all samples in the largest of their half diagonals; unknown ones stay."""
    circle = circle_mm(samples)

    def on_it(sample: PsfSample) -> PsfSample:
        own, pixels = half_diagonal_mm(sample), sample.half_diagonal_px
        if circle is None or own is None or pixels is None or own > (1.0 - ALIKE) * circle:
            return sample
        place = FieldPosition(sample.position.r * own / circle, sample.position.phi)
        return replace(sample, position=place, half_diagonal_px=pixels * circle / own)

    return tuple(on_it(sample) for sample in samples)


def usual_pitch(samples: Sequence[PsfSample]) -> float | None:
    """Pixel pitch in micrometres that most samples have; None if no sample says."""
    known = [s.pixel_pitch_um for s in samples if s.pixel_pitch_um is not None]
    if not known:
        return None
    values, counts = np.unique(known, return_counts=True)
    return float(values[counts.argmax()])


def at_pitch(samples: Sequence[PsfSample], pitch_um: float | None) -> list[PsfSample]:
    """Samples with the kernels that a body of another pitch would have seen."""

    def seen(sample: PsfSample) -> PsfSample:
        own, side = sample.pixel_pitch_um, sample.kernel.shape[0]
        if own is None or pitch_um is None or alike(own, pitch_um):
            return sample
        wanted = min(2 * math.ceil(side / 2 * own / pitch_um) + 1, 2 * side + 1)
        return replace(sample, kernel=rescaled(sample.kernel, own, pitch_um, wanted))

    return [seen(sample) for sample in samples]


def alike(a: float, b: float) -> bool:
    """Whether two pixels are one."""
    return abs(a / b - 1.0) <= SAME


def rescaled(kernel: Kernel, own: float | None, wanted: float | None, size: int) -> Kernel:
    """Kernel of a pixel pitch as one of another and of side `size`; an unknown pitch is that of any other."""
    if own is None or wanted is None or alike(own, wanted):
        return resized(kernel, size)
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

    def waves(count: int, step: float) -> NDArray[np.complex128]:
        t = np.arange(count) - count // 2
        return np.asarray(np.exp(2j * np.pi * step * np.outer(frequency, t)))

    # what is done on one axis; the spectrum itself may be huge
    along = (waves(size, ratio).T * pixel) @ (waves(side, -1.0) / period)
    resampled = (along @ kernel @ along.T).real
    return as_kernel(np.maximum(resampled, 0.0))
