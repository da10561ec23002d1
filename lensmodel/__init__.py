"""Learns the blur of one copy of a lens from ordinary photos, and removes it.

    import lensmodel

    lens = lensmodel.calibrate(["a.dng", "b.dng"])
    kernel = lens.psf(r=0.9, phi=0.6).kernel
    photo = lensmodel.correct("c.dng", lens, "c.tif")
    lens.save("my-24mm.lensprofile")

The public names are those of `__all__`; each is imported when it is first used, so that importing the
package costs nothing. docs/library.md shows them at work.

`patches` chooses patches of photos, `blind.sampling` and `measured` make samples of a PSF of them, `model`
makes these a function of place and settings, by default with the network of `neural`, and `correction`
applies it; `api` and `calibration` join them in a `lens`. Photos come in and go out through `photo`;
`quality` judges, `report` describes, `simulate` makes photos whose truth is known, `core` has what all share,
and `cli` is the command.
CONTRIBUTING.md says where a method is added.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

if TYPE_CHECKING:
    from lensmodel.api import calibrate, correct
    from lensmodel.blind import PsfEstimate, PsfEstimator, estimators
    from lensmodel.blind.sampling import CalibrationEvent
    from lensmodel.core.errors import CancelledError, LensModelError
    from lensmodel.core.psf import PsfSample
    from lensmodel.core.types import FieldPosition, LensSettings, NoiseModel, field_grid
    from lensmodel.correction import Bounds, Corrected, Deconvolver, Sensor, deconvolvers
    from lensmodel.lens import Lens
    from lensmodel.model import PsfAnswer
    from lensmodel.patches import Selector, selectors
    from lensmodel.photo import LinearPhoto, develop
    from lensmodel.photo.development import photo_from_array

__all__ = [
    "Bounds",
    "CalibrationEvent",
    "CancelledError",
    "Corrected",
    "Deconvolver",
    "FieldPosition",
    "Lens",
    "LensModelError",
    "LensSettings",
    "LinearPhoto",
    "NoiseModel",
    "PsfAnswer",
    "PsfEstimate",
    "PsfEstimator",
    "PsfSample",
    "Selector",
    "Sensor",
    "calibrate",
    "correct",
    "deconvolvers",
    "develop",
    "estimators",
    "field_grid",
    "photo_from_array",
    "selectors",
]

_HOMES: Final = {
    "lensmodel.api": ("calibrate", "correct"),
    "lensmodel.photo.development": ("photo_from_array",),
    "lensmodel.blind": ("PsfEstimate", "PsfEstimator", "estimators"),
    "lensmodel.patches": ("Selector", "selectors"),
    "lensmodel.correction": ("Bounds", "Corrected", "Deconvolver", "Sensor", "deconvolvers"),
    "lensmodel.core.errors": ("CancelledError", "LensModelError"),
    "lensmodel.lens": ("Lens",),
    "lensmodel.photo": ("LinearPhoto", "develop"),
    "lensmodel.blind.sampling": ("CalibrationEvent",),
    "lensmodel.core.psf": ("PsfSample",),
    "lensmodel.model": ("PsfAnswer",),
    "lensmodel.core.types": ("FieldPosition", "LensSettings", "NoiseModel", "field_grid"),
}
"""Where each public name is defined."""

_HOME_OF: Final = {name: home for home, names in _HOMES.items() for name in names}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - whatever the name stands for
    """Import a public name when it is first asked for."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
