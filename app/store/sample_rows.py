"""PSF samples in the tables: the fields of `lensmodel.model.sample_codec`, each with its column."""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from typing import Any, Final

import numpy as np
from sqlalchemy import Row
from sqlalchemy.orm import InstrumentedAttribute

from app.schemas import distances
from app.store.access.owners import now
from app.store.tables import PatchRow, PhotoRow, SampleRow
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample
from lensmodel.core.spectrum import PatchSpectrum
from lensmodel.model.sample_codec import entry_of, sample_of

DTYPE: Final = "<f4"
FORMAT_VERSION: Final = 1
"""Raised when the layout of a stored kernel changes."""

MAX_ESTIMATOR: Final = 60
"""Characters kept of an estimator's name, which profiles and own estimators choose (chosen: every name of
ours fits, and no other fills the table)."""

_Columns = Mapping[str, InstrumentedAttribute[Any]]
_OWN: Final[_Columns] = {
    "r": SampleRow.r,
    "phi": SampleRow.phi,
    "weight": SampleRow.weight,
    "size": SampleRow.size,
    "estimator": SampleRow.estimator,
    "error": SampleRow.predicted_error,
    "darkest": SampleRow.darkest,
}
_OF_PHOTO: Final[_Columns] = {"photo": PhotoRow.public_id, "pixel_pitch_um": PhotoRow.pixel_pitch_um}
_SETTINGS: Final[_Columns] = {
    "channel": SampleRow.channel,
    "aperture": PhotoRow.aperture,
    "focal_mm": PhotoRow.focal_mm,
    "focus_m": PhotoRow.focus_m,
}
_BESIDE: Final = (SampleRow.crc32, SampleRow.psf, SampleRow.spectrum, PhotoRow.width, PhotoRow.height)

COLUMNS: Final = (
    *(column.label(name) for name, column in {**_OWN, **_OF_PHOTO, **_SETTINGS}.items()),
    *_BESIDE,
)
"""What `sample_in` reads: of samples joined with their photos."""


class CorruptSampleError(LensModelError):
    """A stored kernel is not what was written."""

    code = "corrupt_sample"


def columns_of(
    sample: PsfSample, photo: PhotoRow, patch: PatchRow, diagnostics: Mapping[str, Any]
) -> dict[str, Any]:
    """Return a sample as a row; what its photo knows, its photo's row keeps."""
    entry = entry_of(sample)
    entry["estimator"] = entry["estimator"][:MAX_ESTIMATOR] or "profile"
    blob = np.ascontiguousarray(sample.kernel, dtype=DTYPE).tobytes()
    return {
        "photo_id": photo.id,
        "patch_id": patch.id,
        "channel": sample.settings.channel,
        **{column.key: entry[name] for name, column in _OWN.items()},
        "dtype": DTYPE,
        "format_version": FORMAT_VERSION,
        "crc32": zlib.crc32(blob),
        "psf": blob,
        "spectrum": None if sample.spectrum is None else sample.spectrum.to_bytes(),
        "diagnostics": dict(diagnostics),
        "created_at": now(),
    }


def sample_in(row: Row[*tuple[Any, ...]]) -> PsfSample:
    """Build the sample of a row of `COLUMNS`."""
    if zlib.crc32(row.psf) != row.crc32:
        raise CorruptSampleError(f"sample {row.id} differs from what was written: restore the database")
    settings = {name: getattr(row, name) for name in _SETTINGS}
    settings["focus_m"] = distances.read(settings["focus_m"])
    entry = {name: getattr(row, name) for name in (*_OWN, *_OF_PHOTO)}
    entry["half_diagonal_px"] = math.hypot(row.width, row.height) / 2 if row.width and row.height else None
    return sample_of(
        {**entry, "settings": settings},
        np.frombuffer(row.psf, dtype=DTYPE).reshape(row.size, row.size),
        None if row.spectrum is None else PatchSpectrum.from_bytes(row.spectrum),
    )
