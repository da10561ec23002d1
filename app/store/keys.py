"""Keys and sessions: their format and hashes; as rows created, looked up, ended.

A key is `lpk_<prefix>_<secret>`. The prefix finds its row and may be shown; the secret is 32 random bytes,
shown once, and only its hash is kept.
"""

from __future__ import annotations

import hashlib
import re
import secrets
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final, Literal, TypeAlias, get_args

from sqlalchemy import ColumnElement, Select, delete, or_, select, update
from sqlalchemy.orm import Session

from app.store.database import Database
from app.store.owners import ensure_owner, now
from app.store.tables import KeyRow, OwnerRow, SessionRow

Scope: TypeAlias = Literal["read", "write", "admin"]
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)
"""Each includes those before it: read, write to change data, admin to erase the account."""

_KEY: Final = re.compile(r"lpk_([a-z0-9]{8})_([A-Za-z0-9_-]{43})", re.ASCII)
_PREFIX_SIGNS: Final = "abcdefghijkmnpqrstuvwxyz23456789"
"""Characters of a prefix, without those that look alike."""

USE_PRECISION: Final = timedelta(minutes=10)
"""Precision of `last_used_at` (chosen): each update is a write."""


@dataclass(frozen=True, slots=True)
class NewKey:
    """A new key: `text` is shown once, the others are stored."""

    text: str
    prefix: str
    key_hash: str


@dataclass(frozen=True, slots=True)
class Holder:
    """A key that may be used now, and whose it is."""

    key_id: int
    owner: str
    scopes: tuple[str, ...]
    ends: datetime | None
    last_used_at: datetime | None


@dataclass(frozen=True, slots=True)
class Listed:
    """A key with the name of its owner."""

    key: KeyRow
    owner: str


class KeyStore:
    """Keys of all owners, and the browsers that signed in with them."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def create(
        self,
        owner: str,
        scopes: Sequence[Scope],
        *,
        label: str | None = None,
        lasts: timedelta | None = None,
        quota_bytes: int | None = None,
        quota_photos: int | None = None,
    ) -> NewKey:
        """Create a key for an owner, and the owner if new; quotas that are given replace the present ones."""
        key = make()
        with self._db.writing(durable=True) as session:
            owner_key = ensure_owner(session, owner)
            quotas = {"quota_bytes": quota_bytes, "quota_photos": quota_photos}
            given = {name: value for name, value in quotas.items() if value is not None}
            if given:
                session.execute(update(OwnerRow).where(OwnerRow.id == owner_key).values(**given))
            _add(session, owner_key, key, " ".join(scopes), label, lasts)
        return key

    def rotate(self, prefix: str, *, keep: timedelta) -> NewKey | None:
        """Create a key in place of another: same owner, scopes and span; the old one ends after `keep`.

        None if there is no such key, or it is no longer valid.
        """
        key = make()
        with self._db.writing(durable=True) as session:
            old = session.scalar(select(KeyRow).where(KeyRow.prefix == prefix, _valid()).with_for_update())
            if old is None:
                return None
            lasts = None if old.expires_at is None else old.expires_at - old.created_at
            _add(session, old.owner_id, key, old.scopes, old.label, lasts)
            ends = now() + keep
            if keep <= timedelta(0):
                _end(session, old)
            elif old.expires_at is None or old.expires_at > ends:
                old.expires_at = ends
        return key

    def revoke(self, prefix: str) -> bool:
        """End a key and all sessions that began with it; False if there is no such key."""
        with self._db.writing(durable=True) as session:
            key = session.scalar(select(KeyRow).where(KeyRow.prefix == prefix).with_for_update())
            if key is None:
                return False
            _end(session, key)
            return True

    def listed(self, owner: str | None = None) -> list[Listed]:
        """Return all keys, or those of one owner, oldest first."""
        query = select(KeyRow, OwnerRow.name).join(OwnerRow, OwnerRow.id == KeyRow.owner_id)
        if owner is not None:
            query = query.where(OwnerRow.name == owner)
        with self._db.reading() as session:
            return [Listed(row[0], row[1]) for row in session.execute(query.order_by(KeyRow.id))]

    def any_made(self) -> bool:
        """Say whether a key was ever created, valid or not."""
        with self._db.reading() as session:
            return session.scalar(select(KeyRow.id).limit(1)) is not None

    def any_valid(self) -> bool:
        """Say whether anybody could sign in."""
        with self._db.reading() as session:
            return session.scalar(_holders().limit(1)) is not None

    def by_hash(self, key_hash: str) -> Holder | None:
        """Return the valid key of a hash."""
        return self._holder(_holders().where(KeyRow.key_hash == key_hash))

    def by_session(self, token_hash: str) -> Holder | None:
        """Return the valid key of a browser session that has not ended."""
        query = _holders().join(SessionRow, SessionRow.key_id == KeyRow.id)
        return self._holder(query.where(SessionRow.token_hash == token_hash, SessionRow.expires_at > now()))

    def _holder(self, query: Select[KeyRow, str]) -> Holder | None:
        with self._db.reading() as session:
            row = session.execute(query).one_or_none()
        if row is None:
            return None
        key, owner = row[0], row[1]
        scopes = tuple(key.scopes.split())
        return Holder(key.id, owner, scopes, key.expires_at, key.last_used_at)

    def note_use(self, holder: Holder) -> None:
        """Record the time at which a key is used, to within `USE_PRECISION`."""
        if holder.last_used_at is not None and now() - holder.last_used_at < USE_PRECISION:
            return
        with self._db.writing() as session:
            session.execute(update(KeyRow).where(KeyRow.id == holder.key_id).values(last_used_at=now()))

    def sign_in(self, key_id: int, token_hash: str, lasts: timedelta) -> None:
        """Begin a session; expired ones are deleted."""
        with self._db.writing() as session:
            session.execute(delete(SessionRow).where(SessionRow.expires_at <= now()))
            session.add(
                SessionRow(token_hash=token_hash, key_id=key_id, created_at=now(), expires_at=now() + lasts)
            )

    def sign_out(self, token_hash: str) -> None:
        """End a session."""
        with self._db.writing() as session:
            session.execute(delete(SessionRow).where(SessionRow.token_hash == token_hash))


def _valid() -> ColumnElement[bool]:
    return KeyRow.revoked_at.is_(None) & or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > now())


def _holders() -> Select[KeyRow, str]:
    return (
        select(KeyRow, OwnerRow.name)
        .join(OwnerRow, OwnerRow.id == KeyRow.owner_id)
        .where(_valid(), OwnerRow.erased_at.is_(None))
    )


def _add(
    session: Session, owner_key: int, key: NewKey, scopes: str, label: str | None, lasts: timedelta | None
) -> None:
    session.add(
        KeyRow(
            owner_id=owner_key,
            prefix=key.prefix,
            key_hash=key.key_hash,
            label=label,
            scopes=scopes,
            created_at=now(),
            expires_at=None if lasts is None else now() + lasts,
        )
    )


def _end(session: Session, key: KeyRow) -> None:
    key.revoked_at = key.revoked_at or now()
    session.execute(delete(SessionRow).where(SessionRow.key_id == key.id))


def make() -> NewKey:
    """Generate a key."""
    prefix = "".join(secrets.choice(_PREFIX_SIGNS) for _ in range(8))
    text = f"lpk_{prefix}_{secrets.token_urlsafe(32)}"
    return NewKey(text, prefix, digest_of(text))


def prefix_of(text: str) -> str | None:
    """Return the prefix of a text in the format of a key, None of any other."""
    match = _KEY.fullmatch(text)
    return None if match is None else match[1]


def digest_of(text: str) -> str:
    """Return the hash of a key or session token, which have 256 random bits: a slow one would add nothing."""
    return hashlib.sha256(text.encode("utf-8", "replace")).hexdigest()


def covers(held: Iterable[str], wanted: Scope) -> bool:
    """Say whether scopes include one of them."""
    ranks = [SCOPES.index(scope) for scope in SCOPES if scope in set(held)]
    return bool(ranks) and max(ranks) >= SCOPES.index(wanted)
