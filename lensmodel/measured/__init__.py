"""PSFs measured on photos made for it, instead of estimated from ordinary ones: photos in, samples out."""

from typing import Final

from lensmodel.core.registry import Registry
from lensmodel.measured.edges import SlantedEdges
from lensmodel.measured.measurer import Measurer
from lensmodel.measured.pair import AperturePair
from lensmodel.measured.points import Points
from lensmodel.measured.target import DETAILS, PAPERS, Target, TargetPage, print_target

methods: Final[Registry[Measurer]] = Registry(
    "way of measuring", {"target": Target, "pair": AperturePair, "points": Points, "edges": SlantedEdges}
)

__all__ = ["DETAILS", "PAPERS", "Measurer", "TargetPage", "methods", "print_target"]
