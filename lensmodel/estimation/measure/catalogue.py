"""The ways of measuring, by name."""

from __future__ import annotations

from typing import Final

from lensmodel.core.registry import Registry
from lensmodel.estimation.measure.edges import SlantedEdges
from lensmodel.estimation.measure.measurer import Measurer
from lensmodel.estimation.measure.pair import AperturePair
from lensmodel.estimation.measure.points import Points
from lensmodel.estimation.measure.target import Target

methods: Final[Registry[Measurer]] = Registry(
    "way of measuring", {"target": Target, "pair": AperturePair, "points": Points, "edges": SlantedEdges}
)
