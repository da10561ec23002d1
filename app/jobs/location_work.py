"""Remove from the stored file of a photo where it was taken, before anything else is done with it.

A child searches the file, which may be hostile, and writes another one of the same length without the place.
That one gets a key of its own: blobs never change, so that a backup need not look into them.
"""

from __future__ import annotations

import hashlib
import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from app.jobs.context import SPARE_MB, JobContext, JobFailedError
from app.jobs.task_files import CLEANED
from app.sandbox.outcome import TaskLimits
from app.store.access.owners import ANY_OWNER
from app.store.photo_steps import photo_folder
from app.store.tables import PhotoRow

log = logging.getLogger(__name__)


def remove_location(context: JobContext, photo: PhotoRow, wanted: Callable[[], bool]) -> PhotoRow:
    """Remove the place from the file of a photo, once; return the photo with the file that it has now."""
    if photo.location is not None or photo.file_gone_at is not None:
        return photo
    limits = TaskLimits(memory_mb=2 * SPARE_MB, wall_s=context.settings.inspect_seconds)
    with context.original(photo) as path, context.sandbox.folder() as folder:
        try:
            found = context.attempt(
                "location", {"path": str(path)}, folder=folder, limits=limits, wanted=wanted, reads=[path]
            )
        except JobFailedError as error:
            log.warning("photo %s was not searched for its place: %s", photo.public_id, error.detail)
            found = "unknown"
        _record(context, photo, found, folder / CLEANED)
    return context.store.photos.get(photo.public_id, ANY_OWNER) or photo


def _record(context: JobContext, photo: PhotoRow, found: Any, cleaned: Path) -> None:  # noqa: ANN401 - a child's JSON
    photos = context.store.photos
    word = found if found in {"none", "removed"} else "unknown"
    if cleaned.is_file() and cleaned.stat().st_size == photo.byte_size:
        with cleaned.open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
        key = f"{photo_folder(photo)}cleaned-{digest[:16]}"
        context.storage.put_file(key, cleaned)
        photos.record_location(photo, word, key=key, digest=digest)
    else:
        photos.record_location(photo, word)
