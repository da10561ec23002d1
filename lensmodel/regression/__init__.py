"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.regression.model import LensModel, ModelSettings, PsfAnswer
from lensmodel.regression.profile import LensProfile, load_profile, save_profile

__all__ = ["LensModel", "LensProfile", "ModelSettings", "PsfAnswer", "load_profile", "save_profile"]
