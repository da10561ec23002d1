"""Queries and changes that only workers need."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Sequence
from typing import Final

from sqlalchemy import func, select
from sqlalchemy.orm import Session

from app.store.access.owners import owned
from app.store.database import Database
from app.store.tables import CorrectionRow, EventRow, LensRow, OwnerRow, PatchRow, PhotoRow

AT_ONCE: Final = 500
"""Ids in one query: SQLite before 3.32 takes at most 999 variables in a statement."""

_PHOTO_MARK: Final = (
    *(PhotoRow.public_id, PhotoRow.state, PhotoRow.epoch, PhotoRow.attempt, PhotoRow.lens_id),
    *(PhotoRow.patches_done, PhotoRow.patches_total, PhotoRow.error_code, PhotoRow.finished_at),
)
_CORRECTION_MARK: Final = (
    *(CorrectionRow.public_id, CorrectionRow.state, CorrectionRow.epoch, CorrectionRow.attempt),
    *(CorrectionRow.stage, CorrectionRow.progress_done, CorrectionRow.progress_total),
    *(CorrectionRow.error_code, CorrectionRow.finished_at),
)


class JobStore:
    """Rows as the workers need them."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def begin_cell(self, photo_id: str, epoch: int, cell: int) -> list[PatchRow]:
        """Take up the open patches of one cell; empty if there are none or the photo needs them no more.

        The attempt is counted before it is made; giving up a patch that kills its workers is the job
        engine's part.
        """
        query = (
            select(PatchRow)
            .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
            .where(
                PhotoRow.public_id == photo_id,
                PhotoRow.epoch == epoch,
                PhotoRow.state == "estimating",
                PatchRow.epoch == epoch,
                PatchRow.cell == cell,
                PatchRow.state.in_(("pending", "running")),
            )
            .order_by(PatchRow.idx)
        )
        with self._db.writing() as session:
            rows = list(session.scalars(query))
            for row in rows:
                row.state = "running"
                row.attempts += 1
            return rows

    def marks(self, job_ids: Sequence[str]) -> dict[str, Hashable]:
        """Return a value for each job that changes with its state; see `app.http.job_watch`."""
        marks: dict[str, Hashable] = {}
        with self._db.reading() as session:
            for first in range(0, len(job_ids), AT_ONCE):
                ids = job_ids[first : first + AT_ONCE]
                photos = select(*_PHOTO_MARK).where(
                    PhotoRow.public_id.in_(ids), PhotoRow.deleted_at.is_(None)
                )
                corrections = select(*_CORRECTION_MARK).where(CorrectionRow.public_id.in_(ids))
                for query in (photos, corrections):
                    marks |= {row[0]: tuple(row[1:]) for row in session.execute(query)}
        return marks

    def marks_of_owners(self, owners: Sequence[str], newest: int) -> dict[str, Hashable]:
        """Return a value for each owner that changes with his newest photos, lenses or corrections.

        The cost does not depend on how many pages an owner has open.
        """
        with self._db.reading() as session:
            return {owner: _mark_of_owner(session, owner, newest) for owner in owners}

    def existing_photos(self, photo_ids: Iterable[str]) -> set[str]:
        """Return which of these photos are not deleted and still have their file."""
        query = select(PhotoRow.public_id).where(
            PhotoRow.public_id.in_(list(photo_ids)),
            PhotoRow.deleted_at.is_(None),
            PhotoRow.file_gone_at.is_(None),
        )
        with self._db.reading() as session:
            return set(session.scalars(query))


def _mark_of_owner(session: Session, owner: str, newest: int) -> Hashable:
    photos = owned(PhotoRow, owner).order_by(PhotoRow.public_id.desc()).limit(newest)
    corrections = owned(CorrectionRow, owner).order_by(CorrectionRow.public_id.desc()).limit(newest)
    lenses = owned(LensRow, owner).order_by(LensRow.public_id.desc()).limit(newest)
    measured = (
        select(func.count(EventRow.id), func.count(EventRow.metrics))
        .join(LensRow, LensRow.id == EventRow.lens_id)
        .join(OwnerRow, OwnerRow.id == LensRow.owner_id)
        .where(OwnerRow.name == owner)
    )
    return tuple(
        tuple(tuple(row) for row in session.execute(query))
        for query in (
            photos.with_only_columns(*_PHOTO_MARK),
            corrections.with_only_columns(*_CORRECTION_MARK),
            lenses.with_only_columns(
                LensRow.public_id, LensRow.version, LensRow.label, LensRow.way, LensRow.answering_way
            ),
            measured,
        )
    )
