"""What a worker reads of a file before all else: its place, which is removed, its header, a small picture.

A child searches the file, which may be hostile, and writes another one of the same length without the place
where the photo was taken. That one gets a key of its own: blobs never change, so that a backup need not look
into them.
"""

from __future__ import annotations

import hashlib
import logging
from pathlib import Path
from typing import Any, Final

from app.jobs.answers import INSPECTED, JobFailedError, checked
from app.jobs.context import JobContext, Wanted
from app.jobs.task_files import CLEANED, PLACE, THUMBNAIL
from app.store import LensName
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lensmodel.core.names import name_key, serial_key

log = logging.getLogger(__name__)

MAX_WORD: Final = 20  # bytes of what a child says of the place: a word

# Fields of a header that have columns of the same name
_COLUMNS: Final = (
    *("camera_maker", "camera_model", "aperture", "focal_mm", "focus_m", "pixel_pitch_um", "orientation"),
)


def inspect(context: JobContext, photo: PhotoRow, wanted: Wanted) -> None:
    """Read and record the header of a photo; remove its place, and store a small picture of it."""
    info = _examined(context, photo, wanted)
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


def remove_location(context: JobContext, photo: PhotoRow) -> PhotoRow:
    """Remove the place from the file of a photo, once; return the photo with the file that it has now."""
    photos = context.store.photos
    if photo.location is not None or photo.file_gone_at is not None:
        return photo
    try:
        _examined(context, photo, lambda: True)
    except JobFailedError as error:
        log.warning("photo %s was not searched for its place: %s", photo.public_id, error.detail)
    searched = photos.get(photo.public_id, ANY_OWNER) or photo
    if searched.location is None:  # its file is lost, which the doctor reports
        photos.record_location(searched, "unknown")
    return photos.get(photo.public_id, ANY_OWNER) or photo


def _examined(context: JobContext, photo: PhotoRow, wanted: Wanted) -> dict[str, Any]:
    """Have a child read a file; whatever it says of the header, keep what it says of the place."""
    limits, most = context.limits("inspect", photo), context.settings.max_megapixels
    with context.original(photo) as path, context.sandbox.folder() as folder:
        arguments = {"path": str(path), "max_megapixels": most}
        try:
            info = context.attempt(
                "inspect", arguments, folder=folder, limits=limits, wanted=wanted, reads=[path]
            )
        except JobFailedError:
            _record_place(context, photo, folder)
            raise
        _record_place(context, photo, folder)
        if (folder / THUMBNAIL).is_file():
            context.storage.put(f"{photo.folder}{THUMBNAIL}", folder / THUMBNAIL)
        return checked(INSPECTED, info)


def body_key(maker: str | None, model: str | None, serial: str | None) -> str | None:
    """Return a digest of a camera's name and serial; None without a serial."""
    if not serial:
        return None
    identity = "|".join((name_key(maker), name_key(model), serial_key(serial)))
    return hashlib.sha256(identity.encode()).hexdigest()[:16]


def _record_place(context: JobContext, photo: PhotoRow, folder: Path) -> None:
    """Record what a child has written of the place; a file without it becomes that of the photo."""
    if photo.location is not None:
        return
    word, new, cleaned = "unknown", {}, folder / CLEANED
    if (folder / PLACE).is_file() and (folder / PLACE).stat().st_size < MAX_WORD:
        said = (folder / PLACE).read_text(encoding="ascii", errors="replace")
        word = said if said in {"none", "removed"} else "unknown"
        if cleaned.is_file() and cleaned.stat().st_size == photo.byte_size:
            with cleaned.open("rb") as file:
                digest = hashlib.file_digest(file, "sha256").hexdigest()
            new = {"key": f"{photo.folder}cleaned-{digest[:16]}", "digest": digest}
            context.storage.put(new["key"], cleaned)
    context.store.photos.record_location(photo, word, **new)
