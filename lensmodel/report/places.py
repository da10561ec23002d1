"""Places of the field: in plain words, and as grids that stay inside the frame."""

from __future__ import annotations

import math
from typing import Final

from lensmodel.errors import InvalidInputError
from lensmodel.geometry import CENTER_ZONE_R, CORNER_ZONE_R
from lensmodel.types import FieldPosition

DEFAULT_ASPECT: Final = 1.5
"""Width over height of a 35 mm frame; a profile does not say how wide its photos were."""

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
        return "the center"
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


def inside(position: FieldPosition, aspect: float) -> bool:
    """Whether a place lies on the picture."""
    width, height = half_sides(aspect)
    x, y = position.r * math.cos(position.phi), position.r * math.sin(position.phi)
    return abs(x) <= width + 1e-9 and abs(y) <= height + 1e-9


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
    found = []
    for i in range(rows):
        y = height * (1.0 - (2 * i + 1) / rows)
        for j in range(cols):
            x = width * ((2 * j + 1) / cols - 1.0)
            found.append(FieldPosition(min(math.hypot(x, y), 1.0), math.atan2(y, x)))
    return tuple(found)


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
