"""The inner loops, compiled.

Imported only where Numba and rocket-fft are installed; `lensmodel.correction.engine` decides. Every
function has a NumPy twin that gives the same numbers.
"""

from lensmodel.correction.compiled.half_quadratic import half_quadratic, pull_of
from lensmodel.correction.compiled.limits import hold
from lensmodel.correction.compiled.one_pass import one_pass
from lensmodel.correction.compiled.richardson_lucy import richardson_lucy, through
from lensmodel.correction.compiled.tile import add, block_means, fill, spectra_of, transfer

__all__ = [
    "add",
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
