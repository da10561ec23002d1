"""Limits on the size and the speed of JSON bodies.

Photos are streamed by `app.http.upload`, with limits of their own.
"""

from __future__ import annotations

import asyncio
import math
import re
import time
from typing import Final

from starlette.datastructures import Headers
from starlette.requests import ClientDisconnect, Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.errors import SlowBodyError
from app.http.errors import respond

MAX_JSON_BYTES: Final = 64 * 1024
"""Longest JSON body (chosen): far longer than any request; parsed, it takes some ten times as much memory."""

FLOOR_BYTES_PER_S: Final = 4096
"""Slowest body that is accepted (chosen): a bad mobile connection sends ten times as fast."""

UPLOADS: Final = re.compile(r"/v1/photos|/v1/lenses/[^/]+/measurements")
PROFILES: Final = re.compile(r"/v1/lenses/[^/]+/profile")
"""Paths of uploads by POST and of profiles by PUT: their routes read the body themselves, with a `Pace`."""

SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS", "TRACE"})
CLOSE: Final = {"Connection": "close"}
"""Header of a refusal before the body is read: the rest of it is not waited for."""


class Pace:
    """Enforces the speed of a body; only the time spent waiting for it counts.

    Parameters
    ----------
    patience_s : float
        Longest pause within a body, and time before its average rate counts.
    within_s : float
        Longest time for the whole body, whatever its rate.
    """

    def __init__(self, patience_s: float, within_s: float = math.inf) -> None:
        self._patience_s, self._within_s = patience_s, within_s
        self._waited = 0.0
        self._bytes = 0

    async def next(self, receive: Receive) -> Message:
        """Return the next message of a body."""
        began = time.monotonic()
        try:
            message = await asyncio.wait_for(receive(), self._patience_s)
        except TimeoutError:
            self._refuse(f"nothing came for {self._patience_s:g} s")
        self._waited += time.monotonic() - began
        self._bytes += len(message.get("body", b""))
        if self._waited > self._patience_s + self._bytes / FLOOR_BYTES_PER_S:
            self._refuse(f"{self._bytes} bytes came within {self._waited:.0f} s")
        if self._waited > self._within_s:
            self._refuse(f"not all came within {self._within_s:g} s")
        return message

    def _refuse(self, what: str) -> None:
        raise SlowBodyError(
            f"the body came too slowly ({what}, {FLOOR_BYTES_PER_S} bytes/s are the least): send it again",
            headers=CLOSE,
        )


class JsonBodies:
    """Middleware that refuses bodies that are not JSON, too long or too slow."""

    def __init__(self, app: ASGIApp, patience_s: float) -> None:
        self._app, self._patience_s = app, patience_s

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on with its body complete, or refuse it."""
        if scope["type"] != "http" or scope["method"] in SAFE or _is_upload(scope):
            await self._app(scope, receive, send)
            return
        request = Request(scope)
        refusal = _refusal(Headers(scope=scope))
        if refusal is not None:
            status, code, detail = refusal
            await respond(request, status, code, detail, headers=CLOSE)(scope, receive, send)
            return
        try:
            body = await self._read(receive)
        except SlowBodyError as error:
            answer = respond(request, error.status, error.code, str(error), headers=error.headers)
            await answer(scope, receive, send)
            return
        except ClientDisconnect:
            return  # the client is gone
        if body is None:
            await respond(request, 413, "body_too_large", _TOO_LONG, headers=CLOSE)(scope, receive, send)
            return
        await self._app(scope, _replayed(body, receive), send)

    async def _read(self, receive: Receive) -> bytes | None:
        pace, body = Pace(self._patience_s), bytearray()
        while True:
            message = await pace.next(receive)
            if message["type"] == "http.disconnect":
                raise ClientDisconnect
            body += message.get("body", b"")
            if len(body) > MAX_JSON_BYTES:
                return None
            if not message.get("more_body", False):
                return bytes(body)


_TOO_LONG: Final = f"the body has more than {MAX_JSON_BYTES} bytes: no question needs as many"


def _is_upload(scope: Scope) -> bool:
    pattern = {"POST": UPLOADS, "PUT": PROFILES}.get(scope["method"])
    return pattern is not None and pattern.fullmatch(scope["path"]) is not None


def _refusal(headers: Headers) -> tuple[int, str, str] | None:
    """Return why a body is refused by its headers alone: status, code, detail; None if it is not."""
    declared = headers.get("content-length", "0")
    if not declared.isdecimal() or len(declared) > 18:
        return 400, "invalid_request", f"Content-Length {declared[:40]!r} is no number"
    if int(declared) > MAX_JSON_BYTES:
        return 413, "body_too_large", f"Content-Length {declared}: {_TOO_LONG}"
    kind = headers.get("content-type", "").partition(";")[0].strip().lower()
    if int(declared) == 0 and "transfer-encoding" not in headers:
        return None
    if kind == "application/json":
        return None
    return 415, "unsupported_format", f"Content-Type {kind[:100]!r}: send application/json"


def _replayed(body: bytes, receive: Receive) -> Receive:
    handed_over = False

    async def replay() -> Message:
        nonlocal handed_over
        if handed_over:
            return await receive()
        handed_over = True
        return {"type": "http.request", "body": body, "more_body": False}

    return replay
