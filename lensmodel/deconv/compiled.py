"""The inner loops, compiled.

Imported only where Numba and rocket-fft are installed; `lensmodel.deconv.engine` decides. Every
function has a NumPy twin that gives the same numbers.
"""

from lensmodel.deconv.compiled_limits import hold
from lensmodel.deconv.compiled_lucy import bare_transforms, richardson_lucy, through
from lensmodel.deconv.compiled_pass import one_pass
from lensmodel.deconv.compiled_steps import half_quadratic, pull_of
from lensmodel.deconv.compiled_tile import add, block_means, fill, spectra_of, transfer

__all__ = [
    "add",
    "bare_transforms",
    "block_means",
    "fill",
    "half_quadratic",
    "hold",
    "one_pass",
    "pull_of",
    "richardson_lucy",
    "spectra_of",
    "through",
    "transfer",
]
