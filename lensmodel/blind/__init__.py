"""Blind estimation: one PSF from the patches of one field position."""

from lensmodel.blind.base import PsfEstimate, PsfEstimator
from lensmodel.blind.whittle import Whittle
from lensmodel.registry import Registry

estimators: Registry[PsfEstimator] = Registry("estimator", {"whittle": Whittle, "default": Whittle})

__all__ = ["PsfEstimate", "PsfEstimator", "Whittle", "estimators"]
