"""Blind estimation: one PSF from the patches of one field position."""

from lensmodel.core.registry import Registry
from lensmodel.estimation.estimator import NO_BLUR_PX2, PsfEstimate, PsfEstimator
from lensmodel.estimation.methods.default import Cautious
from lensmodel.estimation.methods.patch_recurrence import PatchRecurrence
from lensmodel.estimation.methods.polyblur import Polyblur
from lensmodel.estimation.methods.whittle import Whittle

estimators: Registry[PsfEstimator] = Registry(
    "estimator",
    {
        "default": Cautious,
        "michaeli-irani": PatchRecurrence,
        "polyblur": Polyblur,
        "whittle": Whittle,
    },
    "lensmodel.estimators",
)

__all__ = [
    "NO_BLUR_PX2",
    "Cautious",
    "PatchRecurrence",
    "Polyblur",
    "PsfEstimate",
    "PsfEstimator",
    "Whittle",
    "estimators",
]
