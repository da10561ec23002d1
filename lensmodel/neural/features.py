"""Places, settings and their relations as numbers, the same in training and in use.

A lens has no preferred side, and a pixel grid looks the same after a quarter turn or in a mirror. So every
place is turned into the octant 0 <= y <= x first, how a sample lies to a query is told in the frame of the
query's octant, and what the network says is turned back. An octant is a triple of flags: mirror x, then
mirror y, then exchange x and y. Places have x to the right and y upwards; arrays have rows downwards.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import KINDS, PatchKind
from lensmodel.core.types import LensSettings

OCTANTS: Final = 8
DIRECTIONS: Final = 16  # of statistics over the full circle, counter-clockwise from the right


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
    """Symmetry that leads from the frame of a sample's octant to that of the query's, 0..7."""
    return _RELATIVE[query, sample]


# to_octant_place as matrices; the inverse of one is its transpose
_MATRICES: Final = to_octant_place(np.arange(OCTANTS)[:, None], np.eye(2)).mT
_PRODUCTS: Final = _MATRICES[:, None] @ _MATRICES.mT[None]
_RELATIVE: Final = (_PRODUCTS[:, :, None] == _MATRICES).all(axis=(-1, -2)).argmax(axis=-1)


FAR_M: Final = 50.0  # focus farther away is as good as infinite: a lens of 300 mm moves less than 2 mm for it
_GREEN_UM: Final = 0.54
SETTINGS: Final = 5  # columns: logarithms of f-number, diffraction width (px), focal length, focus; the kind


@dataclass(frozen=True, slots=True)
class Conditions:
    """What is known of how a patch was taken, or of what is asked for: positive, or None for unknown."""

    f_number: float | None = None
    pitch_um: float | None = None  # of a pixel
    focal_mm: float | None = None
    focus_m: float | None = None
    kind: PatchKind = "raw"  # samples of the mosaic, developed planes, or those of a camera

    @classmethod
    def of(cls, settings: LensSettings, pitch_um: float | None, kind: PatchKind) -> Conditions:
        """Take them from settings of a lens; infinite focus is that of `FAR_M`."""
        focus_m = None if settings.focus_m is None else min(settings.focus_m, FAR_M)
        return cls(settings.aperture, pitch_um, settings.focal_mm, focus_m, kind)

    def row(self) -> NDArray[np.float64]:
        """As numbers, float64 of shape (SETTINGS,); unknown ones are NaN."""
        width = None if None in (self.f_number, self.pitch_um) else _GREEN_UM * self.f_number / self.pitch_um  # type: ignore[operator]
        values = (self.f_number, width, self.focal_mm, self.focus_m)
        logs = [math.nan if value is None else math.log(value) for value in values]
        return np.array([*logs, float(KINDS.index(self.kind))])


def place_features(xy: NDArray[np.floating]) -> NDArray[np.float32]:
    """Features of places, (..., 2) to (..., PLACE), the same for all eight that symmetry joins."""
    canonical = to_octant_place(octant_of(xy), xy)
    x, y = canonical[..., 0], canonical[..., 1]
    r = np.hypot(x, y)
    angle = np.arctan2(y, np.maximum(x, 1e-9))
    parts = [x, y, r, r * r, r**3, np.cos(4 * angle), np.sin(4 * angle), r * np.cos(4 * angle)]
    for k in (1.5, 3.0):
        parts += [np.sin(k * x), np.cos(k * x), np.sin(k * y), np.cos(k * y), np.cos(2 * k * r)]
    return np.stack(parts, -1).astype(np.float32)


PLACE: Final = 18


def condition_features(settings: NDArray[np.floating]) -> NDArray[np.float32]:
    """Features of settings, shape (..., SETTINGS) to (..., CONDITION)."""
    known = np.isfinite(settings[..., :2])
    values = np.where(known, settings[..., :2], 0.0)
    kinds = settings[..., 4:5] == np.arange(len(KINDS))
    return np.concatenate([values, known, kinds], -1).astype(np.float32)


CONDITION: Final = 7


def relation_features(
    query_xy: NDArray[np.floating],
    query_settings: NDArray[np.floating],
    sample_xy: NDArray[np.floating],
    sample_settings: NDArray[np.floating],
) -> NDArray[np.float32]:
    """How each sample lies to each query, as float32 of shape (..., q, n, RELATION).

    Of places (..., q, 2) and settings (..., q, SETTINGS) of queries and samples. The first `DISTANCES` are
    squared distances: in the plane, along the radius, in log f-number, focal length and focus.
    """
    octants = octant_of(query_xy)
    at = to_octant_place(octants, query_xy)[..., :, None, :]
    place = to_octant_place(octants[..., :, None], sample_xy[..., None, :, :])
    offset = place - at
    squared = np.square(offset).sum(-1)
    radius = np.hypot(place[..., 0], place[..., 1])
    along = radius - np.hypot(at[..., 0], at[..., 1])
    change = sample_settings[..., None, :, :] - query_settings[..., :, None, :]
    known = np.isfinite(change[..., :4])
    change = np.where(known, change[..., :4], 0.0)
    same_kind = (sample_settings[..., None, :, 4] == query_settings[..., :, None, 4]).astype(float)
    turn = relative_octant(octants[..., :, None], octant_of(sample_xy)[..., None, :])
    parts = [
        squared, along**2, change[..., 0] ** 2, change[..., 2] ** 2, change[..., 3] ** 2,
        offset[..., 0], offset[..., 1], place[..., 0], place[..., 1], radius, along,
        np.exp(-squared / 0.05), np.exp(-squared / 0.3), np.exp(-(along**2) / 0.02),
        change[..., 0], change[..., 1], change[..., 2], change[..., 3],
        known[..., 0].astype(float), known[..., 1].astype(float), same_kind,
    ]  # fmt: skip
    one_hot = turn[..., None] == np.arange(OCTANTS)
    return np.concatenate([np.stack(parts, -1), one_hot], -1).astype(np.float32)


DISTANCES: Final = 5
RELATION: Final = 21 + OCTANTS
