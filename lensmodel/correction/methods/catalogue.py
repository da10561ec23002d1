"""The deconvolution methods by name."""

from __future__ import annotations

from lensmodel.core.registry import Registry
from lensmodel.correction.deconvolver import Deconvolver
from lensmodel.correction.methods.direct import DirectFilter
from lensmodel.correction.methods.richardson_lucy import RichardsonLucy, SaturationAwareRichardsonLucy
from lensmodel.correction.methods.sparse_gradient import SparseGradient


def _paper() -> SaturationAwareRichardsonLucy:
    return SaturationAwareRichardsonLucy(iterations=25, warped=True)  # section 8


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
