"""Non-blind deconvolution, from one tile to a whole photo."""

from __future__ import annotations

from lensmodel.deconv.base import (
    ColourDeconvolver,
    Deconvolver,
    Restored,
    Sensor,
    WarpableMethod,
    restore_planes,
)
from lensmodel.deconv.correct import Corrected, PsfError, correct_planes
from lensmodel.deconv.direct import DirectFilter
from lensmodel.deconv.epll import Epll
from lensmodel.deconv.krishnan_fergus import KrishnanFergus
from lensmodel.deconv.lattice import Roi
from lensmodel.deconv.limits import Bounds
from lensmodel.deconv.methods import deconvolvers
from lensmodel.deconv.report import ZoneReport
from lensmodel.deconv.richardson_lucy import RichardsonLucy, SaturationAwareRichardsonLucy
from lensmodel.deconv.sparse_gradient import SparseGradient
from lensmodel.deconv.wiener import Wiener

__all__ = [
    "Bounds",
    "ColourDeconvolver",
    "Corrected",
    "Deconvolver",
    "DirectFilter",
    "Epll",
    "KrishnanFergus",
    "PsfError",
    "Restored",
    "RichardsonLucy",
    "Roi",
    "SaturationAwareRichardsonLucy",
    "Sensor",
    "SparseGradient",
    "WarpableMethod",
    "Wiener",
    "ZoneReport",
    "correct_planes",
    "deconvolvers",
    "restore_planes",
]
