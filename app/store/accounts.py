"""Owners: their keys and sign-ins, their quotas, what they store, export and erasure of all of it.

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

from sqlalchemy import ColumnElement, Select, Table, delete, func, or_, select, update
from sqlalchemy.orm import Session, joinedload

from app.store.database import Repository, new_id, reads, writes, writes_durably
from app.store.owners import ANY_OWNER, Owner, discard, ensure_owner, now, owner_id
from app.store.tables import (
    Base,
    CorrectionRow,
    EventRow,
    KeyRow,
    LensRow,
    OwnerRow,
    PatchRow,
    PhotoRow,
    SampleRow,
    SessionRow,
)

Scope: TypeAlias = Literal["read", "write", "admin"]
SCOPES: Final[tuple[Scope, ...]] = get_args(Scope)
"""Each includes those before it: read, write to change data, admin to erase the account."""

_KEY: Final = re.compile(r"lpk_([a-z0-9]{8})_([A-Za-z0-9_-]{43})", re.ASCII)
_PREFIX_SIGNS: Final = "abcdefghijkmnpqrstuvwxyz23456789"
"""Characters of a prefix, without those that look alike."""

AT_ONCE: Final = 50
"""Photos that one transaction erases (chosen): each with some hundred samples, a few milliseconds."""

REMEMBERED: Final = timedelta(days=1)
"""How long the emptied row of what was deleted is kept (chosen): no work that refers to it runs so long."""

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


class Accounts(Repository):
    """All owners, their keys, and the browsers that signed in with them."""

    # --- keys -------------------------------------------------------------------------------------

    @writes_durably
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
    ) -> NewKey:
        """Create a key for an owner, and the owner if new; quotas that are given replace the present ones."""
        key, owner_key = make(), ensure_owner(session, owner)
        quotas = {"quota_bytes": quota_bytes, "quota_photos": quota_photos}
        given = {name: value for name, value in quotas.items() if value is not None}
        if given:
            session.execute(update(OwnerRow).where(OwnerRow.id == owner_key).values(**given))
        _add(session, owner_key, key, " ".join(scopes), label, lasts)
        return key

    @writes_durably
    def rotate_key(self, session: Session, prefix: str, *, keep: timedelta) -> NewKey | None:
        """Create a key in place of another: same owner, scopes and span; the old one ends after `keep`.

        None if there is no such key, or it is no longer valid.
        """
        old = session.scalar(select(KeyRow).where(KeyRow.prefix == prefix, _valid()).with_for_update())
        if old is None:
            return None
        key, ends = make(), now() + keep
        lasts = None if old.expires_at is None else old.expires_at - old.created_at
        _add(session, old.owner_id, key, old.scopes, old.label, lasts)
        if keep <= timedelta(0):
            _end(session, old)
        elif old.expires_at is None or old.expires_at > ends:
            old.expires_at = ends
        return key

    @writes_durably
    def revoke_key(self, session: Session, prefix: str) -> bool:
        """End a key and all sessions that began with it; False if there is no such key."""
        key = session.scalar(select(KeyRow).where(KeyRow.prefix == prefix).with_for_update())
        if key is not None:
            _end(session, key)
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
        return session.scalar(_holders().limit(1)) is not None

    @reads
    def by_hash(self, session: Session, key_hash: str) -> Holder | None:
        """Return the valid key of a hash."""
        return _holder(session, _holders().where(KeyRow.key_hash == key_hash))

    @reads
    def by_session(self, session: Session, token_hash: str) -> Holder | None:
        """Return the valid key of a browser session that has not ended."""
        query = _holders().join(SessionRow, SessionRow.key_id == KeyRow.id)
        return _holder(
            session, query.where(SessionRow.token_hash == token_hash, SessionRow.expires_at > now())
        )

    def note_use(self, holder: Holder) -> None:
        """Record the time at which a key is used, to within `USE_PRECISION`."""
        if holder.last_used_at is None or now() - holder.last_used_at >= USE_PRECISION:
            with self.database.writing() as session:
                session.execute(update(KeyRow).where(KeyRow.id == holder.key_id).values(last_used_at=now()))

    @writes
    def sign_in(self, session: Session, key_id: int, token_hash: str, lasts: timedelta) -> None:
        """Begin a session; expired ones are deleted."""
        session.execute(delete(SessionRow).where(SessionRow.expires_at <= now()))
        session.add(
            SessionRow(token_hash=token_hash, key_id=key_id, created_at=now(), expires_at=now() + lasts)
        )

    @writes
    def sign_out(self, session: Session, token_hash: str) -> None:
        """End a session."""
        session.execute(delete(SessionRow).where(SessionRow.token_hash == token_hash))

    # --- what they have ---------------------------------------------------------------------------

    @reads
    def quota_of(self, session: Session, owner: str) -> Quota:
        """Return the limits of an owner."""
        row = session.scalar(select(OwnerRow).where(OwnerRow.name == owner))
        return Quota() if row is None else Quota(row.quota_bytes, row.quota_photos)

    @reads
    def holdings_of(self, session: Session, owner: str) -> Holdings:
        """Return how much an owner stores."""
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

    def rows(self, table: type[Base], owner: str, *, at_once: int = 200) -> Iterator[dict[str, Any]]:
        """Yield the rows of an owner, a few at a time: photos, lenses, and what belongs to them."""
        cells: Table = table.__table__  # type: ignore[assignment]  # of a declared table it is one
        last = 0
        while True:
            with self.database.reading() as session:
                key = owner_id(session, owner)
                query = select(cells).where(cells.c.id > last, _of_owner(table, key or 0))
                page = session.execute(query.order_by(cells.c.id).limit(at_once)).mappings().all()
            if not page:
                return
            last = page[-1]["id"]
            yield from (dict(row) for row in page)

    # --- erasure --------------------------------------------------------------------------------

    @writes_durably
    def begin_erasing(self, session: Session, owner: str) -> int | None:
        """Remove the name and keys of an owner whose data are to be erased; return the row's key.

        None if there is no such owner.
        """
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

    @reads
    def to_erase(self, session: Session) -> list[int]:
        """Return the owners whose erasure has begun and is not complete."""
        return list(session.scalars(select(OwnerRow.id).where(OwnerRow.erased_at.is_not(None))))

    @writes
    def erase_some(self, session: Session, owner_key: int) -> list[str] | None:
        """Erase some rows of an owner; return the prefixes of their blobs. None once nothing is left."""
        of_owner = select(PhotoRow).where(PhotoRow.owner_id == owner_key)
        photos = list(session.scalars(of_owner.limit(AT_ONCE).with_for_update()))
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
        return _discarded(session, [f"models/{lens.public_id}/" for lens in lenses])

    @writes
    def purge(self, session: Session) -> None:
        """Remove the emptied rows of what was deleted a day ago."""
        old = now() - REMEMBERED
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
    corrections = session.scalars(select(CorrectionRow).where(CorrectionRow.photo_id.in_(keys)))
    prefixes = [row.folder for row in corrections] + [photo.folder for photo in photos]
    session.execute(delete(PhotoRow).where(PhotoRow.id.in_(keys)))  # and by their keys all that is of them
    return _discarded(session, prefixes)


def _discarded(session: Session, prefixes: list[str]) -> list[str]:
    """Have blobs deleted once more later: a worker may be writing another one."""
    discard(session, *prefixes)
    return prefixes


def _valid() -> ColumnElement[bool]:
    return KeyRow.revoked_at.is_(None) & or_(KeyRow.expires_at.is_(None), KeyRow.expires_at > now())


def _holders() -> Select[KeyRow]:
    kept = OwnerRow.erased_at.is_(None)
    return select(KeyRow).options(joinedload(KeyRow.owner)).where(_valid(), KeyRow.owner.has(kept))


def _holder(session: Session, query: Select[KeyRow]) -> Holder | None:
    key = session.scalar(query)
    if key is None:
        return None
    return Holder(key.id, key.owner.name, tuple(key.scopes.split()), key.expires_at, key.last_used_at)


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
