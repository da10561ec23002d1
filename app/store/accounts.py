"""Owners as a whole: quotas, what they store, export and erasure of all of it."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

from sqlalchemy import ColumnElement, Table, delete, func, select, update
from sqlalchemy.orm import Session

from app.store.database import Database, insert_new, new_id
from app.store.owners import LATE, now, owner_id
from app.store.photos import photo_folder
from app.store.tables import (
    Base,
    CorrectionRow,
    EventRow,
    GarbageRow,
    KeyRow,
    LensRow,
    OwnerRow,
    PatchRow,
    PhotoRow,
    SampleRow,
    SessionRow,
)

AT_ONCE: Final = 50
"""Photos that one transaction erases (chosen): each with some hundred samples, a few milliseconds."""

REMEMBERED: Final = timedelta(days=1)
"""How long the emptied row of what was deleted is kept (chosen): no work that refers to it runs so long."""


@dataclass(frozen=True, slots=True)
class Quota:
    """Limits of an owner that differ from the settings; None where they do not."""

    stored_bytes: int | None = None
    photos: int | None = None


@dataclass(frozen=True, slots=True)
class Holdings:
    """How much an owner stores."""

    photos: int
    stored_bytes: int
    lenses: int
    corrections: int
    created_at: Any


class AccountStore:
    """All owners."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def quota_of(self, owner: str) -> Quota:
        """Return the limits of an owner."""
        query = select(OwnerRow.quota_bytes, OwnerRow.quota_photos).where(OwnerRow.name == owner)
        with self._db.reading() as session:
            row = session.execute(query).one_or_none()
            return Quota() if row is None else Quota(row[0], row[1])

    def holdings_of(self, owner: str) -> Holdings:
        """Return how much an owner stores."""
        with self._db.reading() as session:
            row = session.scalar(select(OwnerRow).where(OwnerRow.name == owner))
            if row is None:
                return Holdings(0, 0, 0, 0, None)
            photo = (PhotoRow.owner_id == row.id) & PhotoRow.deleted_at.is_(None)
            kept = func.sum(PhotoRow.byte_size).filter(PhotoRow.file_gone_at.is_(None))
            photos, stored = session.execute(
                select(func.count(), func.coalesce(kept, 0)).select_from(PhotoRow).where(photo)
            ).one()
            lens = (LensRow.owner_id == row.id) & LensRow.deleted_at.is_(None)
            made = session.scalar(
                select(func.coalesce(func.sum(CorrectionRow.result_bytes), 0)).where(
                    CorrectionRow.owner_id == row.id, CorrectionRow.state == "succeeded"
                )
            )
            return Holdings(
                photos,
                int(stored) + int(made or 0),
                _count(session, LensRow, lens),
                _count(session, CorrectionRow, CorrectionRow.owner_id == row.id),
                row.created_at,
            )

    # --- export ---------------------------------------------------------------------------------

    def rows(self, table: type[Base], owner: str, *, at_once: int = 200) -> Iterator[dict[str, Any]]:
        """Yield the rows of an owner, a few at a time: photos, lenses, and what belongs to them."""
        cells: Table = table.__table__  # type: ignore[assignment]  # of a declared table it is one
        last = 0
        while True:
            with self._db.reading() as session:
                key = owner_id(session, owner)
                query = select(cells).where(cells.c.id > last, _of_owner(table, key or 0))
                page = session.execute(query.order_by(cells.c.id).limit(at_once)).mappings().all()
            if not page:
                return
            last = page[-1]["id"]
            yield from (dict(row) for row in page)

    # --- erasure --------------------------------------------------------------------------------

    def begin_erasing(self, owner: str) -> int | None:
        """Remove the name and keys of an owner whose data are to be erased; return the row's key.

        None if there is no such owner.
        """
        with self._db.writing(durable=True) as session:
            row = session.scalar(select(OwnerRow).where(OwnerRow.name == owner).with_for_update())
            if row is None:
                return None
            row.name, row.erased_at = f"erased|{new_id()}", now()
            keys = select(KeyRow.id).where(KeyRow.owner_id == row.id)
            session.execute(delete(SessionRow).where(SessionRow.key_id.in_(keys)))
            session.execute(
                update(KeyRow)
                .where(KeyRow.owner_id == row.id, KeyRow.revoked_at.is_(None))
                .values(revoked_at=now())
            )
            return row.id

    def to_erase(self) -> list[int]:
        """Return the owners whose erasure has begun and is not complete."""
        with self._db.reading() as session:
            return list(session.scalars(select(OwnerRow.id).where(OwnerRow.erased_at.is_not(None))))

    def erase_some(self, owner_key: int) -> list[str] | None:
        """Erase some rows of an owner; return the prefixes of their blobs. None once nothing is left."""
        with self._db.writing() as session:
            photos = list(
                session.scalars(
                    select(PhotoRow).where(PhotoRow.owner_id == owner_key).limit(AT_ONCE).with_for_update()
                )
            )
            if photos:
                return _erase_photos(session, photos)
            if session.get(OwnerRow, owner_key) is None:
                return None
            lenses = list(session.scalars(select(LensRow).where(LensRow.owner_id == owner_key)))
            keys = [lens.id for lens in lenses]
            session.execute(delete(CorrectionRow).where(CorrectionRow.owner_id == owner_key))
            session.execute(delete(EventRow).where(EventRow.lens_id.in_(keys)))
            session.execute(delete(LensRow).where(LensRow.owner_id == owner_key))
            session.execute(delete(KeyRow).where(KeyRow.owner_id == owner_key))
            session.execute(delete(OwnerRow).where(OwnerRow.id == owner_key))
            return _garbage(session, [f"models/{lens.public_id}/" for lens in lenses])

    def purge(self) -> None:
        """Remove the emptied rows of what was deleted a day ago."""
        old = now() - REMEMBERED
        with self._db.writing() as session:
            session.execute(delete(PhotoRow).where(PhotoRow.deleted_at < old))
            named = select(CorrectionRow.lens_id).union(
                select(PhotoRow.lens_id).where(PhotoRow.lens_id.is_not(None)),
                select(SampleRow.lens_id).where(SampleRow.lens_id.is_not(None)),
                select(EventRow.lens_id),
            )
            session.execute(delete(LensRow).where(LensRow.deleted_at < old, LensRow.id.not_in(named)))


def _count(session: Session, table: type[Base], condition: ColumnElement[bool]) -> int:
    return session.scalar(select(func.count()).select_from(table).where(condition)) or 0


def _of_owner(table: type[Base], key: int) -> ColumnElement[bool]:
    photos = select(PhotoRow.id).where(PhotoRow.owner_id == key, PhotoRow.deleted_at.is_(None))
    lenses = select(LensRow.id).where(LensRow.owner_id == key, LensRow.deleted_at.is_(None))
    conditions: dict[type[Base], ColumnElement[bool]] = {
        PhotoRow: PhotoRow.id.in_(photos),
        LensRow: LensRow.id.in_(lenses),
        CorrectionRow: CorrectionRow.owner_id == key,
        KeyRow: KeyRow.owner_id == key,
        PatchRow: PatchRow.photo_id.in_(photos),
        SampleRow: SampleRow.photo_id.in_(photos),
        EventRow: EventRow.lens_id.in_(lenses),
    }
    return conditions[table]


def _erase_photos(session: Session, photos: list[PhotoRow]) -> list[str]:
    keys = [photo.id for photo in photos]
    corrections = session.scalars(select(CorrectionRow.public_id).where(CorrectionRow.photo_id.in_(keys)))
    prefixes = [f"corrections/{key}/" for key in corrections]
    prefixes += [photo_folder(photo) for photo in photos]
    session.execute(delete(CorrectionRow).where(CorrectionRow.photo_id.in_(keys)))
    session.execute(delete(SampleRow).where(SampleRow.photo_id.in_(keys)))
    session.execute(delete(PatchRow).where(PatchRow.photo_id.in_(keys)))
    session.execute(delete(PhotoRow).where(PhotoRow.id.in_(keys)))
    return _garbage(session, prefixes)


def _garbage(session: Session, prefixes: list[str]) -> list[str]:
    """Have blobs deleted once more later: a worker may be writing another one."""
    due = now() + LATE
    insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": due} for prefix in prefixes])
    return prefixes
