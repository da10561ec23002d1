"""Owners: their keys and sign-ins, what they store and may store, export and erasure of all of it.

A key is `lpk_<prefix>_<secret>`. The prefix finds its row and may be shown; the secret is 32 random bytes,
shown once, and only its hash is kept.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final, Literal, TypeAlias, get_args

from sqlalchemy import ColumnElement, Select, delete, func, or_, select, update
from sqlalchemy.orm import Session, joinedload

from app.store.database import Repository, new_id, reads, writes
from app.store.owners import ANY_OWNER, Owner, discard, ensure_owner, now, owner_id
from app.store.tables import (
    CORRECTION_ACTIVE,
    PHOTO_WORKED_ON,
    Base,
    CorrectionRow,
    KeyRow,
    LensRow,
    OwnerRow,
    PhotoRow,
    SessionRow,
)

Scope: TypeAlias = Literal["read", "write", "admin"]
# Each includes those before it: read, write to change data, admin to erase the account
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)
_KEY: Final = re.compile(r"lpk_([a-z0-9]{8})_([A-Za-z0-9_-]{43})", re.ASCII)
_PREFIX_SIGNS: Final = "abcdefghijkmnpqrstuvwxyz23456789"  # without those that look alike
# Photos that one transaction erases (chosen): each with some hundred samples, a few milliseconds
AT_ONCE: Final = 50
USE_PRECISION: Final = timedelta(minutes=10)  # of `last_used_at` (chosen): each update is a write


@dataclass(frozen=True, slots=True)
class Usage:
    """What an owner stores and has in work, and the limits that differ from the settings."""

    photos: int = 0
    lenses: int = 0
    corrections: int = 0
    stored_bytes: int = 0
    working_photos: int = 0
    working_corrections: int = 0
    quota_bytes: int | None = None
    quota_photos: int | None = None
    created_at: datetime | None = None


class Accounts(Repository):
    """All owners, their keys, and the browsers that signed in with them."""

    # --- keys -------------------------------------------------------------------------------------

    @writes
    def create_key(
        self,
        session: Session,
        owner: str,
        scopes: Sequence[Scope],
        *,
        label: str | None = None,
        lasts: timedelta | None = None,
        quota_bytes: int | None = None,
        quota_photos: int | None = None,
    ) -> str:
        """Return a new key of an owner, who may be new too; quotas that are given replace the present."""
        # Only its hash is stored
        owner_key = ensure_owner(session, owner)
        quotas = {"quota_bytes": quota_bytes, "quota_photos": quota_photos}
        given = {name: value for name, value in quotas.items() if value is not None}
        if given:
            session.execute(update(OwnerRow).where(OwnerRow.id == owner_key).values(**given))
        prefix = "".join(secrets.choice(_PREFIX_SIGNS) for _ in range(8))
        text = f"lpk_{prefix}_{secrets.token_urlsafe(32)}"
        session.add(
            KeyRow(
                owner_id=owner_key,
                prefix=prefix,
                key_hash=digest_of(text),
                label=label,
                scopes=" ".join(scopes),
                created_at=now(),
                expires_at=None if lasts is None else now() + lasts,
            )
        )
        return text

    @writes
    def revoke_key(self, session: Session, prefix: str) -> bool:
        """End a key and all sessions that began with it; False if there is no such key."""
        key = session.scalar(select(KeyRow).where(KeyRow.prefix == prefix).with_for_update())
        if key is not None:
            key.revoked_at = key.revoked_at or now()
            session.execute(delete(SessionRow).where(SessionRow.key_id == key.id))
        return key is not None

    @reads
    def keys(self, session: Session, owner: Owner) -> list[KeyRow]:
        """Return the keys of an owner, or of `ANY_OWNER`, with their owners, oldest first."""
        query = select(KeyRow).options(joinedload(KeyRow.owner)).order_by(KeyRow.id)
        if owner is not ANY_OWNER:
            query = query.where(KeyRow.owner.has(OwnerRow.name == owner))
        return list(session.scalars(query))

    @reads
    def has_keys(self, session: Session) -> bool:
        """Say whether a key was ever created, valid or not."""
        return session.scalar(select(KeyRow.id).limit(1)) is not None

    @reads
    def has_valid_key(self, session: Session) -> bool:
        """Say whether anybody could sign in."""
        return session.scalar(_valid().limit(1)) is not None

    @reads
    def shown(self, session: Session, digest: str) -> KeyRow | None:
        """Return the valid key of the hash of a key, or of the token of a session that has not ended."""
        key = session.scalar(_valid().where(KeyRow.key_hash == digest))
        if key is not None:
            return key
        current = (SessionRow.token_hash == digest, SessionRow.expires_at > now())
        return session.scalar(_valid().join(SessionRow, SessionRow.key_id == KeyRow.id).where(*current))

    def note_use(self, key: KeyRow) -> None:
        """Record the time at which a key is used, to within `USE_PRECISION`."""
        if key.last_used_at is None or now() - key.last_used_at >= USE_PRECISION:
            with self.database.writing() as session:
                session.execute(update(KeyRow).where(KeyRow.id == key.id).values(last_used_at=now()))

    @writes
    def sign_in(self, session: Session, key_id: int, token_hash: str, lasts: timedelta) -> None:
        """Begin a session; expired ones are deleted."""
        session.execute(delete(SessionRow).where(SessionRow.expires_at <= now()))
        times = {"created_at": now(), "expires_at": now() + lasts}
        session.add(SessionRow(token_hash=token_hash, key_id=key_id, **times))

    @writes
    def sign_out(self, session: Session, token_hash: str) -> None:
        """End a session."""
        session.execute(delete(SessionRow).where(SessionRow.token_hash == token_hash))

    # --- what they have ---------------------------------------------------------------------------

    @reads
    def usage(self, session: Session, owner: str) -> Usage:
        """Return what an owner has, and may have."""
        row = session.scalar(select(OwnerRow).where(OwnerRow.name == owner))
        if row is None:
            return Usage()
        kept = func.sum(PhotoRow.byte_size).filter(PhotoRow.file_gone_at.is_(None))
        results = CorrectionRow.result_bytes + CorrectionRow.result_shown_bytes
        made = func.sum(results).filter(CorrectionRow.state == "succeeded")
        working = func.count().filter(PhotoRow.state.in_(PHOTO_WORKED_ON))
        running = func.count().filter(CorrectionRow.state.in_(CORRECTION_ACTIVE))
        lenses = select(func.count()).where(LensRow.owner_id == row.id)
        photo, correction = (
            session.execute(select(func.count(), size, busy).where(table.owner_id == row.id)).one()
            for table, size, busy in ((PhotoRow, kept, working), (CorrectionRow, made, running))
        )
        return Usage(
            photos=photo[0],
            lenses=session.scalar(lenses) or 0,
            corrections=correction[0],
            stored_bytes=int(photo[1] or 0) + int(correction[1] or 0),
            working_photos=photo[2],
            working_corrections=correction[2],
            quota_bytes=row.quota_bytes,
            quota_photos=row.quota_photos,
            created_at=row.created_at,
        )

    def rows(self, table: type[Base], owner: str, *, at_once: int = 200) -> Iterator[dict[str, Any]]:
        """Yield the rows of an owner, a few at a time: photos, lenses, and what belongs to them."""
        cells, last = table.__table__.c, 0
        while True:
            with self.database.reading() as session:
                key = owner_id(session, owner) or 0
                query = select(table.__table__).where(cells.id > last, _of_owner(cells, key))
                page = session.execute(query.order_by(cells.id).limit(at_once)).mappings().all()
            if not page:
                return
            last = page[-1]["id"]
            yield from (dict(row) for row in page)

    # --- erasure --------------------------------------------------------------------------------

    @writes
    def begin_erasing(self, session: Session, owner: str) -> int | None:
        """Remove the name and keys of an owner whose data are to be erased; return the row's key, if any."""
        row = session.scalar(select(OwnerRow).where(OwnerRow.name == owner).with_for_update())
        if row is None:
            return None
        row.name, row.erased_at = f"erased|{new_id()}", now()
        session.execute(delete(KeyRow).where(KeyRow.owner_id == row.id))  # and by their keys the sessions
        return row.id

    @reads
    def to_erase(self, session: Session) -> list[int]:
        """Return the owners whose erasure has begun and is not complete."""
        return list(session.scalars(select(OwnerRow.id).where(OwnerRow.erased_at.is_not(None))))

    @writes
    def erase_some(self, session: Session, owner_key: int) -> list[str] | None:
        """Erase some rows of an owner; return the prefixes of their blobs. None once nothing is left."""
        if session.get(OwnerRow, owner_key, with_for_update=True) is None:
            return None
        of_owner = select(PhotoRow).where(PhotoRow.owner_id == owner_key)
        photos = list(session.scalars(of_owner.limit(AT_ONCE)))
        if photos:
            keys = [photo.id for photo in photos]
            corrections = session.scalars(select(CorrectionRow).where(CorrectionRow.photo_id.in_(keys)))
            prefixes = [row.folder for row in corrections] + [photo.folder for photo in photos]
            session.execute(delete(PhotoRow).where(PhotoRow.id.in_(keys)))  # and by their keys all of them
        else:
            lenses = list(session.scalars(select(LensRow).where(LensRow.owner_id == owner_key)))
            prefixes = [f"models/{lens.public_id}/" for lens in lenses]
            session.execute(delete(OwnerRow).where(OwnerRow.id == owner_key))  # and by its key all of them
        discard(session, *prefixes)  # once more later: a worker may be writing another blob
        return prefixes


def _of_owner(cells: Any, key: int) -> ColumnElement[bool]:  # noqa: ANN401 - the columns of any table
    """Select rows by the owner that they name, or by their photo or lens."""
    if "owner_id" in cells:
        return cells.owner_id == key
    if "photo_id" in cells:
        return cells.photo_id.in_(select(PhotoRow.id).where(PhotoRow.owner_id == key))
    return cells.lens_id.in_(select(LensRow.id).where(LensRow.owner_id == key))


def _valid() -> Select[KeyRow]:
    """Select the keys that may be used now, with their owners."""
    lasting = or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > now())
    return select(KeyRow).options(joinedload(KeyRow.owner)).where(KeyRow.revoked_at.is_(None), lasting)


def is_key(text: str) -> bool:
    """Say whether a text has the format of a key."""
    return _KEY.fullmatch(text) is not None


def digest_of(text: str) -> str:
    """Return the hash of a key or session token, which have 256 random bits: a slow one would add nothing."""
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


def covers(held: Iterable[str], wanted: Scope) -> bool:
    """Say whether scopes include one of them."""
    ranks = [SCOPES.index(scope) for scope in SCOPES if scope in set(held)]
    return bool(ranks) and max(ranks) >= SCOPES.index(wanted)
