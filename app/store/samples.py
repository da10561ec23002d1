"""Samples as the model reads them: library values, in the order in which they joined."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy import bindparam, select

from app.store.access.owners import is_id
from app.store.database import Database
from app.store.sample_rows import COLUMNS, sample_in
from app.store.tables import LensRow, OwnerRow, PatchRow, PhotoRow, SampleRow
from lensmodel.core.psf import PsfSample

_STATE = select(LensRow.version, LensRow.rebuild_epoch, LensRow.answering_way).where(
    LensRow.public_id == bindparam("lens"), LensRow.deleted_at.is_(None)
)
_KNOWN = (
    select(LensRow.version, LensRow.rebuild_epoch, LensRow.answering_way)
    .join(OwnerRow, OwnerRow.id == LensRow.owner_id)
    .where(
        LensRow.public_id == bindparam("lens"),
        LensRow.deleted_at.is_(None),
        OwnerRow.name == bindparam("owner"),
    )
)


@dataclass(frozen=True, slots=True)
class LensState:
    """Version of a lens: shows whether a fitted model is up to date, and in which way it was learned."""

    version: int
    rebuild_epoch: int
    way: str = "default"


@dataclass(frozen=True, slots=True, eq=False)
class StoredSample:
    """A sample with its key and the version at which it joined."""

    id: int
    version_added: int
    sample: PsfSample


class SampleStore:
    """The samples that count."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def state_of(self, lens_id: str) -> LensState | None:
        """Return the version of a lens by one read through its key; None if there is no such lens."""
        with self._db.reader.connect() as connection:
            row = connection.execute(_STATE, {"lens": lens_id}).one_or_none()
            return None if row is None else LensState(row[0], row[1], row[2])

    def known_of(self, lens_id: str, owner: str) -> LensState | None:
        """Return `state_of` a lens of an owner by one read; None if the owner has no such lens."""
        if not is_id(lens_id):
            return None
        with (
            self._db.reader.connect() as connection
        ):  # no session, which costs time: part of every request that a cached model answers
            row = connection.execute(_KNOWN, {"lens": lens_id, "owner": owner}).one_or_none()
            return None if row is None else LensState(row[0], row[1], row[2])

    def of_lens(
        self, lens_id: str, *, after_version: int = 0, up_to_version: int | None = None
    ) -> tuple[LensState, list[StoredSample]]:
        """Return the state of a lens and its samples that joined after a version.

        Both are of one moment. Versions grow under the lens's row lock, so no sample of a
        version that was seen can turn up later.
        """
        query = (
            select(SampleRow.id, SampleRow.version_added, *COLUMNS)
            .join(PhotoRow, PhotoRow.id == SampleRow.photo_id)
            .join(PatchRow, PatchRow.id == SampleRow.patch_id)
            .join(LensRow, LensRow.id == SampleRow.lens_id)
            .where(LensRow.public_id == lens_id, SampleRow.version_added > after_version)
            .order_by(SampleRow.version_added, SampleRow.id)
        )
        if up_to_version is not None:
            query = query.where(SampleRow.version_added <= up_to_version)
        with self._db.reading() as session:
            state = session.execute(
                select(LensRow.version, LensRow.rebuild_epoch, LensRow.answering_way).where(
                    LensRow.public_id == lens_id
                )
            ).one_or_none()
            if state is None:
                return LensState(0, 0), []
            stored = [
                StoredSample(row.id, row.version_added, sample_in(row)) for row in session.execute(query)
            ]
            return LensState(state[0], state[1], state[2]), stored
