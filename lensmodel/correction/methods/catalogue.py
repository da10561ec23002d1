"""The deconvolution methods by name."""

from __future__ import annotations

from lensmodel.core.registry import Registry
from lensmodel.correction.deconvolver import Deconvolver
from lensmodel.correction.methods.direct import DirectFilter
from lensmodel.correction.methods.epll import Epll
from lensmodel.correction.methods.krishnan_fergus import KrishnanFergus
from lensmodel.correction.methods.richardson_lucy import RichardsonLucy, SaturationAwareRichardsonLucy
from lensmodel.correction.methods.sparse_gradient import SparseGradient
from lensmodel.correction.methods.wiener import Wiener


def _paper() -> SaturationAwareRichardsonLucy:
    return SaturationAwareRichardsonLucy(iterations=25, warped=True)  # section 8


def _whyte(iterations: int = 50) -> SaturationAwareRichardsonLucy:
    return SaturationAwareRichardsonLucy(iterations=iterations, accelerated=False)


deconvolvers: Registry[Deconvolver] = Registry(
    "deconvolver",
    {
        "standard": SparseGradient,
        "paper": _paper,
        "fast": DirectFilter,
        "richardson-lucy": RichardsonLucy,
        "whyte": _whyte,
        "krishnan-fergus": KrishnanFergus,
        "wiener": Wiener,
        "epll": Epll,
    },
    "lensmodel.deconvolvers",
)
