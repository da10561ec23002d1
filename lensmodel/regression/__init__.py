"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.regression.model import LensModel, ModelSettings, PsfAnswer

__all__ = ["LensModel", "ModelSettings", "PsfAnswer"]
