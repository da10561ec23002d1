"""Samples of one lens on frames of different size: places are counted in one half diagonal, in millimetres.

A frame in crop mode, or of a body with a smaller sensor, shows the middle of what the lens draws: its corner
is no corner of the lens. The largest frame that a lens was seen on is the measure of all its samples.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition

ALIKE: Final = 0.03
"""Relative difference of diagonals up to which two frames are one (chosen): pitches are rounded."""


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
    return tuple(sample if circle is None else _on(sample, circle) for sample in samples)


def _on(sample: PsfSample, circle: float) -> PsfSample:
    own, pixels = half_diagonal_mm(sample), sample.half_diagonal_px
    if own is None or pixels is None or own > (1.0 - ALIKE) * circle:
        return sample
    place = FieldPosition(sample.position.r * own / circle, sample.position.phi)
    return replace(sample, position=place, half_diagonal_px=pixels * circle / own)
