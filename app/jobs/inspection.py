"""What a worker reads of a file before all else: its place, which is removed, its header, a small picture.

A child searches the file, which may be hostile, and writes another one of the same length without the place
where the photo was taken. That one gets a key of its own: blobs never change, so that a backup need not look
into them.
"""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Final

from app.jobs.answers import JobFailedError
from app.jobs.context import JobContext, Wanted
from app.jobs.task_files import CLEANED, THUMBNAIL
from app.store import LensName
from app.store.tables import PhotoRow
from lensmodel.core.names import name_key, serial_key

log = logging.getLogger(__name__)

# Fields of a header that have columns of the same name
_COLUMNS: Final = (
    *("camera_maker", "camera_model", "aperture", "focal_mm", "focus_m", "pixel_pitch_um", "orientation"),
)


def inspect(context: JobContext, photo: PhotoRow, wanted: Wanted) -> None:
    """Remove the place from the file of a photo, record its header, and store a small picture of it."""
    most = context.settings.max_megapixels
    with context.original(photo) as path:
        _remove_place(context, photo, path, wanted)
        task = context.task("inspect", photo, wanted, reads=[path], path=str(path), max_megapixels=most)
        with task as (info, folder):
            context.keep(f"{photo.folder}{THUMBNAIL}", folder / THUMBNAIL)
    metadata = info["metadata"]
    camera = (metadata["camera_maker"], metadata["camera_model"])
    context.store.photos.record_inspection(
        photo.public_id,
        LensName(**metadata["lens"]),
        width=info["width"],
        height=info["height"],
        body_key=body_key(*camera, metadata.get("body_serial")),
        **{name: metadata[name] for name in _COLUMNS},
    )


def remove_location(context: JobContext, photo: PhotoRow) -> None:
    """Remove the place from the file of a photo on which nobody works, once."""
    try:
        with context.original(photo) as path:
            _remove_place(context, photo, path, lambda: True)
    except JobFailedError:  # its file is lost, which the doctor reports
        context.store.photos.record_location(photo, "unknown")


def _remove_place(context: JobContext, photo: PhotoRow, path: Path, wanted: Wanted) -> None:
    """Have a child search a file; its copy without the place becomes that of the photo."""
    if photo.location is not None:
        return
    said, new = "unknown", {}
    try:
        with context.task("locate", photo, wanted, reads=[path], path=str(path)) as (answer, folder):
            said, cleaned = answer["location"], folder / CLEANED
            if cleaned.is_file() and cleaned.stat().st_size == photo.byte_size:
                with cleaned.open("rb") as file:
                    digest = hashlib.file_digest(file, "sha256").hexdigest()
                new = {"key": f"{photo.folder}cleaned-{digest[:16]}", "digest": digest}
                context.storage.put(new["key"], cleaned)
    except JobFailedError as error:
        log.warning("photo %s was not searched for its place: %s", photo.public_id, error.detail)
    context.store.photos.record_location(photo, said, **new)


def body_key(maker: str | None, model: str | None, serial: str | None) -> str | None:
    """Return a digest of a camera's name and serial; None without a serial."""
    if not serial:
        return None
    identity = "|".join((name_key(maker), name_key(model), serial_key(serial)))
    return hashlib.sha256(identity.encode()).hexdigest()[:16]
