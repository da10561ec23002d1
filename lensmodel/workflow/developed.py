"""A developed photo as the steps share it: on disk, by its settings, by its name."""

from __future__ import annotations

import dataclasses
import hashlib
import json
from pathlib import Path

import numpy as np

from lensmodel.core import codec
from lensmodel.core.errors import InvalidInputError, MetadataMissingError
from lensmodel.core.files import save_array
from lensmodel.core.types import LensSettings
from lensmodel.photo import LinearPhoto, PhotoMetadata


def save_developed(developed: LinearPhoto, folder: Path) -> None:
    """Keep a developed photo so that other processes can map it: planes.npy and photo.json.

    Neither is renamed, which a confined process may not do: the folder is of no use to others before the end.
    """
    folder.mkdir(parents=True, exist_ok=True)
    fields = {
        f.name: getattr(developed, f.name) for f in dataclasses.fields(LinearPhoto) if f.name != "planes"
    }
    (folder / "photo.json").write_text(json.dumps(codec.to_json(fields)), encoding="utf-8")
    with (folder / "planes.npy").open("wb") as file:
        save_array(file, developed.planes)


def load_developed(folder: Path) -> LinearPhoto:
    """Open what `save_developed` kept; the planes are memory-mapped, read-only."""
    try:
        planes = np.load(folder / "planes.npy", mmap_mode="r", allow_pickle=False)
        stored = json.loads((folder / "photo.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InvalidInputError(f"{folder} holds no developed photo; develop it again") from error
    return codec.from_json(LinearPhoto, {**stored, "planes": planes})


def settings_of(developed: LinearPhoto, given: LensSettings | None = None) -> LensSettings:
    """Settings of the lens as the photo's metadata say; the caller's values fill what they leave open.

    The one rule of precedence, of the library and of the command: a value that is given for a folder of
    photos is meant for those among them that do not say their own.
    """
    known, given = developed.info.metadata, given or LensSettings()
    return LensSettings(
        aperture=given.aperture if known.aperture is None else known.aperture,
        focal_mm=given.focal_mm if known.focal_mm is None else known.focal_mm,
        focus_m=given.focus_m if known.focus_m is None else known.focus_m,
    )


def require_aperture(said: PhotoMetadata, given: LensSettings | None = None) -> None:
    """Refuse a photo of unknown aperture."""
    if said.aperture is None and (given is None or given.aperture is None):
        raise MetadataMissingError("it does not say its aperture; add it, for example --aperture 2.8")


def photo_id(path: Path) -> str:
    """Name a photo by its content: the first 16 hex digits of its SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]
