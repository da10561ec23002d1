"""Step 3, non-blind deconvolution: plan, solve, limit and audit, from one cell to a whole photo."""

from __future__ import annotations

from lensmodel.core.psf import crop_to_support
from lensmodel.correction.blur import Sensor
from lensmodel.correction.expected_gain import PsfPosterior
from lensmodel.correction.limit import Bounds, StoredColour
from lensmodel.correction.richardson_lucy import SaturationAwareRichardsonLucy
from lensmodel.correction.sparse_gradient import SparseGradient
from lensmodel.correction.whole_photo import (
    KERNEL_SIZE,
    Corrected,
    Deconvolver,
    correct_planes,
    deconvolvers,
    restore_planes,
    window_of,
)

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
