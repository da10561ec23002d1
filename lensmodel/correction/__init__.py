"""Step 3, non-blind deconvolution: plan, solve, limit and audit, from one cell to a whole photo."""

from lensmodel.core.psf import crop_to_support as crop_to_support
from lensmodel.correction.cell import KERNEL_SIZE as KERNEL_SIZE
from lensmodel.correction.deconvolver import Deconvolver as Deconvolver
from lensmodel.correction.deconvolver import Sensor as Sensor
from lensmodel.correction.deconvolver import restore_planes as restore_planes
from lensmodel.correction.limit import Bounds as Bounds
from lensmodel.correction.limit import StoredColour as StoredColour
from lensmodel.correction.posterior import PsfPosterior as PsfPosterior
from lensmodel.correction.richardson_lucy import (
    SaturationAwareRichardsonLucy as SaturationAwareRichardsonLucy,
)
from lensmodel.correction.sparse_gradient import SparseGradient as SparseGradient
from lensmodel.correction.whole_photo import Corrected as Corrected
from lensmodel.correction.whole_photo import correct_planes as correct_planes
from lensmodel.correction.whole_photo import deconvolvers as deconvolvers
from lensmodel.correction.whole_photo import window_of as window_of
