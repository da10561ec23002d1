"""The audit of a whole photo, tile by tile."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import Frame, zone_of
from lensmodel.core.types import FieldPosition, Plane, Planes, StepHook, ignore_step
from lensmodel.correction.audit.check import Evidence
from lensmodel.correction.audit.findings import AuditReport, pooled
from lensmodel.correction.audit.tile import audit_tile

TILE: Final = 192
HALO: Final = 48
"""Side of a tile in pixels, and the margin seen around it. Both are multiples of the step of the checks'
windows, so that neighbouring tiles see the same windows and no seam shows (chosen: a margin of three steps
holds every window that touches a tile; larger tiles take more memory, smaller ones more margin)."""

Window: TypeAlias = tuple[slice, slice]
EvidenceAt: TypeAlias = Callable[[FieldPosition, Window], Evidence]
"""What is known at a place of the field, for a window of the photo."""


@dataclass(frozen=True, slots=True, eq=False)
class PhotoAudit:
    """Verdict on a photo.

    Parameters
    ----------
    keep : Plane, shape (rows, cols)
        Share of the correction that should be kept.
    report : AuditReport
        Why and where.
    """

    keep: Plane
    report: AuditReport

    def mixed(self, original: Planes, corrected: Planes) -> Planes:
        """Mix a correction back towards its original as far as it fails.

        Parameters
        ----------
        original, corrected : Planes, shape (3, rows, cols), float32
            The photo and its correction.

        Returns
        -------
        Planes, shape (3, rows, cols), float32
        """
        return np.asarray(original + self.keep * (corrected - original), dtype=np.float32)


def audit_photo(
    original: Planes, corrected: Planes, evidence: EvidenceAt, *, on_step: StepHook = ignore_step
) -> PhotoAudit:
    """Audit any program's correction of a photo.

    Parameters
    ----------
    original, corrected : Planes, shape (3, rows, cols)
        Linear light, saturation 1, pixel for pixel the same scene.
    evidence : callable
        What is known at a place: noise, clip levels, PSFs if any, where the sensor measured.
    on_step : StepHook
        Called after each tile; may raise to stop.

    Returns
    -------
    PhotoAudit

    Raises
    ------
    InvalidInputError
        If the planes have different sizes.
    """
    if original.shape != corrected.shape:
        raise InvalidInputError(
            f"original and correction must have one size, got {original.shape} and {corrected.shape}"
        )
    frame = Frame(original.shape[1], original.shape[2])
    keep = np.ones((frame.height, frame.width), dtype=np.float32)
    tiles = list(_tiles(frame))
    verdicts = []
    for done, (part, around) in enumerate(tiles, start=1):
        (top, bottom), (left, right) = ((s.start, s.stop) for s in part)
        place = frame.position((top + bottom - 1) / 2.0, (left + right - 1) / 2.0)
        inner = tuple(slice(p.start - a.start, p.stop - a.start) for p, a in zip(part, around, strict=True))
        window = (slice(None), *around)
        verdict = audit_tile(
            np.asarray(original[window], dtype=np.float32),
            np.asarray(corrected[window], dtype=np.float32),
            evidence(place, around),
            inner=(inner[0], inner[1]),
        )
        keep[part] = verdict.keep
        verdicts.append((zone_of(place.r), (top, left), verdict.without_map()))
        on_step(done, len(tiles))
    return PhotoAudit(keep, pooled(verdicts))


def _tiles(frame: Frame) -> Iterator[tuple[Window, Window]]:
    """Parts of the frame, and each with its halo."""
    for top in range(0, frame.height, TILE):
        for left in range(0, frame.width, TILE):
            bottom, right = min(top + TILE, frame.height), min(left + TILE, frame.width)
            yield (
                (slice(top, bottom), slice(left, right)),
                (
                    slice(max(top - HALO, 0), min(bottom + HALO, frame.height)),
                    slice(max(left - HALO, 0), min(right + HALO, frame.width)),
                ),
            )
