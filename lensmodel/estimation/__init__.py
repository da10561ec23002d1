"""Blind estimation: one PSF from the patches of one field position, or from all patches of a photo."""

from lensmodel.core.registry import Registry
from lensmodel.estimation.estimator import NO_BLUR_PX2, PhotoEstimator, PsfEstimate, PsfEstimator
from lensmodel.estimation.methods.learned import LearnedEstimator
from lensmodel.estimation.methods.patch_recurrence import PatchRecurrence

estimators: Registry[PsfEstimator] = Registry(
    "estimator",
    {"default": LearnedEstimator, "michaeli-irani": PatchRecurrence},
    "lensmodel.estimators",
)

__all__ = [
    "NO_BLUR_PX2",
    "LearnedEstimator",
    "PatchRecurrence",
    "PhotoEstimator",
    "PsfEstimate",
    "PsfEstimator",
    "estimators",
]
