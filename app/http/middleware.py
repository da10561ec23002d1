"""Middleware of every request: its id and log line; host names, same site and size of the body as allowed.

Clients that are slow on purpose are left to a proxy in front: docs/topics/operating.md has one.
"""

from __future__ import annotations

import logging
import re
import time
from typing import Final
from urllib.parse import quote, urlsplit

from starlette.datastructures import Headers, MutableHeaders
from starlette.exceptions import HTTPException
from starlette.requests import Request
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from structlog.contextvars import bound_contextvars, clear_contextvars

from app.http.errors import HEADERS, REQUEST_ID, respond
from app.runtime import logs, metrics
from app.store.database import new_id

log = logging.getLogger("app.access")

MAX_LOGGED: Final = 500  # characters of a path in the log (chosen): no path of the interface has as many
MIB: Final = 1 << 20
MAX_JSON_BYTES: Final = 64 * 1024  # longest JSON body (chosen): far longer than any request
MAX_PROFILE_BYTES: Final = 64 * MIB  # largest profile (chosen): twenty times that of a hundred photos
MAX_FORM_BYTES: Final = 64 * 1024  # all form fields of an upload (chosen): far more than they can have
SAFE: Final = frozenset({"GET", "HEAD", "OPTIONS", "TRACE"})
METHODS: Final = frozenset({"GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"})
MALFORMED: Final = "?"  # a host name that cannot be read; no host has it
CLOSE: Final = {"Connection": "close"}  # of a refusal before the body is read: the rest is not waited for

_PHOTO: Final = re.compile(r"/v1/photos|/v1/lenses/[^/]+/measurements")
_PROFILE: Final = re.compile(r"/v1/lenses/[^/]+/profile")
_ACCEPTED: Final = re.compile(r"[A-Za-z0-9._-]{1,64}", re.ASCII)


def _record(scope: Scope, status: int, seconds: float, request_id: str) -> None:
    route: str = getattr(scope.get("route"), "path", "none")  # with names in place of ids
    if scope["path"].startswith("/v1/") and route.startswith("/"):
        route = f"/v1{route}"
    # unknown methods share a label, lest strangers create any number of them
    method = scope["method"] if scope["method"] in METHODS else "other"
    metrics.REQUEST_SECONDS.labels(method, route, str(status)).observe(seconds)
    path = quote(scope["path"][:MAX_LOGGED], safe="/:@!$&'()*+,;=~")  # escaped, on one line
    ids = {name: text[:60] for name, text in scope.get("path_params", {}).items() if name in logs.FIELDS}
    fields = {"request_id": request_id, "method": scope["method"], "path": path, "status": status}
    millis = round(seconds * 1000, 1)
    log.info(
        "%s %s %d %.1f ms request_id=%s",
        *(scope["method"], path, status, millis, request_id),
        extra={**ids, **fields, "ms": millis},
    )


class BodyError(HTTPException):
    """A request that is refused; FastAPI passes on no other error of the reading of a body."""

    def __init__(self, status: int, code: str, detail: str) -> None:
        super().__init__(status, detail, CLOSE)
        self.code = code


class Guard:
    """Gives each request an id, logs its outcome, and sets the headers of every response.

    It refuses foreign host names, changes that pages of other sites ask for, and bodies that are too long. A
    foreign page may let its own name resolve to this machine (DNS rebinding), but cannot own an address or a
    local name. A browser sends its requests with the user's permissions, and states the origin of each (Fetch
    Metadata, W3C; Origin, RFC 6454), which a page cannot forge. The query is not logged: it may hold a
    serial, which is personal data.
    """

    def __init__(self, app: ASGIApp, allowed: frozenset[str], max_upload_mb: int) -> None:
        self._app, self._allowed, self._max_upload_mb = app, allowed, max_upload_mb

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Pass the request on, or refuse it."""
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        clear_contextvars()  # a keep-alive connection runs in the context of its first request
        headers, began, status, received = Headers(scope=scope), time.perf_counter(), 500, 0
        sent = headers.get(REQUEST_ID, "")
        request_id = sent if _ACCEPTED.fullmatch(sent) else new_id()
        scope.setdefault("state", {})["request_id"] = request_id
        most, too_long = self._limit(scope)

        async def counted() -> Message:
            nonlocal received
            message = await receive()
            received += len(message.get("body", b""))
            if received > most:
                raise too_long
            return message

        async def answer(message: Message) -> None:
            nonlocal status
            if message["type"] == "http.response.start":
                status = message["status"]
                headers = MutableHeaders(scope=message)
                headers[REQUEST_ID] = request_id
                for name, value in HEADERS.items():
                    headers.setdefault(name, value)
            await send(message)

        app, changes = self._app, scope["method"] not in SAFE
        try:
            self._check_host(headers)
            if changes:
                self._check_site(headers)
                self._check_body(headers, most, too_long)
        except BodyError as refusal:
            app = respond(Request(scope), refusal.status_code, refusal.code, refusal.detail, headers=CLOSE)
        try:
            with bound_contextvars(request_id=request_id):
                await app(scope, counted if changes else receive, answer)
        finally:
            _record(scope, status, time.perf_counter() - began, request_id)

    def _check_host(self, headers: Headers) -> None:
        host = headers.get("host", "")
        name = host_name(host)
        # addresses and local names, which no stranger can own
        local = (
            "." not in name or name.endswith((".localhost", ".local")) or name.replace(".", "").isdecimal()
        )
        if name == MALFORMED or not (local or name in self._allowed):
            raise BodyError(
                400,
                "invalid_parameter",
                f"Host {host[:100]!r}: this service answers to addresses and local names such as localhost; "
                "name others that are yours in LENS_ALLOWED_HOSTS",
            )

    def _check_site(self, headers: Headers) -> None:
        origin = headers.get("origin")
        place = "" if origin is None else origin.partition("://")[2].lower()
        ours = origin is None or (place and place == headers.get("host", "").lower())
        allowed = ours or host_name(place) in self._allowed
        if not allowed or headers.get("sec-fetch-site", "none") not in {"same-origin", "none"}:
            raise BodyError(
                403,
                "cross_site",
                f"a page of {(origin or 'another site')[:100]!r} asked for this change: only pages of this "
                "service may, and programs, which send no Origin; name a proxy's host in LENS_ALLOWED_HOSTS",
            )

    def _limit(self, scope: Scope) -> tuple[int, BodyError]:
        """Return how many bytes of a body there may be, and the error of more."""
        code, most, remedy = "body_too_large", MAX_JSON_BYTES, "no question needs as many"
        if scope["method"] == "POST" and _PHOTO.fullmatch(scope["path"]):
            code, most = "image_too_large", self._max_upload_mb * MIB + 2 * MAX_FORM_BYTES
            remedy = "send a smaller file, or raise LENS_MAX_UPLOAD_MB where you run the service"
        elif scope["method"] == "PUT" and _PROFILE.fullmatch(scope["path"]):
            code, most, remedy = "image_too_large", MAX_PROFILE_BYTES, "send a smaller profile"
        return most, BodyError(413, code, f"the body has more than {most} bytes: {remedy}")

    @staticmethod
    def _check_body(headers: Headers, most: int, too_long: BodyError) -> None:
        """Refuse a body by its headers alone; uploads are bytes or forms, all others JSON."""
        is_json, declared = most == MAX_JSON_BYTES, declared_length(headers)
        if declared > most:
            raise too_long
        kind = headers.get("content-type", "").partition(";")[0].strip().lower()
        if is_json and (declared or "transfer-encoding" in headers) and kind != "application/json":
            raise BodyError(415, "unsupported_format", f"Content-Type {kind[:100]!r}: send application/json")


def declared_length(headers: Headers) -> int:
    """Return the declared length of a body in bytes, a number as the server has checked; 0 where none is."""
    return int(headers.get("content-length", "0"))


def host_name(host: str) -> str:
    """Return the name in a Host header, without its port."""
    try:
        return (urlsplit(f"//{host}").hostname or "").lower()
    except ValueError:
        return MALFORMED
