"""Where photos were taken is not kept: it is overwritten in the stored file before anybody can see that."""

from __future__ import annotations

import logging
import mmap
import os
import tempfile
from pathlib import Path
from typing import Final, Literal, TypeAlias

from app.blobs.storage import Storage
from lensmodel.photo.tags.location import FoundLocation, Overwrite, find_location

log = logging.getLogger(__name__)

Location: TypeAlias = Literal["none", "removed", "unknown"]
"""What a file said of its place: nothing known, something that was removed, or more than is looked at."""

CIFF: Final = b"HEAPCCDR"
"""Canon's CRW, at byte 6: no TIFF structure, and of cameras without GPS."""


def remove(storage: Storage, key: str) -> Location:
    """Remove from a stored photo where it was taken; say what there was.

    In a folder the file is changed in place. An object of a store cannot be: it is fetched, and sent again if
    there was anything in it.
    """
    with tempfile.TemporaryDirectory() as scratch, storage.as_file(key, Path(scratch)) as path:
        found = _of_file(path)
        if found.overwrites:
            _apply(path, found.overwrites)
            if storage.folder is None:
                storage.put_file(key, path)
    if not found.complete:
        return "unknown"
    return "removed" if found.overwrites else "none"


def _of_file(path: Path) -> FoundLocation:
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as mapped:
        if mapped[6:14] == CIFF:
            return FoundLocation((), complete=True)
        return find_location(mapped)


def _apply(path: Path, overwrites: tuple[Overwrite, ...]) -> None:
    with path.open("r+b") as file:
        for one in overwrites:
            file.seek(one.start)
            file.write(one.data)
        file.flush()
        os.fsync(file.fileno())
