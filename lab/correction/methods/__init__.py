"""Deconvolution methods to compare with: for `lensmodel bench correct`, not for users.

`compared` knows them beside those of the product.
"""

from typing import Final

from lab.correction.methods.epll import EpllDeconvolver
from lab.correction.methods.krishnan_fergus import KrishnanFergus
from lab.correction.methods.wiener import Wiener
from lensmodel.core.registry import Registry
from lensmodel.correction import Deconvolver, SaturationAwareRichardsonLucy, deconvolvers


def _whyte(iterations: int = 50) -> SaturationAwareRichardsonLucy:
    return SaturationAwareRichardsonLucy(iterations=iterations, acceleration="none")


compared: Final[Registry[Deconvolver]] = deconvolvers.extended(
    epll=EpllDeconvolver, krishnan_fergus=KrishnanFergus, whyte=_whyte, wiener=Wiener
)

__all__ = ["EpllDeconvolver", "KrishnanFergus", "Wiener", "compared"]
