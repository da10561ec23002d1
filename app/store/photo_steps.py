"""What transactions about photos share: their states, their blobs, the way from state to state."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import Any, Final, Protocol

from sqlalchemy import case, delete, select, update
from sqlalchemy.orm import Session

from app.store.access.owners import now
from app.store.database import insert_new
from app.store.removal import forget_if_empty, statistics_of
from app.store.tables import PHOTO_RUNNING, GarbageRow, LensRow, PatchRow, PhotoRow

WORKED_ON = ("received", *PHOTO_RUNNING)
"""What takes the service's time; a photo that waits for its owner's word takes room only."""

UNFINISHED = (*WORKED_ON, "needs_lens")
GIVEN_SETTINGS = {
    "aperture": "aperture",
    "focal_length_mm": "focal_mm",
    "focus_distance_m": "focus_m",
    "pixel_pitch_um": "pixel_pitch_um",
}
"""Fields that the owner may give, by the column that they fill."""


SAID: Final = (
    *("lens_maker", "lens_model", "lens_serial", "lens_serial_source", "camera_maker", "camera_model"),
    *("aperture", "focal_mm", "focus_m", "pixel_pitch_um", "iso", "exposure_s", "taken_at", "lateral"),
    *("width", "height", "orientation", "location", "error_detail", "body_key"),
)
"""Columns of what is known of a photo."""


class Identity(Protocol):
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


LATE = timedelta(minutes=10)
"""Blobs of what is deleted are deleted again after this time: a worker may have written one more."""


def folder_of(photo: PhotoRow) -> str:
    """Return the prefix of a photo's blobs."""
    return f"{photo.blob_key.rpartition('/')[0]}/"


def settings_of(photo: PhotoRow) -> dict[str, Any]:
    """Return how the lens was set, as tasks read it."""
    return {"aperture": photo.aperture, "focal_mm": photo.focal_mm, "focus_m": photo.focus_m}


def empty(photo: PhotoRow) -> None:
    """Take from a deleted photo all that the file and its owner said."""
    photo.given, photo.filename, photo.sha256 = {}, "", ""
    for column in SAID:
        setattr(photo, column, None)


def let_go(session: Session, photo_id: str) -> PhotoRow:
    """Forget the lens that only a photo without a result speaks of: its serial is nobody's business now."""
    photo = session.scalars(
        select(PhotoRow).where(PhotoRow.public_id == photo_id).execution_options(populate_existing=True)
    ).one()
    forget_if_empty(session, photo)
    return photo


def drop_patches(session: Session, photo: PhotoRow) -> None:
    """Forget the patches of an epoch with their samples.

    With those of earlier epochs, unless they count still.
    """
    of_photo = [PatchRow.photo_id == photo.id, *([PatchRow.epoch == photo.epoch] if photo.relearning else [])]
    session.execute(delete(PatchRow).where(*of_photo))
    insert_new(session, GarbageRow, [{"prefix": statistics_of(photo), "not_before": now() + LATE}])


def restart(session: Session, photo: PhotoRow) -> None:
    """Begin a new epoch of a photo: work of the old one, if any still runs, is void.

    Its samples go, but for those that count while the photo is `relearning`.
    """
    begins = photo.relearning and photo.state == "counted"
    if not begins:  # the patches of this epoch are those that count
        drop_patches(session, photo)
    photo.epoch += 1
    photo.state, photo.stage_at = "received", now()
    photo.error_code = photo.error_detail = photo.started_at = photo.finished_at = photo.counted_at = None
    photo.attempt = photo.patches_total = photo.patches_done = photo.patches_rejected = 0
    if not photo.relearning:  # else the same ones are found again
        photo.windows, photo.windows_rejected = None, 0


def move(
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
    """Take over what a photo knows of its lens and others did not."""
    lens.complete(photo.lens_maker, photo.lens_model)
