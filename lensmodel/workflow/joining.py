"""Measured samples in a model: beside the blind ones, or in their place."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from lensmodel.core.psf import PsfSample
from lensmodel.estimation.measure.measurer import is_measured
from lensmodel.model import LensModel, ModelSettings

SAME_STOPS: Final = 1.0 / 3.0
"""Apertures nearer than this are one setting: cameras set thirds of a stop."""

_SAME_FOCAL: Final = 0.02  # of the focal length: what rounding in metadata changes


def joined(
    model: LensModel | None,
    samples: Sequence[PsfSample],
    *,
    replace: bool = False,
    model_settings: ModelSettings | None = None,
) -> LensModel:
    """Add measured samples to a model, or begin one with them.

    Parameters
    ----------
    model : LensModel or None
        What is known already.
    samples : sequence of PsfSample
        Of one measurement.
    replace : bool
        Take out the blind samples at the settings that were measured now: what is measured knows better.
    model_settings : ModelSettings, optional
        Choices of a new model.
    """
    if model is None:
        return LensModel.fit(samples, model_settings or ModelSettings())
    if not replace:
        return model.added(samples)
    kept = [old for old in model.samples if is_measured(old) or not any(_alike(old, new) for new in samples)]
    return LensModel.fit([*kept, *samples], model.settings)


def _alike(old: PsfSample, new: PsfSample) -> bool:
    """Whether two samples are of one setting of the lens."""
    a, b = old.settings.stops, new.settings.stops
    if a is not None and b is not None and abs(a - b) >= SAME_STOPS:
        return False
    f, g = old.settings.focal_mm, new.settings.focal_mm
    return f is None or g is None or abs(f - g) < _SAME_FOCAL * g
