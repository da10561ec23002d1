"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.model.lens_model import LensModel as LensModel
from lensmodel.model.lens_model import ModelField as ModelField
from lensmodel.model.query import PsfAnswer as PsfAnswer
