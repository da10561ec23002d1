"""The eight symmetries of the square: every place is turned into one octant of the field.

A lens has no preferred side, and a pixel grid looks the same after a quarter turn or in a mirror. So the
network only ever sees places with 0 <= y <= x, and what it says is turned back. An octant is a triple of
flags: mirror x, then mirror y, then exchange x and y. Places have x to the right and y upwards; arrays have
rows downwards.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

OCTANTS: Final = 8
DIRECTIONS: Final = 16
"""Directions of statistics over the full circle, pi/8 apart, counter-clockwise from the right."""


def octant_of(xy: NDArray[np.floating]) -> NDArray[np.int64]:
    """Octant of places, shape (..., 2): 1 if x is mirrored, plus 2 if y is, plus 4 if they are exchanged."""
    x, y = xy[..., 0], xy[..., 1]
    return (x < 0) + 2 * (y < 0) + 4 * (np.abs(y) > np.abs(x))


def to_octant_place(octant: NDArray[np.int64], xy: NDArray[np.floating]) -> NDArray[np.floating]:
    """Turn places of shape (..., 2) by octants that broadcast against (...)."""
    x = np.where(octant & 1, -xy[..., 0], xy[..., 0])
    y = np.where(octant & 2, -xy[..., 1], xy[..., 1])
    swap = (octant & 4) > 0
    return np.stack([np.where(swap, y, x), np.where(swap, x, y)], -1)


def direction_order(octant: int) -> NDArray[np.int64]:
    """Where each of the 16 directions of an array in the octant's frame is found in the image's frame."""
    k = np.arange(DIRECTIONS)
    if octant & 1:
        k = (8 - k) % DIRECTIONS
    if octant & 2:
        k = -k % DIRECTIONS
    if octant & 4:
        k = (4 - k) % DIRECTIONS
    return np.argsort(k)


def to_octant_image(octant: int, image: NDArray[Any]) -> NDArray[Any]:
    """Turn images of shape (..., n, n) into the frame of an octant."""
    if octant & 1:
        image = image[..., ::-1]
    if octant & 2:
        image = image[..., ::-1, :]
    return np.swapaxes(image[..., ::-1, ::-1], -1, -2) if octant & 4 else image


def from_octant_image(octant: int, image: NDArray[Any]) -> NDArray[Any]:
    """Turn images of shape (..., n, n) back from the frame of an octant."""
    if octant & 4:
        image = np.swapaxes(image[..., ::-1, ::-1], -1, -2)
    if octant & 2:
        image = image[..., ::-1, :]
    return image[..., ::-1] if octant & 1 else image


def relative_octant(query: NDArray[np.int64], sample: NDArray[np.int64]) -> NDArray[np.int64]:
    """Symmetry that leads from the frame of a sample's octant to that of the query's, 0..7.

    Mirrors commute with each other, and the exchange turns a mirror of x into one of y. With q = S^s M the
    symmetry q p^-1 depends on the two octants alone, so that it is the same after both are turned by one
    symmetry.
    """
    return _RELATIVE[query, sample]


# to_octant_place as matrices; the inverse of one is its transpose
_MATRICES: Final = to_octant_place(np.arange(OCTANTS)[:, None], np.eye(2)).mT
_PRODUCTS: Final = _MATRICES[:, None] @ _MATRICES.mT[None]
_RELATIVE: Final = (_PRODUCTS[:, :, None] == _MATRICES).all(axis=(-1, -2)).argmax(axis=-1)
