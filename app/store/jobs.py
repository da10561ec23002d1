"""Queries and changes that only workers need."""

from __future__ import annotations

from collections.abc import Iterable

from sqlalchemy import select

from app.store.database import Database
from app.store.tables import PatchRow, PhotoRow


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

    def existing_photos(self, photo_ids: Iterable[str]) -> set[str]:
        """Return which of these photos are not deleted and still have their file."""
        query = select(PhotoRow.public_id).where(
            PhotoRow.public_id.in_(list(photo_ids)),
            PhotoRow.deleted_at.is_(None),
            PhotoRow.file_gone_at.is_(None),
        )
        with self._db.reading() as session:
            return set(session.scalars(query))
