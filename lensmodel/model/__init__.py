"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.model.lens_model import LensModel, ModelField
from lensmodel.model.profile import Camera, LensProfile, load_profile, save_profile
from lensmodel.model.query import PsfAnswer

__all__ = ["Camera", "LensModel", "LensProfile", "ModelField", "PsfAnswer", "load_profile", "save_profile"]
