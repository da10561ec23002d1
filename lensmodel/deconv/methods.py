"""The deconvolution methods by name."""

from __future__ import annotations

from lensmodel.deconv.base import Deconvolver
from lensmodel.deconv.direct import DirectFilter
from lensmodel.deconv.epll import Epll
from lensmodel.deconv.krishnan_fergus import KrishnanFergus
from lensmodel.deconv.richardson_lucy import RichardsonLucy, SaturationAwareRichardsonLucy
from lensmodel.deconv.sparse_gradient import SparseGradient
from lensmodel.deconv.wiener import Wiener
from lensmodel.registry import Registry


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
)
