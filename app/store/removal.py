"""Deleting lenses: because their owner says so, or because no photo refers to them any more.

What is personal about a lens, its serial and the name that its owner gave it, is deleted too. The row stays,
emptied, because finished corrections refer to it.
"""

from __future__ import annotations

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from app.store.access.owners import Owner, find_to_change, now
from app.store.database import Database, insert_new
from app.store.tables import (
    PHOTO_RUNNING,
    CorrectionRow,
    EventRow,
    GarbageRow,
    LensRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)
from app.store.versions import STILL_WRITTEN

NO_RESULT = ("failed", "cancelled")


class RemovalStore:
    """Removes lenses of all owners. `ANY_OWNER` asks as the service itself."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def lens(self, lens_id: str, owner: Owner) -> bool:
        """Delete a lens with all that was learned of it; its photos stay and can be corrected with another.

        Work on photos that would teach it is cancelled. False if there is no such lens.
        """
        with self._db.writing() as session:
            lens = find_to_change(session, LensRow, lens_id, owner)
            if lens is None:
                return False
            taught = select(PhotoRow).where(PhotoRow.lens_id == lens.id).with_for_update()
            for photo in session.scalars(taught):
                _unlearn(session, photo)
            session.execute(
                update(CorrectionRow)
                .where(CorrectionRow.lens_id == lens.id, CorrectionRow.state.in_(("queued", "running")))
                .values(state="cancelled", finished_at=now())
            )
            session.flush()
            forget(session, lens)
            return True


def forget_if_empty(session: Session, photo: PhotoRow) -> None:
    """Detach a photo that teaches nothing from its lens; delete the lens if no other photo refers to it.

    A lens that the owner named stays as long as there is any photo of it, even a failed one.
    """
    if photo.lens_id is None or photo.relearning:
        return
    lens = session.scalar(select(LensRow).where(LensRow.id == photo.lens_id).with_for_update())
    session.flush()
    others = select(PhotoRow.id).where(
        PhotoRow.lens_id == photo.lens_id, PhotoRow.deleted_at.is_(None), PhotoRow.id != photo.id
    )
    named = lens is not None and (lens.label is not None or lens.serial_source == "user")
    if not named:
        others = others.where(PhotoRow.state.not_in(NO_RESULT) | PhotoRow.relearning.is_(True))
    keeps = named and photo.deleted_at is None
    if lens is None or lens.deleted_at is not None or keeps or session.scalar(others.limit(1)) is not None:
        return
    session.execute(update(PhotoRow).where(PhotoRow.lens_id == lens.id).values(lens_id=None))
    photo.lens_id = None
    session.flush()
    forget(session, lens)


def _unlearn(session: Session, photo: PhotoRow) -> None:
    if photo.state in PHOTO_RUNNING or photo.state == "received":
        photo.state, photo.finished_at = "cancelled", now()
    elif photo.state in {"counted", "excluded"}:
        photo.state, photo.calibrate = "stored", False
    photo.stage_at = now()
    photo.lens_id, photo.counted_at, photo.relearning = None, None, False
    photo.given = {name: value for name, value in photo.given.items() if name != "lens_id"}
    photo.patches_total = photo.patches_done = photo.patches_rejected = 0
    photo.windows, photo.windows_rejected = None, 0
    session.execute(delete(SampleRow).where(SampleRow.photo_id == photo.id))
    session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))


def forget(session: Session, lens: LensRow) -> None:
    """Empty the row of a lens that no photo belongs to any more; its reports become garbage."""
    session.execute(delete(EventRow).where(EventRow.lens_id == lens.id))
    lens.serial = lens.label = None
    lens.serial_source = "none"
    lens.identity_key = f"deleted|{lens.public_id}"
    lens.photo_count = lens.sample_count = 0
    lens.deleted_at = now()
    models = f"models/{lens.public_id}/"
    insert_new(session, GarbageRow, [{"prefix": models, "not_before": now() + STILL_WRITTEN}])
