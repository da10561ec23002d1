"""What several routes share: pages, and which problems an endpoint may answer with."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final, Protocol, TypeAlias, TypeVar
from urllib.parse import quote, urlencode

from fastapi import Query

from app.errors import UnknownError
from app.http.dependencies import Call
from app.http.errors import MEDIA_TYPE
from app.other_lens import Described
from app.schemas import Model, OptionalName, Page, Problem
from app.store.tables import LensRow
from lensmodel.core.names import camera_name

Limit = Annotated[int, Query(ge=1, le=200, description="items on a page")]
Cursor = Annotated[
    str | None, Query(pattern="^[A-Za-z0-9]{1,40}$", description="from `next` of the page before")
]
OnlyId = Annotated[str | None, Query(pattern="^[A-Za-z0-9]{1,40}$")]
OnlyName = Annotated[OptionalName, Query()]


class HasPublicId(Protocol):
    """A row with a public id."""

    public_id: str


Row = TypeVar("Row", bound=HasPublicId)
M = TypeVar("M", bound=Model)
T = TypeVar("T")


Answers: TypeAlias = dict[int | str, dict[str, Any]]


def problems(*statuses: int, also: Answers | None = None) -> Answers:
    """Return the OpenAPI entries of the problems that an endpoint may answer with, and of `also`."""
    schema = {"schema": {"$ref": "#/components/schemas/Problem"}}
    answers: Answers = {
        status: {"model": Problem, "description": "Problem", "content": {MEDIA_TYPE: schema}}
        for status in (*statuses, 500, 503)
    }
    return answers | (also or {})


NOT_CHANGED: Final[Answers] = {304: {"description": "Not changed"}}


def file_answer(media_type: str, description: str, status: int = 200) -> Answers:
    """Return the OpenAPI entry of an answer that is a file."""
    content = {media_type: {"schema": {"type": "string", "format": "binary"}}}
    return {status: {"content": content, "description": description}}


def file_headers(name: str, *, inline: bool = False, cache: str = "private, no-cache") -> dict[str, str]:
    """Return the headers of a file that is saved under a name, or shown."""
    plain = re.sub(r"[^A-Za-z0-9._-]+", "-", name).strip("-") or "file"
    how = "inline" if inline else "attachment"
    return {
        "Content-Disposition": f"{how}; filename=\"{plain}\"; filename*=UTF-8''{quote(name, safe='')}",
        "Cache-Control": cache,
        "X-Content-Type-Options": "nosniff",
    }


def matches_tag(call: Call, tag: str) -> bool:
    """Say whether a request already has the answer of this tag (RFC 9110, 13.1.2)."""
    sent = call.request.headers.get("if-none-match", "")
    return sent.strip() == "*" or tag in {entry.strip().removeprefix("W/") for entry in sent.split(",")}


def found(what: str, key: str, row: T | None) -> T:
    """Return what was looked up of the owner; refuse what is not there, or somebody else's."""
    if row is None:
        raise UnknownError(what, key)
    return row


def find_lens(call: Call, lens_id: str) -> LensRow:
    """Return a lens of the owner."""
    return found("lens", lens_id, call.store.lenses.get(lens_id, call.owner))


def described_lens(call: Call, lens: LensRow) -> Described:
    """Return what is known of a lens by itself and by its newest photos."""
    own = call.store.photos.page(call.owner, before=None, limit=200, lens_id=lens.public_id)
    return Described(
        lens.maker,
        lens.model,
        lens.serial,
        {camera_name(row.camera_maker, row.camera_model) for row in own if row.camera_model},
        [row.focal_mm for row in own if row.focal_mm],
    )


def paged(call: Call, rows: Sequence[Row], limit: int, make: Callable[[Row], M]) -> Page[M]:
    """Return a page of what one row more was read of, with the address of the next one."""
    following = rows[limit - 1].public_id if len(rows) > limit else None
    return Page(items=[make(row) for row in rows[:limit]], next=next_link(call, following))


def next_link(call: Call, cursor: str | None) -> str | None:
    """Return the address of the next page, and set the Link header."""
    if cursor is None:
        return None
    query = {**call.request.query_params, "cursor": cursor}
    link = f"{call.request.url.path}?{urlencode(query)}"
    call.response.headers["Link"] = f'<{link}>; rel="next"'
    return link
