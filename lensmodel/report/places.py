"""Places of the field: in plain words, and as grids that stay inside the frame."""

from __future__ import annotations

import math
from typing import Final

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CENTER_ZONE_R, CORNER_ZONE_R, FieldPosition, field_grid

# Width over height of a 35 mm frame; a profile does not say how wide its photos were
DEFAULT_ASPECT: Final = 1.5

_DIRECTIONS: Final = (
    *("right", "upper right", "top", "upper left"),
    *("left", "lower left", "bottom", "lower right"),
)


def direction_in_words(phi: float) -> str:
    """Name the eighth of the picture that an angle points to."""
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
    """Half width and half height of a frame in half diagonals."""
    if not 0.2 <= aspect <= 5.0:
        raise InvalidInputError(f"width over height must lie in 0.2..5, got {aspect}")
    diagonal = math.hypot(aspect, 1.0)
    return aspect / diagonal, 1.0 / diagonal


def grid(rows: int, cols: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Centres of rows x cols equal cells of the picture, row by row from the top left."""
    if not (1 <= rows <= 100 and 1 <= cols <= 100):
        raise InvalidInputError(f"a grid has 1..100 rows and columns, got {rows} x {cols}")
    r, phi = field_grid(rows, cols, aspect=aspect)
    return tuple(FieldPosition(float(a), float(b)) for a, b in zip(r.ravel(), phi.ravel(), strict=True))


def ring(r: float, count: int, aspect: float) -> tuple[FieldPosition, ...]:
    """Places at one radius that lie on the picture, symmetric about both of its axes.

    Angles are drawn evenly from the arcs that the frame cuts from the circle; one place at the centre.
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
    angle = math.atan(1.0 / aspect)
    return tuple(FieldPosition(0.9, phi) for phi in (math.pi - angle, angle, angle - math.pi, -angle))


def side_places(aspect: float) -> tuple[FieldPosition, ...]:
    """Left, right, top and bottom, four fifths of the way to the edge."""
    width, height = half_sides(aspect)
    sides = ((width, math.pi), (width, 0.0), (height, math.pi / 2), (height, -math.pi / 2))
    return tuple(FieldPosition(0.8 * half, phi) for half, phi in sides)
