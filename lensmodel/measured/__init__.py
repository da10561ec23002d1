"""PSFs measured on photos made for it, instead of estimated from ordinary ones."""

from typing import Final

from lensmodel.core.registry import Registry
from lensmodel.measured.chart import print_chart
from lensmodel.measured.edges import SlantedEdges
from lensmodel.measured.measurer import MeasuredPsf, Measurer, estimator_of, is_measured, samples_of
from lensmodel.measured.page import DETAILS, PAPERS, TargetPage, print_target
from lensmodel.measured.pair import AperturePair
from lensmodel.measured.points import Points
from lensmodel.measured.target import Target

methods: Final[Registry[Measurer]] = Registry(
    "way of measuring", {"target": Target, "pair": AperturePair, "points": Points, "edges": SlantedEdges}
)

__all__ = [
    "DETAILS",
    "PAPERS",
    "MeasuredPsf",
    "Measurer",
    "TargetPage",
    "estimator_of",
    "is_measured",
    "methods",
    "print_chart",
    "print_target",
    "samples_of",
]
