"""Blind estimation: one PSF from patches of a field position, or from all of a photo; see `sampling`."""

from lensmodel.blind.estimator import PhotoEstimator, PsfEstimate, PsfEstimator
from lensmodel.blind.learned import LearnedEstimator
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.core.registry import Registry

estimators: Registry[PsfEstimator] = Registry(
    "estimator", {"default": LearnedEstimator, "michaeli-irani": PatchRecurrence}
)

__all__ = ["PatchRecurrence", "PhotoEstimator", "PsfEstimate", "PsfEstimator", "estimators"]
