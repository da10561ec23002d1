"""Work of all owners, of photos or of corrections: looked up, moved from state to state, and ended.

A row is locked while it changes, and says in which state and epoch it must be: a step that runs twice, or
loses a race against a cancel, changes nothing the second time.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Generic, TypeVar

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.store.database import Repository, reads, writes
from app.store.owners import ANY_OWNER, Owner, find_owned, find_to_change, now
from app.store.tables import ENDED_BADLY, CorrectionRow, PhotoRow

Row = TypeVar("Row", PhotoRow, CorrectionRow)


class Works(Repository, Generic[Row]):
    """Rows of work. `ANY_OWNER` asks as the service itself."""

    table: ClassVar[type[Any]]
    active: ClassVar[tuple[str, ...]]  # states of work that costs computing time: first that of a new one
    unfinished: ClassVar[tuple[str, ...]]

    @reads
    def get(self, session: Session, key: str, owner: Owner) -> Row | None:
        """Return one row with the rows that belong to it, or None."""
        return find_owned(session, self.table, key, owner)

    @reads
    def is_live(self, session: Session, key: str, epoch: int) -> bool:
        """Say whether work for this epoch is still wanted: the cancel poll."""
        table = self.table
        wanted = (table.public_id == key, table.epoch == epoch, table.state.in_(self.unfinished))
        return session.scalar(select(table.id).where(*wanted)) is not None

    @writes
    def start(self, session: Session, key: str, epoch: int) -> Row | None:
        """Take up a row, a new one or one that another worker left; None if there is nothing to do."""
        row: Row | None = find_to_change(session, self.table, key, ANY_OWNER)
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
        *,
        epoch: int | None = None,
        **fields: object,
    ) -> bool:
        """Move a row from one of `states` to `state`; False where it was in none of them."""
        return self.move(session, key, ANY_OWNER, states, state, fields, epoch=epoch) is not None

    @writes
    def fail(self, session: Session, key: str, epoch: int, code: str, detail: str) -> bool:
        """End a row that is being worked on with a reason."""
        why = {"error_code": code, "error_detail": detail, "finished_at": now()}
        row = self.move(session, key, ANY_OWNER, self.active, "failed", why, epoch=epoch)
        if row is not None:
            self._ended_badly(session, row)
        return row is not None

    @writes
    def cancel(self, session: Session, key: str, owner: Owner) -> bool:
        """Cancel an unfinished row; False if it was finished already."""
        # Work that still runs sees the state and changes nothing
        row = self.move(session, key, owner, self.unfinished, "cancelled", {"finished_at": now()})
        if row is not None:
            self._ended_badly(session, row)
        return row is not None

    @writes
    def retry(self, session: Session, key: str, owner: Owner) -> bool:
        """Start a failed or cancelled row anew; False if it is in another state, or there is such another."""
        row = find_to_change(session, self.table, key, owner)
        if row is None or row.state not in ENDED_BADLY or self._has_twin(session, row):
            return False
        self.restart(session, row)
        return True

    def restart(self, session: Session, row: Row) -> None:
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
        fields: Mapping[str, object],
        *,
        epoch: int | None = None,
        attempt: int | None = None,
    ) -> Row | None:
        """Move as `set_state`; return the row, None where it was in no such state."""
        # With `epoch` only if it was not started anew since, with `attempt` only if no other worker has taken
        # it up: one that lost its lease changes nothing
        row: Row | None = find_to_change(session, self.table, key, owner)
        if row is None or row.state not in states:
            return None
        if epoch not in {None, row.epoch} or attempt not in {None, row.attempt}:
            return None
        if row.state != state:
            row.state, row.stage_at = state, now()
        for name, value in fields.items():
            setattr(row, name, value)
        return row

    def _ended_badly(self, session: Session, row: Row) -> None:
        """Clear up after a row that failed or was cancelled."""

    def _taken_over(self, session: Session, row: Row) -> None:
        """Clear up after an earlier worker, if there was one."""

    def _forget_work(self, session: Session, row: Row) -> None:
        """Forget what was done in an epoch."""

    def _has_twin(self, session: Session, row: Row) -> bool:
        """Say whether the same was asked for again."""
        del session, row
        return False
