"""Identify who asks: the owner of a key or browser session, or the one owner of a service on loopback."""

from __future__ import annotations

import contextlib
import math
import secrets
import time
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Final

from starlette.requests import Request

from app.errors import ServiceError
from app.store import accounts
from app.store.accounts import SCOPES, Accounts, Scope
from app.store.owners import LOCAL

if TYPE_CHECKING:
    from app.runtime.settings import Settings

COOKIE: Final = "lens_session"
SESSION: Final = timedelta(hours=12)  # how long a browser that has signed in stays so (chosen): a day of work
FRESH_S: Final = 1.0  # seconds for which a process trusts what it has read of a key (chosen)
MAX_CACHED: Final = 10_000  # keys and sessions that a process remembers at most (chosen): some MiB
HOW: Final = (
    "send a key in the header `Authorization: Bearer lpk_...`, or sign in at /sign-in; "
    "`lensmodel keys create` on the machine of the service makes one"
)
CHALLENGE: Final = {"WWW-Authenticate": "Bearer"}


@dataclass(frozen=True, slots=True)
class Who:
    """Who asks, and which scopes he has; `key_id` is None for the one owner of a service without sign-in."""

    owner: str
    scopes: tuple[str, ...]
    key_id: int | None = None
    token: str | None = None  # digest of the key or session token, to check again that it is still valid


EVERYBODY: Final = Who(LOCAL, SCOPES)


class Gate:
    """Identifies who asks, and refuses those who may not; all but `quick` may read the database."""

    def __init__(self, settings: Settings, store: Accounts) -> None:
        self._store, self._closed = store, settings.needs_keys
        # until when nobody needs a key, as far as that is known without the database
        self._open_until = math.inf if settings.auth == "none" else -math.inf
        # each use of it is one step, which threads do not part
        self._known: dict[str, tuple[float, Who]] = {}

    def is_closed(self) -> bool:
        """Whether a key is required: always, or since one was created."""
        if not self._closed and time.monotonic() > self._open_until:
            self._closed, self._open_until = self._store.has_keys(), time.monotonic() + FRESH_S
        return self._closed

    def quick(self, request: Request) -> Who | None:
        """Return who asks if that is known without the database; None where it must be looked up."""
        if not self._closed:
            return EVERYBODY if time.monotonic() <= self._open_until else None
        shown = shown_by(request)
        return None if shown is None else self._remembered(accounts.digest_of(shown))

    def who(self, request: Request) -> Who:
        """Return who asks."""
        if not self.is_closed():
            return EVERYBODY
        shown = shown_by(request)
        if shown is None:
            raise ServiceError(
                f"this service answers only those it knows: {HOW}", headers=CHALLENGE, code="not_signed_in"
            )
        who = self._look_up(accounts.digest_of(shown))
        if who is None:
            raise ServiceError(
                f"this key or sign-in is not valid, or no longer: {HOW}",
                headers={**CHALLENGE, "Set-Cookie": f"{COOKIE}=; Path=/; Max-Age=0"},
                code="not_signed_in",
            )
        return who

    @staticmethod
    def require(who: Who, scope: Scope) -> None:
        """Refuse a key without a scope."""
        if not accounts.covers(who.scopes, scope):
            held = " and ".join(who.scopes)
            raise ServiceError(
                f"this key may {held}, and this takes {scope}: use another key", code="forbidden"
            )

    def is_still(self, who: Who) -> bool:
        """Say whether access is still valid: long responses check it repeatedly."""
        return not self.is_closed() if who.token is None else self._look_up(who.token) is not None

    def sign_in(self, text: str) -> str:
        """Begin a session with a key; return the token for the browser."""
        who = self._look_up(accounts.digest_of(text)) if accounts.is_key(text) else None
        if who is None or who.key_id is None:
            raise ServiceError(
                "this key is not valid, or no longer: look for a blank or a missing end", code="not_signed_in"
            )
        token = secrets.token_urlsafe(32)
        self._store.sign_in(who.key_id, accounts.digest_of(token), SESSION)
        return token

    def sign_out(self, request: Request) -> None:
        """End the session of a browser."""
        token = request.cookies.get(COOKIE)
        if token:
            self._store.sign_out(accounts.digest_of(token))
            self._known.pop(accounts.digest_of(token), None)

    def _remembered(self, digest: str) -> Who | None:
        entry = self._known.get(digest)
        return entry[1] if entry is not None and time.monotonic() - entry[0] <= FRESH_S else None

    def _look_up(self, digest: str) -> Who | None:
        known = self._remembered(digest)
        if known is not None:
            return known
        key = self._store.shown(digest)
        if key is None:
            return None
        who = Who(key.owner.name, tuple(key.scopes.split()), key.id, digest)
        if len(self._known) >= MAX_CACHED:
            self._known.clear()
        self._known[digest] = (time.monotonic(), who)
        with contextlib.suppress(Exception):  # a full disk or a busy database must not refuse access
            self._store.note_use(key)
        return who


def shown_by(request: Request) -> str | None:
    """Return the key of a request, or else the token of its session."""
    scheme, _, text = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return text.strip()
    return request.cookies.get(COOKIE) or None
