"""The deconvolution methods by name."""

from __future__ import annotations

from lensmodel.core.registry import Registry
from lensmodel.correction.deconvolver import Deconvolver
from lensmodel.correction.methods.direct import DirectFilter
from lensmodel.correction.methods.richardson_lucy import (
    Acceleration,
    RichardsonLucy,
    SaturationAwareRichardsonLucy,
)
from lensmodel.correction.methods.sparse_gradient import SparseGradient


def _paper(iterations: int = 25, acceleration: Acceleration = "fixed") -> SaturationAwareRichardsonLucy:
    return SaturationAwareRichardsonLucy(iterations, acceleration=acceleration, warped=True)  # section 7


deconvolvers: Registry[Deconvolver] = Registry(
    "deconvolver",
    {
        "standard": SparseGradient,
        "paper": _paper,
        "fast": DirectFilter,
        "richardson-lucy": RichardsonLucy,
    },
    "lensmodel.deconvolvers",
)
