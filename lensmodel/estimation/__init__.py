"""Blind estimation: one PSF from the patches of one field position."""

from lensmodel.core.registry import Registry
from lensmodel.estimation.estimator import NO_BLUR_PX2, PsfEstimate, PsfEstimator
from lensmodel.estimation.methods.cho_lee import ChoLee
from lensmodel.estimation.methods.default import Cautious
from lensmodel.estimation.methods.edges import Edges
from lensmodel.estimation.methods.l0 import L0
from lensmodel.estimation.methods.patch_recurrence import PatchRecurrence
from lensmodel.estimation.methods.polyblur import Polyblur
from lensmodel.estimation.methods.sun import Sun
from lensmodel.estimation.methods.whittle import Whittle
from lensmodel.estimation.methods.xu_jia import XuJia
from lensmodel.estimation.methods.zhang import Zhang

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
    "lensmodel.estimators",
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
