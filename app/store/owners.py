"""Whose rows these are, and how work moves: every query of a user's data goes through here.

A row is locked while it changes, and says in which state and epoch it must be: a step that runs twice, or
loses a race against a cancel, changes nothing the second time.
"""

from __future__ import annotations

from collections.abc import Sequence
from datetime import UTC, datetime, timedelta
from enum import Enum
from typing import Any, ClassVar, Final, Generic, TypeAlias, TypeVar

from sqlalchemy import ColumnElement, Select, select
from sqlalchemy.orm import Session, joinedload
from sqlalchemy.orm.interfaces import ORMOption

from app.errors import ServiceError
from app.store.database import Repository, insert_new, reads, writes
from app.store.tables import ENDED_BADLY, Base, CorrectionRow, GarbageRow, LensRow, OwnerRow, PhotoRow

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
W = TypeVar("W", PhotoRow, CorrectionRow)

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
    """Return the key of an owner, created if new, with all that is the owner's locked."""
    if may_be_new:
        insert_new(session, OwnerRow, [{"name": name, "created_at": now()}])
    key = _lock(session, OwnerRow.name == name)
    if key is None:
        raise ServiceError("this account was erased: nothing is kept of it", code="not_signed_in")
    return key


def _lock(session: Session, which: ColumnElement[bool]) -> int | None:
    """Lock all that is an owner's until the transaction ends; return the owner's key."""
    # What is read still holds when it is changed, and no two changes wait for each other: none locks a row
    # of an owner before this one. SQLite has one writer at a time anyway.
    return session.scalar(select(OwnerRow.id).where(which).with_for_update(key_share=True))


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


def find_owned(session: Session, table: type[Row], public_id: str, owner: Owner) -> Row | None:
    """Return one row by its public id if it is this owner's."""
    query = owned(table, owner).where(table.public_id == public_id)
    return session.scalar(query) if is_id(public_id) else None


def find_to_change(session: Session, table: type[Row], public_id: str, owner: Owner) -> Row | None:
    """Return as `find_owned`, with all that is its owner's locked."""
    if is_id(public_id):
        of_row = OwnerRow.id == select(table.owner_id).where(table.public_id == public_id).scalar_subquery()
        _lock(session, of_row if owner is ANY_OWNER else of_row & (OwnerRow.name == owner))
    return find_owned(session, table, public_id, owner)


def discard(session: Session, *prefixes: str, after: timedelta = LATE) -> None:
    """Have blobs deleted after a while: all keys with one of the prefixes, or a single key."""
    due = now() + after
    insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": due} for prefix in prefixes])


def is_id(text: str) -> bool:
    """Say whether a text can be an id of ours; PostgreSQL refuses some others with an error."""
    return text.isascii() and text.isalnum()


class Works(Repository, Generic[W]):
    """Rows of work. `ANY_OWNER` asks as the service itself."""

    table: ClassVar[type[Any]]
    active: ClassVar[tuple[str, ...]]  # states of work that costs computing time: first that of a new one
    unfinished: ClassVar[tuple[str, ...]]

    @reads
    def get(self, session: Session, key: str, owner: Owner) -> W | None:
        """Return one row with the rows that belong to it, or None."""
        return find_owned(session, self.table, key, owner)

    @reads
    def is_live(self, session: Session, key: str, epoch: int) -> bool:
        """Say whether work for this epoch is still wanted: the cancel poll."""
        table = self.table
        wanted = (table.public_id == key, table.epoch == epoch, table.state.in_(self.unfinished))
        return session.scalar(select(table.id).where(*wanted)) is not None

    @writes
    def start(self, session: Session, key: str, epoch: int) -> W | None:
        """Take up a row, a new one or one that another worker left; None if there is nothing to do."""
        row: W | None = find_to_change(session, self.table, key, ANY_OWNER)
        if row is None or row.epoch != epoch or row.state not in self.active:
            return None
        self._taken_over(session, row)
        if row.state == self.active[0]:
            row.state, row.stage_at = self.active[1], now()
        row.started_at = now()
        row.attempt += 1
        return row

    @writes
    def set_state(
        self,
        session: Session,
        /,
        key: str,
        states: Sequence[str],
        state: str,
        **which: Any,  # noqa: ANN401 - as of `move`
    ) -> bool:
        """Move a row from one of `states` to `state`; False where it was in none of them."""
        return self.move(session, key, ANY_OWNER, states, state, **which) is not None

    def fail(self, key: str, epoch: int, code: str, detail: str) -> bool:
        """End a row that is being worked on with a reason."""
        why = {"error_code": code, "error_detail": detail}
        return self.set_state(key, self.active, "failed", epoch=epoch, **why)

    @writes
    def cancel(self, session: Session, key: str, owner: Owner) -> bool:
        """Cancel an unfinished row; False if it was finished already."""
        # Work that still runs sees the state and changes nothing
        return self.move(session, key, owner, self.unfinished, "cancelled") is not None

    @writes
    def retry(self, session: Session, key: str, owner: Owner) -> bool:
        """Start a failed or cancelled row anew; False if it is in another state, or there is such another."""
        row = find_to_change(session, self.table, key, owner)
        if row is None or row.state not in ENDED_BADLY or self._has_twin(session, row):
            return False
        self.restart(session, row)
        return True

    def restart(self, session: Session, row: W) -> None:
        """Begin a new epoch: work of the old one that still runs is void."""
        self._forget_work(session, row)
        row.epoch += 1
        row.attempt = 0
        row.state, row.stage_at = self.active[0], now()
        row.error_code = row.error_detail = row.started_at = row.finished_at = None

    def move(
        self,
        session: Session,
        key: str,
        owner: Owner,
        states: Sequence[str],
        state: str,
        *,
        epoch: int | None = None,
        attempt: int | None = None,
        **fields: object,
    ) -> W | None:
        """Move as `set_state`; return the row, None where it was in no such state."""
        # With `epoch` only if it was not started anew since, with `attempt` only if no other worker has taken
        # it up: one that lost its lease changes nothing
        row: W | None = find_to_change(session, self.table, key, owner)
        if row is None or row.state not in states:
            return None
        if epoch not in {None, row.epoch} or attempt not in {None, row.attempt}:
            return None
        if row.state != state:
            row.state, row.stage_at = state, now()
            row.finished_at = None if state in self.unfinished else now()
        for name, value in fields.items():
            setattr(row, name, value)
        if state in ENDED_BADLY:
            self._ended_badly(session, row)
        return row

    def _clear_up(self, session: Session, row: W) -> None:
        """Clear up before a row is taken up again, before it begins anew, or after it ended badly."""

    _taken_over = _forget_work = _ended_badly = _clear_up

    def _has_twin(self, session: Session, row: W) -> bool:
        """Say whether the same was asked for again."""
        del session, row
        return False
