"""Identify who asks: the owner of a key or browser session, or the one owner of a service on loopback."""

from __future__ import annotations

import contextlib
import logging
import secrets
import threading
import time
from collections import OrderedDict
from dataclasses import dataclass
from datetime import timedelta
from typing import TYPE_CHECKING, Final

from starlette.requests import Request

from app.errors import ForbiddenError, NotSignedInError, QuotaError
from app.store import accounts
from app.store.accounts import SCOPES, Accounts, Holder, Scope
from app.store.owners import LOCAL

if TYPE_CHECKING:
    from app.runtime.settings import Settings

log = logging.getLogger(__name__)

COOKIE: Final = "lens_session"
SESSION: Final = timedelta(hours=12)
"""How long a browser that has signed in stays so (chosen): a day of work."""

FRESH_S: Final = 1.0
"""Seconds for which a process trusts what it has read of a key (chosen): a revoked key works no longer."""

REQUESTS_PER_MINUTE: Final = 6000
"""Requests of one owner in each process (chosen): a hundred a second, more than any page or program sends."""

MAX_CACHED: Final = 10_000
"""Keys and sessions that a process remembers at most (chosen): some MiB, more than a service has users."""

HOW: Final = (
    "send a key in the header `Authorization: Bearer lpk_...`, or sign in at /sign-in; "
    "`lensmodel keys create` on the machine of the service makes one"
)
CHALLENGE: Final = {"WWW-Authenticate": "Bearer"}


MAX_BUCKETS: Final = 10_000
"""Buckets that are kept (chosen: a few MiB, more owners than ask at once); the one used least recently is
dropped first, and is full again by then."""


@dataclass(frozen=True, slots=True)
class Who:
    """Who asks, and which scopes he has.

    `key_id` is None for the one owner of a service without sign-in.
    """

    owner: str
    scopes: tuple[str, ...]
    key_id: int | None = None
    token: str | None = None
    """Digest of the key or session token, by which a long response checks again that it is still valid."""


EVERYBODY: Final = Who(LOCAL, SCOPES)


class Gate:
    """Identifies who asks, and refuses those who may not.

    Blocking: it reads the database.
    """

    def __init__(self, settings: Settings, store: Accounts) -> None:
        self._settings, self._store = settings, store
        self._closed = settings.needs_keys
        self._looked = -FRESH_S
        self._rates = Rates(REQUESTS_PER_MINUTE)
        self._known: OrderedDict[str, tuple[float, Who | None]] = OrderedDict()
        self._guard = threading.Lock()

    def is_closed(self) -> bool:
        """Whether a key is required: always, or since one was created."""
        if self._closed or self._settings.auth == "none":
            return self._closed
        if time.monotonic() - self._looked > FRESH_S:
            self._closed = self._store.has_keys()
            self._looked = time.monotonic()
        return self._closed

    def quick(self, request: Request) -> Who | None:
        """Return who asks if that is known without the database; None where it must be looked up."""
        if not self._closed:
            fresh = self._settings.auth == "none" or time.monotonic() - self._looked <= FRESH_S
            return EVERYBODY if fresh else None
        shown = shown_by(request)
        return None if shown is None else self._remembered(accounts.digest_of(shown))

    def who(self, request: Request) -> Who:
        """Return who asks."""
        if not self.is_closed():
            return EVERYBODY
        shown = shown_by(request)
        if shown is None:
            raise NotSignedInError(f"this service answers only those it knows: {HOW}", headers=CHALLENGE)
        who = self._look_up(shown)
        if who is None:
            raise NotSignedInError(
                f"this key or sign-in is not valid, or no longer: {HOW}",
                headers={**CHALLENGE, "Set-Cookie": f"{COOKIE}=; Path=/; Max-Age=0"},
            )
        return who

    def admit(self, who: Who, method: str) -> None:
        """Refuse what the scopes do not allow, and requests beyond the rate limit."""
        if who.key_id is None:
            return
        self.require(who, "read" if method in {"GET", "HEAD", "OPTIONS"} else "write")
        wait = self._rates.wait_of(who.owner)
        if wait > 0:
            raise QuotaError(
                f"more than {REQUESTS_PER_MINUTE} requests a minute: wait {wait:.1f} s",
                headers={"Retry-After": str(int(wait) + 1)},
            )

    def require(self, who: Who, scope: Scope) -> None:
        """Refuse a key without a scope."""
        if not accounts.covers(who.scopes, scope):
            raise ForbiddenError(
                f"this key may {' and '.join(who.scopes)}, and this takes {scope}: use another key"
            )

    def is_still(self, who: Who) -> bool:
        """Say whether access is still valid: long responses check it repeatedly."""
        if who.token is None:
            return not self.is_closed()
        with self._guard:
            entry = self._known.get(who.token)
        if entry is not None and time.monotonic() - entry[0] <= FRESH_S:
            return entry[1] is not None
        holder = self._store.by_hash(who.token) or self._store.by_session(who.token)
        self._remember(who.token, None if holder is None else _who(holder, who.token))
        return holder is not None

    def sign_in(self, text: str) -> tuple[Who, str]:
        """Begin a session with a key; return its owner, and the token for the browser."""
        who = self._look_up(text) if accounts.prefix_of(text) else None
        if who is None or who.key_id is None:
            raise NotSignedInError("this key is not valid, or no longer: look for a blank or a missing end")
        token = secrets.token_urlsafe(32)
        self._store.sign_in(who.key_id, accounts.digest_of(token), SESSION)
        return who, token

    def sign_out(self, request: Request) -> None:
        """End the session of a browser."""
        token = request.cookies.get(COOKIE)
        if token:
            self._store.sign_out(accounts.digest_of(token))
            with self._guard:
                self._known.pop(accounts.digest_of(token), None)

    def _remembered(self, digest: str) -> Who | None:
        with self._guard:
            entry = self._known.get(digest)
        return entry[1] if entry is not None and time.monotonic() - entry[0] <= FRESH_S else None

    def _look_up(self, shown: str) -> Who | None:
        digest = accounts.digest_of(shown)
        known = self._remembered(digest)
        if known is not None:
            return known
        find = self._store.by_session if accounts.prefix_of(shown) is None else self._store.by_hash
        holder = find(digest)
        if holder is None:
            return None
        who = _who(holder, digest)
        self._remember(digest, who)
        with contextlib.suppress(Exception):  # a full disk or a busy database must not refuse access
            self._store.note_use(holder)
        return who

    def _remember(self, digest: str, who: Who | None) -> None:
        with self._guard:
            self._known[digest] = (time.monotonic(), who)
            self._known.move_to_end(digest)
            while len(self._known) > MAX_CACHED:
                self._known.popitem(last=False)


def shown_by(request: Request) -> str | None:
    """Return the key of a request, or else the token of its session."""
    scheme, _, text = request.headers.get("authorization", "").partition(" ")
    if scheme.lower() == "bearer":
        return text.strip()
    return request.cookies.get(COOKIE) or None


def _who(holder: Holder, digest: str) -> Who:
    return Who(holder.owner, holder.scopes, holder.key_id, digest)


class Rates:
    """The buckets of one process, one for each name.

    Parameters
    ----------
    per_minute : int
        Requests that refill each bucket in a minute; it holds those of ten seconds, a sixth of them.
    """

    def __init__(self, per_minute: int) -> None:
        self._rate = per_minute / 60.0
        self._size = max(per_minute / 6.0, 1.0)
        self._left: OrderedDict[str, tuple[float, float]] = OrderedDict()
        self._guard = threading.Lock()

    def wait_of(self, name: str) -> float:
        """Take one request from a bucket; return 0, or the seconds until there is one if it is empty."""
        now = time.monotonic()
        with self._guard:
            left, since = self._left.pop(name, (self._size, now))
            left = min(left + (now - since) * self._rate, self._size)
            allowed = left >= 1.0
            self._left[name] = (left - 1.0 if allowed else left, now)
            if len(self._left) > MAX_BUCKETS:
                self._left.popitem(last=False)
        return 0.0 if allowed else (1.0 - left) / self._rate
