"""Who asks and what is his, as it crosses HTTP."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Literal

from pydantic import Field

from app.schemas.fields import Model, Question


class SignIn(Question):
    """The key with which a browser signs in."""

    key: Annotated[str, Field(min_length=1, max_length=200)]


class SessionOut(Model):
    """Who is signed in, and what he may; on a service of one owner without keys, that one."""

    owner: str
    scopes: list[Literal["read", "write", "admin"]]
    needed: bool = Field(description="whether one must sign in here at all")


class AccountOut(Model):
    """What an owner has, and may have."""

    owner: str
    scopes: list[Literal["read", "write", "admin"]]
    photos: int
    max_photos: int
    stored_bytes: int
    max_stored_bytes: int
    lenses: int
    corrections: int
    created_at: datetime | None
