"""Shared by all transactions on photos: states, blobs, and moves from one state to another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final, Protocol

from sqlalchemy import case, delete, select, update
from sqlalchemy.orm import Session

from app.store.access.owners import now
from app.store.removal import forget_if_empty
from app.store.tables import PHOTO_RUNNING, LensRow, PatchRow, PhotoRow

WORKED_ON = ("received", *PHOTO_RUNNING)
"""States that cost computing time; a photo that waits for its owner costs space only."""

UNFINISHED = (*WORKED_ON, "needs_lens")
GIVEN_SETTINGS = {
    "aperture": "aperture",
    "focal_length_mm": "focal_mm",
    "focus_distance_m": "focus_m",
    "pixel_pitch_um": "pixel_pitch_um",
}
"""Fields that the owner may give, with the column that each fills."""

FALLBACKS: Final = "fallbacks"
"""Key in `PhotoRow.given` of the settings that came with the file: the header's own go before them. Settings
under their own names are corrections made since and go before the header."""

DESCRIPTION: Final = (
    *("lens_maker", "lens_model", "lens_serial", "lens_serial_source", "camera_maker", "camera_model"),
    *("aperture", "focal_mm", "focus_m", "pixel_pitch_um", "iso", "exposure_s", "taken_at", "lateral"),
    *("width", "height", "orientation", "location", "error_detail", "body_key"),
)
"""Columns that describe a photo; all are emptied when it is deleted."""


class CopyIdentity(Protocol):
    """Which copy of which lens, as `lensmodel.photo.LensIdentity` says it."""

    @property
    def maker(self) -> str | None:
        """Who made it."""

    @property
    def model(self) -> str | None:
        """What it is called."""

    @property
    def serial(self) -> str | None:
        """Which copy it is; None where nothing says so."""

    @property
    def serial_source(self) -> str:
        """Where the serial was found."""


def photo_folder(photo: PhotoRow) -> str:
    """Return the prefix of a photo's blobs."""
    return f"{photo.blob_key.rpartition('/')[0]}/"


def stored_settings(photo: PhotoRow) -> dict[str, Any]:
    """Return the lens settings of a photo, as tasks read them."""
    return {"aperture": photo.aperture, "focal_mm": photo.focal_mm, "focus_m": photo.focus_m}


def of_upload(fields: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the fields of an upload, after those of `before`, as `PhotoRow.given` holds them."""
    known = before or {}
    fallbacks = {name: value for name, value in fields.items() if name in GIVEN_SETTINGS}
    merged = {**known, **{name: value for name, value in fields.items() if name not in GIVEN_SETTINGS}}
    return {**merged, FALLBACKS: {**known.get(FALLBACKS, {}), **fallbacks}} if fallbacks else merged


def setting(photo: PhotoRow, field: str, header: float | None) -> float | None:
    """Return a setting by precedence: corrected by the owner, in the header, given with the file."""
    ranked = (photo.given.get(field), header, photo.given.get(FALLBACKS, {}).get(field))
    return next((value for value in ranked if value is not None), None)


def erase_description(photo: PhotoRow) -> None:
    """Erase all that the file and its owner said of a deleted photo."""
    photo.given, photo.filename, photo.sha256 = {}, "", ""
    for column in DESCRIPTION:
        setattr(photo, column, None)


def let_go(session: Session, photo_id: str) -> PhotoRow:
    """Forget a lens that only a photo without a result refers to, and with it its serial."""
    photo = session.scalars(
        select(PhotoRow).where(PhotoRow.public_id == photo_id).execution_options(populate_existing=True)
    ).one()
    forget_if_empty(session, photo)
    return photo


def drop_patches(session: Session, photo: PhotoRow) -> None:
    """Delete the patches of a photo with their samples; earlier epochs stay while they still count."""
    of_photo = [PatchRow.photo_id == photo.id, *([PatchRow.epoch == photo.epoch] if photo.relearning else [])]
    session.execute(delete(PatchRow).where(*of_photo))


def restart(session: Session, photo: PhotoRow) -> None:
    """Begin a new epoch of a photo: work of the old one that still runs is void.

    Its samples are deleted, except those that count while the photo is `relearning`.
    """
    begins = photo.relearning and photo.state == "counted"
    if not begins:  # else the patches of this epoch are those that count
        drop_patches(session, photo)
    photo.epoch += 1
    photo.state, photo.stage_at = "received", now()
    photo.error_code = photo.error_detail = photo.started_at = photo.finished_at = photo.counted_at = None
    photo.attempt = photo.patches_total = photo.patches_done = photo.patches_rejected = 0
    if not photo.relearning:  # else the same windows are rejected again
        photo.windows, photo.windows_rejected = None, 0


def change_state(
    session: Session,
    photo_id: str,
    from_states: Sequence[str],
    to: str,
    *,
    epoch: int | None = None,
    **fields: object,
) -> bool:
    """Move a photo from one of `from_states` to `to`; False where it was in none of them."""
    conditions = [
        PhotoRow.public_id == photo_id,
        PhotoRow.state.in_(from_states),
        PhotoRow.deleted_at.is_(None),
    ]
    if epoch is not None:
        conditions.append(PhotoRow.epoch == epoch)
    since = case((PhotoRow.state == to, PhotoRow.stage_at), else_=now())
    changes = {"state": to, "stage_at": since, **fields}
    statement = update(PhotoRow).where(*conditions).values(**changes)
    return session.connection().execute(statement).rowcount == 1


def widen(lens: LensRow, photo: PhotoRow) -> None:
    """Complete the maker and model of a lens from a photo."""
    lens.complete(photo.lens_maker, photo.lens_model)
