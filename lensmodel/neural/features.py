"""Places, settings and their relations as numbers, the same in training and in use.

A place is turned into the octant 0 <= y <= x first; how a sample lies to a query is told in the frame of the
query's octant. So nothing changes when all places are turned by one symmetry of the square.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import KINDS, PatchKind
from lensmodel.core.types import LensSettings
from lensmodel.neural.symmetry import OCTANTS, octant_of, relative_octant, to_octant_place

FAR_M: Final = 50.0
"""Metres: focus farther away is as good as infinite: a lens of 300 mm moves less than 2 mm for it."""

_GREEN_UM: Final = 0.54
SETTINGS: Final = 5
"""Columns of settings: logarithms of f-number, diffraction width (px), focal length, focus; the kind."""


@dataclass(frozen=True, slots=True)
class Conditions:
    """What is known of how a patch was taken, or of what is asked for; None is unknown.

    Parameters
    ----------
    f_number : float or None
    pitch_um : float or None
        Pixel pitch in micrometres.
    focal_mm, focus_m : float or None
        Focal length and focus distance.
    kind : {"raw", "tiff", "jpeg"}
        What the file holds: samples of the mosaic, developed planes, or those of a camera.

    Raises
    ------
    InvalidInputError
        If a value is not positive, or the kind is not known.
    """

    f_number: float | None = None
    pitch_um: float | None = None
    focal_mm: float | None = None
    focus_m: float | None = None
    kind: PatchKind = "raw"

    @classmethod
    def of(cls, settings: LensSettings, pitch_um: float | None, kind: PatchKind) -> Conditions:
        """Take them from settings of a lens; infinite focus is that of `FAR_M`."""
        focus_m = None if settings.focus_m is None else min(settings.focus_m, FAR_M)
        return cls(settings.aperture, pitch_um, settings.focal_mm, focus_m, kind)

    def __post_init__(self) -> None:
        for name in ("f_number", "pitch_um", "focal_mm", "focus_m"):
            value = getattr(self, name)
            if value is not None and not (math.isfinite(value) and value > 0):
                raise InvalidInputError(f"{name} must be positive, or None where it is unknown, got {value}")
        if self.kind not in KINDS:
            raise InvalidInputError(
                f"the kind of a file must be one of {', '.join(KINDS)}, got {self.kind!r}"
            )

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
