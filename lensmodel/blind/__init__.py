"""Blind estimation: one PSF from the patches of one field position."""

from lensmodel.blind.base import NO_BLUR_PX2, PsfEstimate, PsfEstimator
from lensmodel.blind.default import Cautious
from lensmodel.blind.edges import Edges
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.blind.sun import Sun
from lensmodel.blind.whittle import Whittle
from lensmodel.blind.zhang import Zhang
from lensmodel.registry import Registry

estimators: Registry[PsfEstimator] = Registry(
    "estimator",
    {
        "default": Cautious,
        "edges": Edges,
        "michaeli-irani": PatchRecurrence,
        "sun": Sun,
        "whittle": Whittle,
        "zhang": Zhang,
    },
)

__all__ = [
    "NO_BLUR_PX2",
    "Cautious",
    "Edges",
    "PatchRecurrence",
    "PsfEstimate",
    "PsfEstimator",
    "Sun",
    "Whittle",
    "Zhang",
    "estimators",
]
