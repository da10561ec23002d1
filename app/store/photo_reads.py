"""Photos as they are: queries that change nothing."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import timedelta
from typing import Final

from sqlalchemy import func, select

from app.store.access.owners import Owner, find_owned, now, owned
from app.store.database import Database
from app.store.photo_steps import WORKED_ON
from app.store.tables import (
    PHOTO_FINAL,
    PHOTO_RUNNING,
    PROFILE_FILE,
    CorrectionRow,
    LensRow,
    OwnerRow,
    PhotoRow,
)

FILE_KEPT: Final = timedelta(days=1)
"""How long the file of a photo is kept for a first correction, or for a retry after an outage (chosen):
its owner looks again within a day."""

GRACE: Final = timedelta(hours=1)
"""With `keep_photos=corrections`: how long a photo that has just calibrated its lens can still be corrected
(chosen): who sent photos to correct them asks for it in the same sitting."""


class PhotoReads:
    """Photos of all owners as they are. `ANY_OWNER` asks as the service itself."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def get(self, photo_id: str, owner: Owner) -> PhotoRow | None:
        """Return one photo, or None."""
        with self._db.reading() as session:
            return find_owned(session, PhotoRow, photo_id, owner)

    def newest_file(self) -> str | None:
        """Return the key of the file of the newest photo, or None where there is no file."""
        kept = (PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None))
        with self._db.reading() as session:
            return session.scalar(
                select(PhotoRow.blob_key).where(*kept).order_by(PhotoRow.id.desc()).limit(1)
            )

    def lens_of(self, photo: PhotoRow) -> LensRow | None:
        """Return the lens that a photo was taken with, where that is known."""
        if photo.lens_id is None:
            return None
        with self._db.reading() as session:
            return session.get(LensRow, photo.lens_id)

    def page(
        self,
        owner: str,
        *,
        before: str | None,
        limit: int,
        lens_id: str | None = None,
        state: str | None = None,
    ) -> list[PhotoRow]:
        """Return photos, newest first, that came before the photo `before`."""
        query = owned(PhotoRow, owner).where(PhotoRow.kind != PROFILE_FILE)
        query = query.order_by(PhotoRow.public_id.desc()).limit(limit)
        if before is not None:
            query = query.where(PhotoRow.public_id < before)
        if lens_id is not None:
            query = query.join(LensRow, LensRow.id == PhotoRow.lens_id).where(LensRow.public_id == lens_id)
        if state is not None:
            query = query.where(PhotoRow.state == state)
        with self._db.reading() as session:
            return list(session.scalars(query))

    def lens_ids(self, photos: Sequence[PhotoRow]) -> dict[int, str]:
        """Return the public ids of the lenses of these photos, by key."""
        keys = {photo.lens_id for photo in photos if photo.lens_id is not None}
        with self._db.reading() as session:
            rows = session.execute(select(LensRow.id, LensRow.public_id).where(LensRow.id.in_(keys)))
            return {row.id: row.public_id for row in rows}

    def load_of(self, owner: str) -> tuple[int, int, int]:
        """Return `(unfinished photos, bytes of stored files and results, all photos)` of an owner."""
        results = (
            select(func.coalesce(func.sum(CorrectionRow.result_bytes), 0))
            .join(OwnerRow, OwnerRow.id == CorrectionRow.owner_id)
            .where(OwnerRow.name == owner, CorrectionRow.state == "succeeded")
        )
        with self._db.reading() as session:
            made = session.scalar(results) or 0
            row = session.execute(
                select(
                    func.count().filter(PhotoRow.state.in_(WORKED_ON)),
                    func.coalesce(func.sum(PhotoRow.byte_size).filter(PhotoRow.file_gone_at.is_(None)), 0),
                    func.count(),
                )
                .join(OwnerRow, OwnerRow.id == PhotoRow.owner_id)
                .where(OwnerRow.name == owner, PhotoRow.deleted_at.is_(None))
            ).one()
            return int(row[0]), int(row[1]) + int(made), int(row[2])

    def to_do(self, limit: int = 100) -> list[tuple[str, int, str]]:
        """Return `(photo_id, epoch, owner)` of received photos, oldest first: the intent sweep."""
        return self._in_states(("received",), limit)

    def running(self, limit: int = 1000) -> list[tuple[str, int, str]]:
        """Return `(photo_id, epoch, owner)` of photos that a worker is busy with."""
        return self._in_states(PHOTO_RUNNING, limit)

    def _in_states(self, states: Sequence[str], limit: int) -> list[tuple[str, int, str]]:
        query = (
            select(PhotoRow.public_id, PhotoRow.epoch, OwnerRow.name)
            .join(OwnerRow, OwnerRow.id == PhotoRow.owner_id)
            .where(PhotoRow.state.in_(states), PhotoRow.deleted_at.is_(None))
            .order_by(PhotoRow.id)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [(row[0], row[1], row[2]) for row in session.execute(query)]

    def unneeded(self, policy: str, limit: int = 100) -> list[str]:
        """Return photos whose file is to be given up, as the setting `keep_photos` says.

        Never one that is being worked on, waits for its lens, or failed in an outage and may be retried.
        """
        if policy == "always":
            return []
        jobs = select(CorrectionRow.id).where(CorrectionRow.photo_id == PhotoRow.id)
        busy = jobs.where(CorrectionRow.state.in_(("queued", "running"))).exists()
        ended, day = PhotoRow.finished_at, now() - FILE_KEPT
        learned = PhotoRow.state.in_(("counted", "excluded", "cancelled")) | (
            (PhotoRow.state == "failed") & ((PhotoRow.error_code != "outage") | (ended < day))
        )
        if policy == "never":
            disposable = learned | ((PhotoRow.state == "stored") & (jobs.exists() | (ended < day)))
        else:
            disposable = learned & ~jobs.exists() & (ended < now() - GRACE)
        query = (
            select(PhotoRow.public_id)
            .where(PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None), disposable, ~busy)
            .limit(limit)
        )
        with self._db.reading() as session:
            return list(session.scalars(query))

    def read_profiles(self, limit: int = 100) -> list[str]:
        """Return the files of samples that were read, or refused, a day ago."""
        query = select(PhotoRow.public_id).where(
            PhotoRow.kind == PROFILE_FILE,
            PhotoRow.deleted_at.is_(None),
            PhotoRow.finished_at < now() - FILE_KEPT,
        )
        with self._db.reading() as session:
            return list(session.scalars(query.limit(limit)))

    def unsearched(self, limit: int = 100) -> list[PhotoRow]:
        """Return photos nobody works on whose file may still say where they were taken.

        Such are those that failed before they were searched, and files that came again.
        """
        query = (
            select(PhotoRow)
            .where(
                *(
                    PhotoRow.deleted_at.is_(None),
                    PhotoRow.file_gone_at.is_(None),
                    PhotoRow.location.is_(None),
                    PhotoRow.kind != PROFILE_FILE,
                ),
                PhotoRow.state.not_in(WORKED_ON),
            )
            .limit(limit)
        )
        with self._db.reading() as session:
            return list(session.scalars(query))

    def is_live(self, photo_id: str, epoch: int) -> bool:
        """Say whether work for this epoch of the photo is still wanted: the cancel poll."""
        with self._db.reading() as session:
            return (
                session.scalar(
                    select(PhotoRow.id).where(
                        PhotoRow.public_id == photo_id,
                        PhotoRow.epoch == epoch,
                        PhotoRow.state.not_in(PHOTO_FINAL),
                        PhotoRow.deleted_at.is_(None),
                    )
                )
                is not None
            )

    def failed_by(self, owner: str, code: str, limit: int) -> list[str]:
        """Return the photos that ended with a code, oldest first."""
        query = (
            owned(PhotoRow, owner)
            .where(PhotoRow.state == "failed", PhotoRow.error_code == code)
            .order_by(PhotoRow.id)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [row.public_id for row in session.scalars(query)]
