"""Between offsets in pixels and the local frame of a place, turned by its field angle."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray


def pixel_to_local(
    drow: NDArray[np.floating] | float, dcol: NDArray[np.floating] | float, phi: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn pixel offsets into local `(u, v)` at a place of angle `phi`.

    With a = dcol to the right and b = -drow upwards::

        u =  a cos phi + b sin phi        radially outwards
        v = -a sin phi + b cos phi        +90 degrees from u in the sense of phi
    """
    a, b = np.asarray(dcol, dtype=np.float64), -np.asarray(drow, dtype=np.float64)
    c, s = math.cos(phi), math.sin(phi)
    return a * c + b * s, b * c - a * s


def local_to_pixel(
    u: NDArray[np.floating] | float, v: NDArray[np.floating] | float, phi: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Turn local `(u, v)` into pixel offsets `(drow, dcol)`; the inverse of `pixel_to_local`."""
    u, v = np.asarray(u, dtype=np.float64), np.asarray(v, dtype=np.float64)
    c, s = math.cos(phi), math.sin(phi)
    return -(u * s + v * c), u * c - v * s
