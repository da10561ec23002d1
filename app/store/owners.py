"""Whose rows these are: every query of a user's data goes through here."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Final, TypeAlias, TypeVar

from sqlalchemy import ColumnElement, Select, select
from sqlalchemy.orm import Session, joinedload
from sqlalchemy.orm.interfaces import ORMOption

from app.errors import ServiceError
from app.store.database import insert_new
from app.store.tables import Base, CorrectionRow, GarbageRow, LensRow, OwnerRow, PhotoRow

LOCAL: Final = "local"  # the one owner in a service without sign-in
# Deleted blobs are deleted once more after this time (chosen): a worker may have written another one
LATE: Final = timedelta(minutes=10)


class AnyOwner(Enum):
    """Stands for all owners: workers and the operator's commands ask so, no request ever does."""

    ANY = "any"


ANY_OWNER: Final = AnyOwner.ANY
# Whose rows are asked for; there is no default, so that nobody asks for everybody's by leaving it out
Owner: TypeAlias = str | AnyOwner
Row = TypeVar("Row", PhotoRow, LensRow, CorrectionRow)

# What is read with a row: what nearly all who ask for it need of it
_WITH: Final[dict[type[Base], tuple[ORMOption, ...]]] = {
    PhotoRow: (joinedload(PhotoRow.lens),),
    LensRow: (),
    CorrectionRow: (joinedload(CorrectionRow.photo), joinedload(CorrectionRow.lens)),
}


def now() -> datetime:
    """Return the present, in UTC."""
    return datetime.now(UTC)


def owner_id(session: Session, name: str) -> int | None:
    """Return the key of an owner, None if there is no such owner."""
    return session.scalar(select(OwnerRow.id).where(OwnerRow.name == name))


def ensure_owner(session: Session, name: str, *, may_be_new: bool = True) -> int:
    """Return the key of an owner, created if new."""
    key = owner_id(session, name)
    if key is None:
        if not may_be_new:
            raise ServiceError("this account was erased: nothing is kept of it", code="not_signed_in")
        insert_new(session, OwnerRow, [{"name": name, "created_at": now()}])
        key = owner_id(session, name)
    assert key is not None
    return key


def owned(table: type[Row], owner: Owner) -> Select[Row]:
    """Select the rows of one owner, or of `ANY_OWNER`."""
    query: Select[Row] = select(table).options(*_WITH[table])
    if owner is not ANY_OWNER:
        query = query.join(OwnerRow, OwnerRow.id == table.owner_id).where(OwnerRow.name == owner)
    return query


def page_of(
    session: Session,
    table: type[Row],
    owner: Owner,
    *conditions: ColumnElement[bool],
    before: str | None,
    limit: int,
) -> list[Row]:
    """Return rows, newest first, that came before the row `before`."""
    query = owned(table, owner).where(*conditions).order_by(table.public_id.desc()).limit(limit)
    return list(session.scalars(query if before is None else query.where(table.public_id < before)))


def find_owned(
    session: Session, table: type[Row], public_id: str, owner: Owner, *, to_change: bool = False
) -> Row | None:
    """Return one row by its public id if it is this owner's."""
    # To be changed it is locked until the transaction ends: what is read still holds when it is changed.
    # SQLite has one writer at a time anyway.
    if not is_id(public_id):
        return None
    query = owned(table, owner).where(table.public_id == public_id)
    return session.scalar(query.with_for_update(of=table) if to_change else query)


def find_to_change(session: Session, table: type[Row], public_id: str, owner: Owner) -> Row | None:
    """Return as `find_owned`, locked."""
    return find_owned(session, table, public_id, owner, to_change=True)


def discard(session: Session, *prefixes: str, after: timedelta = LATE) -> None:
    """Have blobs deleted after a while: all keys with one of the prefixes, or a single key."""
    due = now() + after
    insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": due} for prefix in prefixes])


def is_id(text: str) -> bool:
    """Say whether a text can be an id of ours; PostgreSQL refuses some others with an error."""
    return text.isascii() and text.isalnum()
