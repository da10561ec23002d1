"""Blind estimation: one PSF from the patches of one field position."""

from lensmodel.blind.base import NO_BLUR_PX2, PsfEstimate, PsfEstimator
from lensmodel.blind.default import Guarded
from lensmodel.blind.edges import Edges
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.blind.whittle import Whittle
from lensmodel.blind.zhang import Zhang
from lensmodel.registry import Registry

estimators: Registry[PsfEstimator] = Registry(
    "estimator",
    {
        "default": Guarded,
        "edges": Edges,
        "michaeli-irani": PatchRecurrence,
        "whittle": Whittle,
        "zhang": Zhang,
    },
)

__all__ = [
    "NO_BLUR_PX2",
    "Edges",
    "Guarded",
    "PatchRecurrence",
    "PsfEstimate",
    "PsfEstimator",
    "Whittle",
    "Zhang",
    "estimators",
]
