"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.model.lens_model import LensModel, ModelField
from lensmodel.model.query import PsfAnswer

__all__ = ["LensModel", "ModelField", "PsfAnswer"]
