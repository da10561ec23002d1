"""PSF samples as rows.

A sample has the fields of `lensmodel.model.samples`, each with its column.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from sqlalchemy import Row
from sqlalchemy.orm import InstrumentedAttribute

from app import distances
from app.store.tables import PatchRow, PhotoRow, SampleRow
from lensmodel.core.errors import LensModelError, NoSamplesError
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.model.samples import entry_of, sample_of

DTYPE: Final = "<f4"
FORMAT_VERSION: Final = 2  # raised when samples of before mean nothing to the model any more
# Characters kept of an estimator's name, which profiles and own estimators choose (chosen: every name of
# ours fits, and no other fills the table)
MAX_ESTIMATOR: Final = 60
_Columns = Mapping[str, InstrumentedAttribute[Any]]
_OWN: Final[_Columns] = {
    "r": SampleRow.r,
    "phi": SampleRow.phi,
    "weight": SampleRow.weight,
    "size": SampleRow.size,
    "estimator": SampleRow.estimator,
    "error": SampleRow.predicted_error,
}
_OF_PHOTO: Final[_Columns] = {"photo": PhotoRow.public_id, "pixel_pitch_um": PhotoRow.pixel_pitch_um}
_SETTINGS: Final[_Columns] = {
    "channel": SampleRow.channel,
    "aperture": PhotoRow.aperture,
    "focal_mm": PhotoRow.focal_mm,
    "focus_m": PhotoRow.focus_m,
}
_BESIDE: Final = (
    *(SampleRow.crc32, SampleRow.format_version, SampleRow.psf),
    *(PatchRow.encoded, PhotoRow.width, PhotoRow.height),
)

# What `sample_in` reads: of samples joined with their patches and photos
COLUMNS: Final = (
    *(column.label(name) for name, column in {**_OWN, **_OF_PHOTO, **_SETTINGS}.items()),
    *_BESIDE,
)
PROFILE: Final = "profile"  # kind of a photo of which a profile has told: its file was never here


class OutdatedSampleError(NoSamplesError):
    """A sample was made by an estimator of an earlier version of the program."""


class CorruptSampleError(LensModelError):
    """A stored kernel is not what was written."""

    code = "corrupt_sample"


@dataclass(frozen=True, slots=True)
class LensState:
    """Version of a lens: shows whether a fitted model is up to date."""

    version: int
    rebuild_epoch: int


def columns_of(sample: PsfSample, photo: PhotoRow, patch: PatchRow) -> dict[str, Any]:
    """Return a sample as a row; what its photo knows, its photo's row keeps, and `patch` what it encodes."""
    entry = entry_of(sample)
    entry["estimator"] = entry["estimator"][:MAX_ESTIMATOR] or PROFILE
    if sample.encoded is not None:
        patch.encoded = sample.encoded.to_bytes()
    blob = np.ascontiguousarray(sample.kernel, dtype=DTYPE).tobytes()
    return {
        "photo_id": photo.id,
        "patch_id": patch.id,
        "channel": sample.settings.channel,
        **{column.key: entry[name] for name, column in _OWN.items()},
        "format_version": FORMAT_VERSION,
        "crc32": zlib.crc32(blob),
        "psf": blob,
    }


def sample_in(row: Row[*tuple[Any, ...]]) -> PsfSample:
    """Build the sample of a row of `COLUMNS`."""
    if row.format_version != FORMAT_VERSION:
        raise OutdatedSampleError(
            "the samples of this lens were made by an earlier version of the program: calibrate it again, by "
            "retrying its photos"
        )
    if zlib.crc32(row.psf) != row.crc32:
        raise CorruptSampleError(f"sample {row.id} differs from what was written: restore the database")
    settings = {name: getattr(row, name) for name in _SETTINGS}
    settings["focus_m"] = distances.read(settings["focus_m"])
    entry = {name: getattr(row, name) for name in (*_OWN, *_OF_PHOTO)}
    entry["half_diagonal_px"] = math.hypot(row.width, row.height) / 2 if row.width and row.height else None
    return sample_of(
        {**entry, "settings": settings},
        np.frombuffer(row.psf, dtype=DTYPE).reshape(row.size, row.size),
        None if row.encoded is None else _encoded(row.encoded),
    )


@lru_cache(maxsize=16)
def _encoded(data: bytes) -> EncodedPatch:
    """Decode a patch once for its three channels."""
    return EncodedPatch.from_bytes(data)
