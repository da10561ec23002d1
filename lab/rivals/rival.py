"""What a rival method takes and gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lensmodel.core.psf import PsfField
from lensmodel.core.types import FieldPosition, NoiseModel, Plane, Planes
from lensmodel.photo import LinearPhoto
from lensmodel.workflow import sampling

PATCHES = 48
"""Patches looked at in one photo: twice those of a calibration, because rivals are cheap."""


class Rival(Protocol):
    """A blind method of somebody else: photos of one lens at one setting in, its PSF field out."""

    name: str
    source: str

    def field(self, photos: Sequence[LinearPhoto]) -> PsfField:
        """Estimate the PSF field, all channels."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoWindow:
    """A window of a photo in all channels."""

    planes: Planes  # (3, side, side)
    noise: tuple[NoiseModel, ...]  # one per channel
    position: FieldPosition  # of its middle

    def plane(self, channel: int) -> Plane:
        """One colour of it."""
        return self.planes[channel]


def windows_of(photos: Sequence[LinearPhoto]) -> list[PhotoWindow]:
    """Cut the windows that tell about the blur, chosen in green as a calibration does."""
    found = []
    for photo in photos:
        for patch in sampling.find_patches(photo, count=PATCHES).patches:
            rows, cols = slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size)
            planes = np.ascontiguousarray(photo.planes[:, rows, cols])
            found.append(PhotoWindow(planes, photo.noise, patch.position))
    return found
