"""Step 3, non-blind deconvolution: plan, solve, limit and audit, from one cell to a whole photo."""

from __future__ import annotations

from lensmodel.core.psf import crop_to_support
from lensmodel.correction.deconvolver import Deconvolver, Sensor, restore_planes
from lensmodel.correction.limit import Bounds, StoredColour
from lensmodel.correction.posterior import PsfPosterior
from lensmodel.correction.richardson_lucy import SaturationAwareRichardsonLucy
from lensmodel.correction.sparse_gradient import SparseGradient
from lensmodel.correction.whole_photo import KERNEL_SIZE, Corrected, correct_planes, deconvolvers, window_of

__all__ = [
    "KERNEL_SIZE",
    "Bounds",
    "Corrected",
    "Deconvolver",
    "PsfPosterior",
    "SaturationAwareRichardsonLucy",
    "Sensor",
    "SparseGradient",
    "StoredColour",
    "correct_planes",
    "crop_to_support",
    "deconvolvers",
    "restore_planes",
    "window_of",
]
