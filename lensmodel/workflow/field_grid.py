"""Field positions on a grid over the picture."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError


def field_grid(
    rows: int, cols: int, *, aspect: float = 1.5
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the field positions of the centers of equal cells of a picture.

    Parameters
    ----------
    rows, cols : int
        Number of cells, at least 1.
    aspect : float
        Width over height of the picture.

    Returns
    -------
    r, phi : ndarray of float64, shape (rows, cols)
        Half diagonals, and radians; row 0 is the top in sensor orientation.

    Raises
    ------
    InvalidInputError
        If there are no cells, or the aspect is not positive.
    """
    if rows < 1 or cols < 1 or not aspect > 0.0:
        raise InvalidInputError(f"a grid needs cells and an aspect, got {rows} x {cols}, aspect {aspect}")
    half = np.hypot(aspect, 1.0)
    up = (1.0 - (2.0 * np.arange(rows) + 1.0) / rows)[:, None] / half
    right = ((2.0 * np.arange(cols) + 1.0) / cols - 1.0)[None, :] * aspect / half
    return np.hypot(up, right), np.arctan2(up + 0.0 * right, right + 0.0 * up)
