"""The PSF as one continuous function of place and settings, learned from local samples."""

from lensmodel.regression.answer import ModelSettings, PsfAnswer
from lensmodel.regression.doubt import Doubt
from lensmodel.regression.exact import PaperModel, all_pairs, factorised
from lensmodel.regression.model import LensModel, ModelField, Prior
from lensmodel.regression.profile import Camera, LensProfile, load_profile, save_profile
from lensmodel.regression.robust import Flag
from lensmodel.regression.smoothers import Neighbours, Smoother, smoothers
from lensmodel.regression.wavefront import Wavefront
from lensmodel.regression.wavefront_fit import fit_wavefront
from lensmodel.regression.witness import Witness, WitnessedField

__all__ = [
    "Camera",
    "Doubt",
    "Flag",
    "LensModel",
    "LensProfile",
    "ModelField",
    "ModelSettings",
    "Neighbours",
    "PaperModel",
    "Prior",
    "PsfAnswer",
    "Smoother",
    "Wavefront",
    "Witness",
    "WitnessedField",
    "all_pairs",
    "factorised",
    "fit_wavefront",
    "load_profile",
    "save_profile",
    "smoothers",
]
