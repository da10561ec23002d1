"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.model.answer import ModelSettings, PsfAnswer
from lensmodel.model.field.robust import Flag
from lensmodel.model.field.smoothers import Neighbours, Smoother, smoothers
from lensmodel.model.lens_model import LensModel, ModelField
from lensmodel.model.profile import Camera, LensProfile, load_profile, save_profile

__all__ = [
    "Camera",
    "Flag",
    "LensModel",
    "LensProfile",
    "ModelField",
    "ModelSettings",
    "Neighbours",
    "PsfAnswer",
    "Smoother",
    "load_profile",
    "save_profile",
    "smoothers",
]
