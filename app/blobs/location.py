"""Remove the location of a photo: it is overwritten in the stored file before anybody can read it."""

from __future__ import annotations

import logging
import mmap
import os
import tempfile
from pathlib import Path
from typing import Final, Literal, TypeAlias

from app.blobs.storage import Storage
from lensmodel.photo.tags.location import LocationTraces, Overwrite, find_location

log = logging.getLogger(__name__)

Location: TypeAlias = Literal["none", "removed", "unknown"]
"""Whether a file had a location: none, one that was removed, or unknown where it was not searched wholly."""

CIFF: Final = b"HEAPCCDR"
"""Signature of Canon's CRW at byte 6: not TIFF, and from cameras without GPS."""


def remove(storage: Storage, key: str) -> Location:
    """Remove the location from a stored photo; return whether it had one.

    In a folder the file is changed in place. An object of an object store cannot be: it is fetched, and
    stored again if it had a location.
    """
    with tempfile.TemporaryDirectory() as scratch, storage.as_file(key, Path(scratch)) as path:
        location = _of_file(path)
        if location.overwrites:
            _apply(path, location.overwrites)
            if storage.folder is None:
                storage.put_file(key, path)
    if not location.complete:
        return "unknown"
    return "removed" if location.overwrites else "none"


def _of_file(path: Path) -> LocationTraces:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        if mapped[6:14] == CIFF:
            return LocationTraces((), complete=True)
        return find_location(mapped)


def _apply(path: Path, overwrites: tuple[Overwrite, ...]) -> None:
    with path.open("r+b") as file:
        for overwrite in overwrites:
            file.seek(overwrite.start)
            file.write(overwrite.data)
        file.flush()
        os.fsync(file.fileno())
