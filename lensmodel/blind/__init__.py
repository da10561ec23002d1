"""Blind estimation: one PSF from the patches of one field position."""

from lensmodel.blind.base import NO_BLUR_PX2, PsfEstimate, PsfEstimator
from lensmodel.blind.cho_lee import ChoLee
from lensmodel.blind.default import Cautious
from lensmodel.blind.edges import Edges
from lensmodel.blind.l0 import L0
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.blind.polyblur import Polyblur
from lensmodel.blind.sun import Sun
from lensmodel.blind.whittle import Whittle
from lensmodel.blind.xu_jia import XuJia
from lensmodel.blind.zhang import Zhang
from lensmodel.registry import Registry

estimators: Registry[PsfEstimator] = Registry(
    "estimator",
    {
        "cho-lee": ChoLee,
        "default": Cautious,
        "edges": Edges,
        "l0": L0,
        "michaeli-irani": PatchRecurrence,
        "polyblur": Polyblur,
        "sun": Sun,
        "whittle": Whittle,
        "xu-jia": XuJia,
        "zhang": Zhang,
    },
)

__all__ = [
    "L0",
    "NO_BLUR_PX2",
    "Cautious",
    "ChoLee",
    "Edges",
    "PatchRecurrence",
    "Polyblur",
    "PsfEstimate",
    "PsfEstimator",
    "Sun",
    "Whittle",
    "XuJia",
    "Zhang",
    "estimators",
]
