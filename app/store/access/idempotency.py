"""Answers by Idempotency-Key: the same request, sent again, is not carried out again."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from app.errors import ConflictError, InvalidParameterError
from app.store.access.access_tables import IdempotencyRow
from app.store.access.owners import LOCAL, ensure_owner, now, owner_id
from app.store.database import Database, insert_new
from app.store.tables import PhotoRow

KEEP: Final = timedelta(hours=24)
"""How long an answer is kept (chosen): a client that lost it asks again within a day."""

LOST: Final = timedelta(seconds=60)
"""A request without an answer after this time will get none: its process was killed (chosen). Answers take
far less, since the body has arrived before one begins."""


@dataclass(frozen=True, slots=True)
class Given:
    """A stored answer."""

    status: int
    location: str | None
    body: dict[str, Any] | None


class IdempotencyStore:
    """The keys of all owners."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def begin(self, owner: str, key: str, request_hash: str) -> Given | None:
        """Begin a request; return its stored answer, None if it is to be carried out now."""
        with self._db.writing() as session:
            owner_key = ensure_owner(session, owner, may_be_new=owner == LOCAL)
            fresh = {
                "owner_id": owner_key,
                "key": key,
                "request_hash": request_hash,
                "created_at": now(),
            }
            old = now() - KEEP
            session.execute(
                delete(IdempotencyRow).where(
                    IdempotencyRow.owner_id == owner_key, IdempotencyRow.created_at < old
                )
            )
            if insert_new(session, IdempotencyRow, [fresh]):
                return None
            row = session.scalars(_of_key(owner_key, key).with_for_update()).one()
            if row.request_hash != request_hash:
                raise InvalidParameterError(
                    f"Idempotency-Key {key[:60]!r} came with another request before: use a new one for each"
                )
            if row.status is not None:
                return Given(row.status, row.location, row.response)
            if row.created_at > now() - LOST:
                raise ConflictError(
                    f"the request of Idempotency-Key {key[:60]!r} is being answered: ask again in a moment",
                    headers={"Retry-After": "1"},
                )
            row.created_at = now()
            return None

    def finish(self, owner: str, key: str, given: Given, resource: str | None) -> None:
        """Store an answer."""
        self._change(
            owner, key, status=given.status, location=given.location, response=given.body, resource=resource
        )

    def forget(self, owner: str, key: str) -> None:
        """Remove a request that was refused: it may be sent again."""
        with self._db.writing() as session:
            session.execute(
                delete(IdempotencyRow).where(
                    IdempotencyRow.owner_id == owner_id(session, owner),
                    IdempotencyRow.key == key,
                    IdempotencyRow.status.is_(None),
                )
            )

    def _change(self, owner: str, key: str, **values: object) -> None:
        with self._db.writing() as session:
            mine = IdempotencyRow.owner_id == owner_id(session, owner)
            session.execute(update(IdempotencyRow).where(mine, IdempotencyRow.key == key).values(**values))

    def tidy(self) -> None:
        """Delete answers older than `KEEP`."""
        with self._db.writing() as session:
            session.execute(delete(IdempotencyRow).where(IdempotencyRow.created_at < now() - KEEP))


def forget_answers(session: Session, photo: PhotoRow) -> None:
    """Delete the answers that describe a photo."""
    session.execute(
        delete(IdempotencyRow).where(
            IdempotencyRow.owner_id == photo.owner_id, IdempotencyRow.resource == photo.public_id
        )
    )


def _of_key(owner_key: int, key: str) -> Any:  # noqa: ANN401 - a select, whose type says nothing more
    return select(IdempotencyRow).where(IdempotencyRow.owner_id == owner_key, IdempotencyRow.key == key)
