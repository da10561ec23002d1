"""Access: keys and browser sessions. See `app.store.tables`."""

from __future__ import annotations

from datetime import datetime

from sqlalchemy import ForeignKey, Index, String
from sqlalchemy.orm import Mapped, mapped_column

from app.store.tables import Base


class KeyRow(Base):
    """One key of an owner; only its hash is stored."""

    __tablename__ = "api_key"
    __table_args__ = (Index("ix_api_key_owner_id", "owner_id"),)

    id: Mapped[int] = mapped_column(primary_key=True)
    owner_id: Mapped[int] = mapped_column(ForeignKey("owner.id"))
    prefix: Mapped[str] = mapped_column(String(20), unique=True)
    key_hash: Mapped[str] = mapped_column(String(200), unique=True)
    label: Mapped[str | None]
    scopes: Mapped[str] = mapped_column(String(60))
    """Words of `app.access.keys.SCOPES`, separated by spaces."""

    created_at: Mapped[datetime]
    last_used_at: Mapped[datetime | None]
    expires_at: Mapped[datetime | None]
    revoked_at: Mapped[datetime | None]


class SessionRow(Base):
    """One browser that has signed in with a key; it ends with the key."""

    __tablename__ = "session"
    __table_args__ = (Index("ix_session_key_id", "key_id"),)

    token_hash: Mapped[str] = mapped_column(String(64), primary_key=True)
    key_id: Mapped[int] = mapped_column(ForeignKey("api_key.id", ondelete="CASCADE"))
    created_at: Mapped[datetime]
    expires_at: Mapped[datetime]
