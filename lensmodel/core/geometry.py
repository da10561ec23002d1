"""Where a pixel lies in the image field, and the local frame that turns with it.

Pixels are `(row, col)` with integers at pixel centres and rows growing downwards. The field
position is `(r, phi)`, with phi counter-clockwise from the right, so that +pi/2 points towards
row 0. The local frame has `u` radially outwards and `v` turned +90 degrees from it in the
sense of phi.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import FieldPosition, Zone

_Number = TypeVar("_Number", bound=np.floating)
CENTER_ZONE_R = 0.3  # zone "center" lies below this r
CORNER_ZONE_R = 0.75  # zone "corner" lies above this r


def zone_of(r: float) -> Zone:
    """Name the zone of the field that `r` lies in: centre r < 0.3, corner r > 0.75, else mid."""
    if r < CENTER_ZONE_R:
        return "center"
    return "corner" if r > CORNER_ZONE_R else "mid"


def block_means(plane: NDArray[_Number], side: int) -> NDArray[_Number]:
    """Means over squares of `side` pixels; what is left over at the end of an axis is left out."""
    rows, cols = (length // side for length in plane.shape)
    return plane[: rows * side, : cols * side].reshape(rows, side, cols, side).mean(axis=(1, 3))


@dataclass(frozen=True, slots=True)
class Frame:
    """The sensor frame of a photo, in sensor orientation."""

    height: int  # pixels
    width: int
    circle_px: float | None = None  # half diagonal of a larger frame of which this is the middle: unit of r

    def __post_init__(self) -> None:
        if self.height < 1 or self.width < 1:
            raise InvalidInputError(f"a frame needs at least one pixel, got {self.height} x {self.width}")
        if self.circle_px is not None and not self.circle_px >= math.hypot(self.height, self.width) / 2.0:
            raise InvalidInputError(
                f"{self.height} x {self.width} pixels do not lie in a half diagonal of {self.circle_px}"
            )

    @property
    def center(self) -> tuple[float, float]:
        """The image centre as `(row, col)`; between pixels where a side is even."""
        return (self.height - 1) / 2.0, (self.width - 1) / 2.0

    @property
    def half_diagonal(self) -> float:
        """Distance in pixels from the centre to the outer corner of the corner pixel, of the whole frame."""
        return self.circle_px or math.hypot(self.height, self.width) / 2.0

    def position(self, row: float, col: float) -> FieldPosition:
        """Field position of a pixel; places outside the frame are drawn in to r = 1."""
        row_c, col_c = self.center
        up, right = row_c - row, col - col_c
        return FieldPosition(min(math.hypot(up, right) / self.half_diagonal, 1.0), math.atan2(up, right))

    def pixel(self, position: FieldPosition) -> tuple[float, float]:
        """Pixel `(row, col)` of a field position, real-valued; the inverse of `position`."""
        row_c, col_c = self.center
        distance = position.r * self.half_diagonal
        return row_c - distance * math.sin(position.phi), col_c + distance * math.cos(position.phi)

    def polar(
        self, rows: NDArray[np.floating], cols: NDArray[np.floating]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Arrays `r`, `phi` for arrays of rows and columns that broadcast together."""
        row_c, col_c = self.center
        up = row_c - np.asarray(rows, dtype=np.float64)
        right = np.asarray(cols, dtype=np.float64) - col_c
        return np.hypot(up, right) / self.half_diagonal, np.arctan2(up, right)


def field_grid(
    rows: int, cols: int, *, aspect: float = 1.5
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the field positions of the centres of equal cells of a picture, `aspect` its width over height.

    Returns
    -------
    r, phi : ndarray of float64, shape (rows, cols)
        Half diagonals, and radians; row 0 is the top in sensor orientation.
    """
    if rows < 1 or cols < 1 or not aspect > 0.0:
        raise InvalidInputError(f"a grid needs cells and an aspect, got {rows} x {cols}, aspect {aspect}")
    half = np.hypot(aspect, 1.0)
    up = (1.0 - (2.0 * np.arange(rows) + 1.0) / rows)[:, None] / half
    right = ((2.0 * np.arange(cols) + 1.0) / cols - 1.0)[None, :] * aspect / half
    return np.hypot(up, right), np.arctan2(up + 0.0 * right, right + 0.0 * up)
