"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.model.answer import ModelSettings, PsfAnswer
from lensmodel.model.answering import ModelField
from lensmodel.model.field.robust import Flag
from lensmodel.model.field.smoothers import Neighbours, Smoother, smoothers
from lensmodel.model.lens_model import LensModel
from lensmodel.model.prior import Prior
from lensmodel.model.profile import Camera, LensProfile, load_profile, save_profile
from lensmodel.model.trust.witness import Witness, WitnessedField
from lensmodel.model.wavefront.from_kernels import fit_wavefront
from lensmodel.optics.wavefront import Wavefront

__all__ = [
    "Camera",
    "Flag",
    "LensModel",
    "LensProfile",
    "ModelField",
    "ModelSettings",
    "Neighbours",
    "Prior",
    "PsfAnswer",
    "Smoother",
    "Wavefront",
    "Witness",
    "WitnessedField",
    "fit_wavefront",
    "load_profile",
    "save_profile",
    "smoothers",
]
