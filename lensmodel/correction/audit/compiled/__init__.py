"""The inner loops of the checks, compiled.

Imported only where Numba and rocket-fft are installed; `lensmodel.correction.engine` decides. Every
function has a NumPy twin in the check that calls it, which gives the same numbers but for rounding.
"""

from lensmodel.correction.audit.compiled.flat import flat_grain, flat_waves
from lensmodel.correction.audit.compiled.hue import colours
from lensmodel.correction.audit.compiled.light import isolated, light
from lensmodel.correction.audit.compiled.pair import prepared
from lensmodel.correction.audit.compiled.reblur import left_over
from lensmodel.correction.audit.compiled.spectrum import powers
from lensmodel.correction.compiled.tile import transfer

__all__ = [
    "colours",
    "flat_grain",
    "flat_waves",
    "isolated",
    "left_over",
    "light",
    "powers",
    "prepared",
    "transfer",
]
