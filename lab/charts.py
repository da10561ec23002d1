"""Sharpness of a photographed chart, edge by edge and zone by zone."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.types import ZONES, Direction, Zone
from lensmodel.quality.edge import Box, EdgeResponse, direction_of, slanted_edge

logger = logging.getLogger(__name__)


class EdgeMeasurement(NamedTuple):
    """One measured edge of a chart."""

    zone: Zone
    direction: Direction  # contrast along u, along v, or between the two: see `direction_of`
    response: EdgeResponse  # what was measured


@dataclass(frozen=True, slots=True)
class ZoneSharpness:
    """Medians over the edges of one zone."""

    zone: Zone
    edges: int  # how many were measured
    mtf50: float  # cycles/pixel; NaN where the zone has no edge of that direction
    tangential_mtf50: float
    sagittal_mtf50: float
    mtf_max: float  # largest of the zone: above 1 means oversharpened
    overshoot: float  # largest of the zone, percent of the step


def measure_edges(plane: NDArray[np.floating], boxes: Sequence[Box]) -> tuple[EdgeMeasurement, ...]:
    """Measure the slanted edges of a photo."""
    frame = Frame(*plane.shape)
    measured = []
    for box in boxes:
        row, col, height, width = box
        if row < 0 or col < 0 or row + height > frame.height or col + width > frame.width:
            raise InvalidInputError(f"box {box} leaves the frame of {frame.height} x {frame.width} pixels")
        try:
            response = slanted_edge(plane[row : row + height, col : col + width])
        except NotEnoughEvidenceError as error:
            logger.warning("no edge measured in box %s: %s", box, error)
            continue
        position = frame.position(row + (height - 1) / 2.0, col + (width - 1) / 2.0)
        direction = direction_of(response.normal, position)
        measured.append(EdgeMeasurement(zone_of(position.r), direction, response))
    if not measured:
        raise NotEnoughEvidenceError(f"none of the {len(boxes)} boxes holds a measurable edge")
    return tuple(measured)


def by_zone(measurements: Sequence[EdgeMeasurement]) -> dict[Zone, ZoneSharpness]:
    """Gather measured edges by zone; zones without an edge are missing."""
    table = {}
    for zone in ZONES:
        here = [m for m in measurements if m.zone == zone]
        if not here:
            continue
        middle, along, across = (
            [m.response.mtf50 for m in here if direction in ("", m.direction)]
            for direction in ("", "tangential", "sagittal")
        )
        table[zone] = ZoneSharpness(
            zone=zone,
            edges=len(here),
            mtf50=float(np.median(middle)),
            tangential_mtf50=float(np.median(along)) if along else math.nan,
            sagittal_mtf50=float(np.median(across)) if across else math.nan,
            mtf_max=max(float(m.response.mtf[m.response.frequencies <= 0.5].max()) for m in here),
            overshoot=max(m.response.overshoot for m in here),
        )
    return table
