"""Middleware of every request: its id and log line, allowed host names, same-site checks, size of bodies.

Clients that are slow on purpose are left to a proxy in front: docs/topics/operating.md has one.
"""

from __future__ import annotations

import asyncio
import logging
import re
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final
from urllib.parse import quote, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars, clear_contextvars

from app.errors import SlowBodyError
from app.http.errors import HEADERS, REQUEST_ID, respond
from app.runtime import logs, metrics
from app.store.database import new_id

log = logging.getLogger("app.access")

MAX_LOGGED: Final = 500
"""Characters of a path in the log at most (chosen): no path of the interface has as many."""

MIB: Final = 1 << 20
MAX_JSON_BYTES: Final = 64 * 1024
"""Longest JSON body (chosen): far longer than any request; parsed, it takes some ten times as much memory."""

MAX_PROFILE_BYTES: Final = 64 * MIB
"""Largest profile that is accepted (chosen): twenty times that of a hundred photos."""

MAX_FORM_BYTES: Final = 64 * 1024
"""Bytes of all form fields of an upload at most (chosen): far more than they can have."""

_PHOTO: Final = re.compile(r"/v1/photos|/v1/lenses/[^/]+/measurements")
_PROFILE: Final = re.compile(r"/v1/lenses/[^/]+/profile")

SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS", "TRACE"})
CLOSE: Final = {"Connection": "close"}
"""Header of a refusal before the body is read: the rest of it is not waited for."""

_ACCEPTED: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)


class RequestLog:
    """Gives each request an id, logs its outcome, and sets the headers of every response.

    The query is not logged: it may hold a serial, which is personal data.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        clear_contextvars()  # a keep-alive connection runs in the context of its first request
        sent = Headers(scope=scope).get(REQUEST_ID, "")
        request_id = sent if _ACCEPTED.fullmatch(sent) else new_id()
        scope.setdefault("state", {})["request_id"] = request_id
        began, status = time.perf_counter(), 500

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID] = request_id
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        try:
            with bound_contextvars(request_id=request_id):
                await self._app(scope, receive, answer)
        finally:
            seconds = time.perf_counter() - began
            millis = seconds * 1000
            metrics.REQUEST_SECONDS.labels(_known(scope["method"]), _route(scope), str(status)).observe(
                seconds
            )
            path = quote(scope["path"][:MAX_LOGGED], safe="/:@!$&'()*+,;=~")  # escaped, on one line
            ids = {
                name: text[:60] for name, text in scope.get("path_params", {}).items() if name in logs.FIELDS
            }
            log.info(
                "%s %s %d %.1f ms request_id=%s",
                *(scope["method"], path, status, millis, request_id),
                extra={
                    **ids,
                    "request_id": request_id,
                    "method": scope["method"],
                    "path": path,
                    "status": status,
                    "ms": round(millis, 1),
                },
            )


class OwnNames:
    """Refuses requests for registrable host names that are not ours (DNS rebinding).

    A foreign page may let its own name resolve to this machine, and the browser would then allow it
    to read everything here. It cannot do so with an address or a local name.
    """

    def __init__(self, app: ASGIApp, allowed: frozenset[str]) -> None:
        self._app, self._allowed = app, allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] != "http" or is_ours(Headers(scope=scope).get("host", ""), self._allowed):
            await self._app(scope, receive, send)
            return
        host = Headers(scope=scope).get("host", "")
        detail = (
            f"Host {host[:100]!r}: this service answers to addresses and local names such as localhost; "
            "name others that are yours in LENS_ALLOWED_HOSTS"
        )
        await respond(Request(scope), 400, "invalid_parameter", detail)(scope, receive, send)


class SameSite:
    """Refuses changes that a page of another site makes a browser send; programs are not affected.

    A browser sends such requests with the user's permissions, and without asking. It states the origin of
    each (Fetch Metadata, W3C; Origin, RFC 6454), which a page cannot forge.
    """

    def __init__(self, app: ASGIApp, allowed: frozenset[str]) -> None:
        self._app, self._allowed = app, allowed

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] != "http" or scope["method"] in SAFE or self._same_site(Headers(scope=scope)):
            await self._app(scope, receive, send)
            return
        origin = Headers(scope=scope).get("origin", "")[:100]
        detail = (
            f"a page of {origin or 'another site'!r} asked for this change: only pages of this service may, "
            "and programs, which send no Origin; name a proxy's host in LENS_ALLOWED_HOSTS"
        )
        await respond(Request(scope), 403, "cross_site", detail, headers=CLOSE)(scope, receive, send)

    def _same_site(self, headers: Headers) -> bool:
        if headers.get("sec-fetch-site", "none") not in {"same-origin", "none"}:
            return False
        origin = headers.get("origin")
        if origin is None:
            return True
        try:
            parsed = urlsplit(origin)
            place, name = parsed.netloc.lower(), (parsed.hostname or "").lower()
        except ValueError:
            return False
        return bool(name) and (place == headers.get("host", "").lower() or name in self._allowed)


def _known(method: str) -> str:
    """Return a method as a label; unknown ones share a label, lest strangers create any number of them."""
    return method if method in {"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"} else "other"


def _route(scope: Scope) -> str:
    """Return the route of a request as a label, with names in place of ids."""
    route: str = getattr(scope.get("route"), "path", "none")
    return f"/v1{route}" if scope["path"].startswith("/v1/") and route.startswith("/") else route


def is_ours(host: str, allowed: frozenset[str]) -> bool:
    """Say whether a Host header is local or one of the allowed names, with any port."""
    if is_local(host):
        return True
    try:
        return (urlsplit(f"//{host}").hostname or "").lower() in allowed
    except ValueError:
        return False


def is_local(host: str) -> bool:
    """Say whether a Host header is an address or a local name, which no stranger can own."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    return "." not in name or name.endswith((".localhost", ".local")) or name.replace(".", "").isdecimal()


@asynccontextmanager
async def within(seconds: float) -> AsyncIterator[None]:
    """Bound the time in which an upload comes."""
    try:
        async with asyncio.timeout(seconds) as limit:
            yield
    except TimeoutError as error:
        if not limit.expired():
            raise
        text = f"the body did not come within {seconds:g} s: send it again over a faster connection"
        raise SlowBodyError(text, headers=CLOSE) from error


class BodyError(HTTPException):
    """A body that is refused; FastAPI passes on no other error of the reading."""

    def __init__(self, status: int, code: str, detail: str) -> None:
        super().__init__(status, detail, CLOSE)
        self.code = code


class BodySize:
    """Middleware that refuses bodies that are too long, by their declared length or while they come.

    Uploads are bytes or forms, all others JSON.
    """

    def __init__(self, app: ASGIApp, max_upload_mb: int) -> None:
        self._app, self._max_upload_mb = app, max_upload_mb

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] != "http" or scope["method"] in SAFE:
            await self._app(scope, receive, send)
            return
        most, too_long = self._limit(scope)
        refusal = _refusal(Headers(scope=scope), most, too_long, is_json=most == MAX_JSON_BYTES)
        if refusal is not None:
            answer = respond(Request(scope), refusal.status_code, refusal.code, refusal.detail, headers=CLOSE)
            await answer(scope, receive, send)
            return
        received = 0

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > most:
                raise too_long
            return message

        await self._app(scope, counted, send)

    def _limit(self, scope: Scope) -> tuple[int, BodyError]:
        """Return how many bytes there may be, and the error of more."""
        code, most, remedy = "body_too_large", MAX_JSON_BYTES, "no question needs as many"
        if scope["method"] == "POST" and _PHOTO.fullmatch(scope["path"]):
            code, most = "image_too_large", self._max_upload_mb * MIB + 2 * MAX_FORM_BYTES
            remedy = "send a smaller file, or raise LENS_MAX_UPLOAD_MB where you run the service"
        elif scope["method"] == "PUT" and _PROFILE.fullmatch(scope["path"]):
            code, most, remedy = "image_too_large", MAX_PROFILE_BYTES, "send a smaller profile"
        return most, BodyError(413, code, f"the body has more than {most} bytes: {remedy}")


def declared_length(headers: Headers) -> int | None:
    """Return the declared length of a body in bytes, 0 where none is declared; None where it is no number."""
    declared = headers.get("content-length", "0")
    return int(declared) if declared.isdecimal() and len(declared) <= 18 else None


def _refusal(headers: Headers, most: int, too_long: BodyError, *, is_json: bool) -> BodyError | None:
    """Return why a body is refused by its headers alone; None if it is not."""
    declared = declared_length(headers)
    if declared is None:
        sent = headers["content-length"][:40]
        text = f"Content-Length {sent!r} is no number: send the number of bytes"
        return BodyError(400, "invalid_request" if is_json else "malformed_upload", text)
    if declared > most:
        return too_long
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    empty = declared == 0 and "transfer-encoding" not in headers
    if not is_json or empty or kind == "application/json":
        return None
    return BodyError(415, "unsupported_format", f"Content-Type {kind[:100]!r}: send application/json")
