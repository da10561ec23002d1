"""Places of the field: in plain words, and as grids that stay inside the frame."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Final

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import CENTER_ZONE_R, CORNER_ZONE_R
from lensmodel.core.types import FieldPosition

DEFAULT_ASPECT: Final = 1.5
"""Width over height of a 35 mm frame; a profile does not say how wide its photos were."""

NEAR_R: Final = 0.3
"""Distance in half diagonals within which a patch speaks for a place: no spot of the picture is further from
all `landmarks`, and blur changes little over it (chosen)."""

ENOUGH_NEAR: Final = 5
"""Patches near a place that has been seen well: a mean of five is known twice as well as one of them
(chosen)."""

_DIRECTIONS: Final = (
    *("right", "upper right", "top", "upper left"),
    *("left", "lower left", "bottom", "lower right"),
)


def direction_in_words(phi: float) -> str:
    """Name the eighth of the picture that an angle points to.

    Parameters
    ----------
    phi : float
        Radians, counter-clockwise from the right, +pi/2 towards the top of the sensor's picture.
    """
    return _DIRECTIONS[round(phi / (math.pi / 4.0)) % 8]


def place_in_words(position: FieldPosition) -> str:
    """Name a place so that somebody can put it into the viewfinder: "the upper left corner"."""
    if position.r < CENTER_ZONE_R:
        return "the centre"
    side = direction_in_words(position.phi)
    if position.r <= CORNER_ZONE_R:
        return f"the {side}"
    return f"the {side} {'corner' if ' ' in side else 'edge'}"


def half_sides(aspect: float) -> tuple[float, float]:
    """Half width and half height of a frame in half diagonals.

    Raises
    ------
    InvalidInputError
        If width over height is outside 0.2 to 5.
    """
    if not 0.2 <= aspect <= 5.0:
        raise InvalidInputError(f"width over height must lie in 0.2..5, got {aspect}")
    diagonal = math.hypot(aspect, 1.0)
    return aspect / diagonal, 1.0 / diagonal


def grid(rows: int, cols: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Centres of rows x cols equal cells of the picture, row by row from the top left.

    Raises
    ------
    InvalidInputError
        If there are no cells, or too many.
    """
    if not (1 <= rows <= 100 and 1 <= cols <= 100):
        raise InvalidInputError(f"a grid has 1..100 rows and columns, got {rows} x {cols}")
    width, height = half_sides(aspect)
    places = []
    for i in range(rows):
        y = height * (1.0 - (2 * i + 1) / rows)
        for j in range(cols):
            x = width * ((2 * j + 1) / cols - 1.0)
            places.append(FieldPosition(min(math.hypot(x, y), 1.0), math.atan2(y, x)))
    return tuple(places)


def ring(r: float, count: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Places at one radius that lie on the picture, symmetric about both of its axes.

    Angles are drawn evenly from the arcs that the frame cuts from the circle; one place at the centre.

    Parameters
    ----------
    r : float
        0 centre, 1 corner.
    count : int
        Places in each quarter.
    """
    if r == 0.0:
        return (FieldPosition(0.0, 0.0),)
    width, height = half_sides(aspect)
    low = math.acos(min(width / r, 1.0))
    high = math.asin(min(height / r, 1.0))
    quarter = [low + (high - low) * (k + 0.5) / count for k in range(count)]
    angles = [s * (a if side > 0 else math.pi - a) for s in (1, -1) for side in (1, -1) for a in quarter]
    return tuple(FieldPosition(r, a) for a in angles)


def corner_places(aspect: float) -> tuple[FieldPosition, ...]:
    """The four corners, upper left first, as far out as samples reach."""
    width, height = half_sides(aspect)
    corner = math.atan2(height, width)
    return tuple(FieldPosition(0.9, phi) for phi in (math.pi - corner, corner, corner - math.pi, -corner))


def landmarks() -> list[FieldPosition]:
    """The centre, the four corners, the four quarters between, and the middles of the four edges."""
    width, height = half_sides(DEFAULT_ASPECT)
    corners = corner_places(DEFAULT_ASPECT)
    return [
        FieldPosition(0.0, 0.0),
        *corners,
        *(FieldPosition(0.5, place.phi) for place in corners),
        *(FieldPosition(0.8 * width, phi) for phi in (0.0, math.pi)),
        *(FieldPosition(0.8 * height, phi) for phi in (math.pi / 2, -math.pi / 2)),
    ]


def little_seen(positions: Iterable[FieldPosition], least: int = ENOUGH_NEAR) -> list[FieldPosition]:
    """Landmarks with too little evidence near them, the emptiest first.

    Parameters
    ----------
    positions : iterable of FieldPosition
        Where patches gave a PSF.
    least : int
        Patches within `NEAR_R` that are enough.
    """
    points = np.array([(p.r * math.cos(p.phi), p.r * math.sin(p.phi)) for p in positions]).reshape(-1, 2)
    counts = []
    for place in landmarks():
        offset = points - (place.r * math.cos(place.phi), place.r * math.sin(place.phi))
        counts.append((int((np.hypot(*offset.T) <= NEAR_R).sum()), place))
    return [place for count, place in sorted(counts, key=lambda item: item[0]) if count < least]
