"""Step 3, non-blind deconvolution: plan, solve, limit and audit, from one cell to a whole photo."""

from __future__ import annotations

from lensmodel.correction.blur import crop_to_support
from lensmodel.correction.deconvolver import Deconvolver, Sensor, restore_planes
from lensmodel.correction.lattice import Roi
from lensmodel.correction.limit import Bounds
from lensmodel.correction.methods.richardson_lucy import RichardsonLucy, SaturationAwareRichardsonLucy
from lensmodel.correction.methods.sparse_gradient import SparseGradient
from lensmodel.correction.posterior import PsfPosterior
from lensmodel.correction.stored_colour import StoredColour
from lensmodel.correction.whole_photo import KERNEL_SIZE, Corrected, correct_planes, deconvolvers

__all__ = [
    "KERNEL_SIZE",
    "Bounds",
    "Corrected",
    "Deconvolver",
    "PsfPosterior",
    "RichardsonLucy",
    "Roi",
    "SaturationAwareRichardsonLucy",
    "Sensor",
    "SparseGradient",
    "StoredColour",
    "correct_planes",
    "crop_to_support",
    "deconvolvers",
    "restore_planes",
]
