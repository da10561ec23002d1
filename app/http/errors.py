"""Exceptions as responses: one table, one format (`application/problem+json`, RFC 9457).

A route raises and contains no `try`. An exception that is not in the table is our own bug: status
500, the cause goes to the log and not to the caller.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from http import HTTPStatus
from typing import Any, Final

from fastapi import Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import Response
from obstore.exceptions import BaseError as StorageError
from pydantic import ValidationError
from sqlalchemy.exc import DBAPIError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from starlette.exceptions import HTTPException
from starlette.requests import ClientDisconnect

from app.errors import ServiceError
from app.runtime.outage import is_no_room, is_outage
from app.schemas import FieldError, Problem
from lensmodel.core import errors as library

log = logging.getLogger(__name__)

MEDIA_TYPE: Final = "application/problem+json"
REQUEST_ID: Final = "X-Request-ID"
# Headers of every response unless it sets its own: no scripts, no sniffing, no embedding elsewhere
HEADERS: Final[Mapping[str, str]] = {
    "Content-Security-Policy": "default-src 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
}
_OF_STORES: Final = (DBAPIError, PoolTimeoutError, StorageError, OSError)
# Exceptions that are answered: all, but frameworks ask for those by name that are no bug
KINDS: Final[tuple[type[Exception], ...]] = (
    *(library.LensModelError, RequestValidationError, ValidationError, HTTPException, ClientDisconnect),
    *_OF_STORES,
    Exception,
)
# Status of the codes that errors have and jobs end with; all others are faults of ours
STATUS_OF_CODE: Final[Mapping[str, int]] = {
    code: status
    for status, codes in {
        400: "malformed_upload invalid_request",
        401: "not_signed_in",
        403: "forbidden",
        404: "unknown_photo unknown_lens unknown_correction unknown_job",
        406: "not_acceptable",
        408: "too_slow",
        409: "no_samples not_ready conflict other_lens cancelled",
        413: "image_too_large decompression_bomb body_too_large",
        415: "not_an_image truncated_image unsupported_format raw_decode_failed",
        422: "metadata_missing invalid_parameter no_usable_patches outside_support memory_limit time_limit "
        "turned_pixels",
        429: "quota_exceeded",
        503: "busy outage",
    }.items()
    for code in codes.split()
}
CODE_OF_STATUS: Final[Mapping[int, str]] = {404: "not_found", 405: "method_not_allowed"}  # of the framework


def status_of(error: library.LensModelError) -> int:
    """Return the HTTP status of an error: its own, that of its code, or that of its nearest ancestor's."""
    if isinstance(error, ServiceError) and error.status is not None:
        return error.status
    codes = (error.code, *(getattr(kind, "code", "") for kind in type(error).__mro__))
    return next((STATUS_OF_CODE[code] for code in codes if code in STATUS_OF_CODE), 500)


def problem_of(code: str, detail: str | None, status: int | None = None, **more: Any) -> Problem:  # noqa: ANN401 - of Problem
    """Return an error, of a request or of a job, as a problem."""
    return Problem(
        type=f"urn:lensmodel:{code}",
        title=code.replace("_", " ").capitalize(),
        status=status or STATUS_OF_CODE.get(code, 500),
        detail=detail or "",
        code=code,
        **more,
    )


def respond(
    request: Request,
    status: int,
    code: str,
    detail: str,
    *,
    errors: Sequence[FieldError] = (),
    headers: Mapping[str, str] | None = None,
) -> Response:
    """Build the response for a problem."""
    request_id = getattr(request.state, "request_id", None)
    more = {"instance": request.url.path, "errors": list(errors), "request_id": request_id}
    body = problem_of(code, detail, status, **more).model_dump_json(exclude_none=True)
    # the id here too: unforeseen errors are answered outside of Guard
    own = {} if request_id is None else {REQUEST_ID: request_id}
    return Response(body, status, {**HEADERS, **(headers or {}), **own}, MEDIA_TYPE)


def field_errors(errors: Sequence[Any]) -> list[FieldError]:
    """Convert pydantic's errors to ours: the field, the value sent, what is allowed."""
    return [
        FieldError(
            field=".".join(_writable(part) for part in error["loc"]) or "body",
            value=_quoted(error.get("input")),
            message=_writable(error["msg"]),
        )
        for error in errors
    ]


def _quoted(value: object) -> str | None:
    if value is None or isinstance(value, dict | list | bytes):
        return None  # too long to quote
    text = _writable(value)
    return text if len(text) <= 100 else f"{text[:100]}…"


def _writable(value: object) -> str:
    """Return a value as text that UTF-8 can encode: JSON may contain lone surrogates."""
    return str(value).encode("utf-8", "backslashreplace").decode("utf-8")


def answer(request: Request, error: Exception) -> Response:
    """Build the response for an exception of `KINDS`."""
    errors: Sequence[FieldError] = ()
    headers: Mapping[str, str] | None = None
    match error:
        case library.LensModelError():
            status, code, detail = status_of(error), error.code, str(error)
            if isinstance(error, ServiceError):
                headers = error.headers
            elif status >= HTTPStatus.INTERNAL_SERVER_ERROR:
                log.error("unexpected %s", code, exc_info=error)
        case RequestValidationError() | ValidationError():
            status, code, errors = 422, "invalid_parameter", field_errors(error.errors())
            got = ((e, "" if e.value is None else f", got {e.value!r}") for e in errors)
            detail = "; ".join(f"{e.field}: {e.message}{value}" for e, value in got)
        case HTTPException():
            status, headers = error.status_code, error.headers
            code = getattr(error, "code", "") or CODE_OF_STATUS.get(status, "invalid_request")
            detail = (
                f"{request.method} {request.url.path}: {error.detail}; see /openapi.json for what there is"
            )
        case ClientDisconnect():
            status, code, detail = 400, "malformed_upload", "the body ended early: send it again"
        case _ if isinstance(error, _OF_STORES) and is_no_room(error):
            log.error("no room: %s", error)
            status, code = 507, "quota_exceeded"
            detail = "there is no room for it: delete photos, or make room on the disk"
        case _ if isinstance(error, _OF_STORES) and (is_outage(error) or isinstance(error, OperationalError)):
            what = "database" if isinstance(error, SQLAlchemyError) else "storage"
            log.error("%s: %s", what, getattr(error, "orig", error))
            status, code, headers = 503, "busy", {"Retry-After": "5"}
            detail = f"the {what} does not answer; try again in a few seconds"
        case _:
            request_id = getattr(request.state, "request_id", None)  # no longer in the logging context here
            more = {"request_id": request_id}
            log.error("unexpected error, request_id=%s", request_id, exc_info=error, extra=more)
            status, code = 500, "internal_error"
            detail = "an error of ours; the log has it under this request_id"
    return respond(request, status, code, detail, errors=errors, headers=headers)
