"""Around every request: its id, one line in the log, and the names that the service answers to."""

from __future__ import annotations

import logging
import re
import time
from typing import Final
from urllib.parse import urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.errors import REQUEST_ID, respond
from app.ids import new_id

log = logging.getLogger("app.access")

_ACCEPTED: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)


class RequestLog:
    """Gives each request its id and writes what became of it.

    The query is not logged: it may hold a serial, which is personal data.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        sent = Headers(scope=scope).get(REQUEST_ID, "")
        request_id = sent if _ACCEPTED.fullmatch(sent) else new_id()
        scope.setdefault("state", {})["request_id"] = request_id
        began, status = time.perf_counter(), 500

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                MutableHeaders(scope=message)[REQUEST_ID] = request_id
            await send(message)

        try:
            await self._app(scope, receive, answer)
        finally:
            millis = (time.perf_counter() - began) * 1000
            log.info(
                "%s %s %d %.1f ms request_id=%s", scope["method"], scope["path"], status, millis, request_id
            )


class OwnNames:
    """Refuses requests for names that anybody can register.

    A page of a stranger may let its own name point to this machine, and would then be allowed by the
    browser to read everything here. It cannot do so with an address or a local name.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        host = Headers(scope=scope).get("host", "") if scope["type"] == "http" else ""
        if is_local(host):
            await self._app(scope, receive, send)
            return
        detail = (
            f"Host {host[:100]!r}: this service answers to addresses and local names such as localhost; "
            "set LENS_PUBLIC=true where a proxy stands before it and checks who asks"
        )
        await respond(Request(scope), 400, "invalid_parameter", detail)(scope, receive, send)


def is_local(host: str) -> bool:
    """Say whether a Host header is an address or a local name, which no stranger can own."""
    try:
        name = urlsplit(f"//{host}").hostname or ""
    except ValueError:
        return False
    return "." not in name or name.endswith((".localhost", ".local")) or name.replace(".", "").isdecimal()
