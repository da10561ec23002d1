"""The size of JSON bodies, and the time of every body; photos and profiles are bounded by their own routes.

Clients that are slow on purpose are left to a proxy in front: docs/topics/operating.md has one.
"""

from __future__ import annotations

import asyncio
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.errors import SlowBodyError
from app.http.errors import respond

MAX_JSON_BYTES: Final = 64 * 1024
"""Longest JSON body (chosen): far longer than any request; parsed, it takes some ten times as much memory."""

JSON_SECONDS: Final = 60.0
"""Longest time that a JSON body may take (chosen): 64 KiB come within it by the slowest mobile connection."""

UPLOADS: Final = {
    "POST": re.compile(r"/v1/photos|/v1/lenses/[^/]+/measurements"),
    "PUT": re.compile(r"/v1/lenses/[^/]+/profile"),
}
"""Paths whose routes read the body themselves, by method."""

SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS", "TRACE"})
CLOSE: Final = {"Connection": "close"}
"""Header of a refusal before the body is read: the rest of it is not waited for."""

_TOO_LONG: Final = f"the body has more than {MAX_JSON_BYTES} bytes: no question needs as many"


@asynccontextmanager
async def within(seconds: float) -> AsyncIterator[None]:
    """Bound the time in which a body comes."""
    try:
        async with asyncio.timeout(seconds) as limit:
            yield
    except TimeoutError as error:
        if not limit.expired():
            raise
        text = f"the body did not come within {seconds:g} s: send it again over a faster connection"
        raise SlowBodyError(text, headers=CLOSE) from error


class JsonBodies:
    """Middleware that refuses bodies that are too long or not JSON."""

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with its body complete, or refuse it."""
        if scope["type"] != "http" or scope["method"] in SAFE or _is_upload(scope):
            await self._app(scope, receive, send)
            return
        refusal, body = _refusal(Headers(scope=scope)), b""
        try:
            if refusal is None:
                async with within(JSON_SECONDS):
                    body = await _read(receive)
        except SlowBodyError as error:
            refusal = (error.status, error.code, str(error))
        except ClientDisconnect:
            return
        if refusal is None and len(body) > MAX_JSON_BYTES:
            refusal = (413, "body_too_large", _TOO_LONG)
        if refusal is not None:
            await respond(Request(scope), *refusal, headers=CLOSE)(scope, receive, send)
            return
        await self._app(scope, _replayed(body, receive), send)


async def _read(receive: Receive) -> bytes:
    """Return the body, or of a longer one its beginning."""
    body = bytearray()
    while len(body) <= MAX_JSON_BYTES:
        message = await receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        body += message.get("body", b"")
        if not message.get("more_body", False):
            break
    return bytes(body)


def _is_upload(scope: Scope) -> bool:
    pattern = UPLOADS.get(scope["method"])
    return pattern is not None and pattern.fullmatch(scope["path"]) is not None


def _refusal(headers: Headers) -> tuple[int, str, str] | None:
    """Return why a body is refused by its headers alone: status, code, detail; None if it is not."""
    declared = headers.get("content-length", "0")
    if not declared.isdecimal() or len(declared) > 18:
        return 400, "invalid_request", f"Content-Length {declared[:40]!r} is no number"
    if int(declared) > MAX_JSON_BYTES:
        return 413, "body_too_large", f"Content-Length {declared}: {_TOO_LONG}"
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if (int(declared) == 0 and "transfer-encoding" not in headers) or kind == "application/json":
        return None
    return 415, "unsupported_format", f"Content-Type {kind[:100]!r}: send application/json"


def _replayed(body: bytes, receive: Receive) -> Receive:
    messages: list[Message] = [{"type": "http.request", "body": body, "more_body": False}]

    async def replay() -> Message:
        return messages.pop() if messages else await receive()

    return replay
