"""What several routes share: look-ups, pages, files, and which problems an endpoint may answer with."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from operator import attrgetter
from typing import Annotated, Any, Final, TypeAlias, TypeVar
from urllib.parse import quote, urlencode

from fastapi import Query

from app.errors import UnknownError
from app.http.dependencies import Call
from app.http.errors import MEDIA_TYPE
from app.other_lens import Described
from app.schemas import Model, OptionalName, Page, Problem
from app.store.tables import LensRow, PhotoRow
from lensmodel.core.names import camera_name

Limit = Annotated[int, Query(ge=1, le=200, description="items on a page")]
_ID: Final = "^[A-Za-z0-9]{1,40}$"
Cursor = Annotated[str | None, Query(pattern=_ID, description="from `next` of the page before")]
OnlyId = Annotated[str | None, Query(pattern=_ID)]
OnlyName = Annotated[OptionalName, Query()]

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
    return _described(lens.maker, lens.model, lens.serial, own)


def described_photo(photo: PhotoRow) -> Described:
    """Return what a photo says of its lens."""
    return _described(photo.lens_maker, photo.lens_model, photo.lens_serial, [photo])


def _described(
    maker: str | None, model: str | None, serial: str | None, photos: Sequence[PhotoRow]
) -> Described:
    cameras = {camera_name(row.camera_maker, row.camera_model) for row in photos if row.camera_model}
    return Described(maker, model, serial, cameras, [row.focal_mm for row in photos if row.focal_mm])


def paged(
    call: Call,
    rows: Sequence[T],
    limit: int,
    make: Callable[[T], M],
    cursor: Callable[[T], str] = attrgetter("public_id"),
) -> Page[M]:
    """Return a page of what one row more was read of, with the address of the next one, also in `Link`."""
    items, following = [make(row) for row in rows[:limit]], None
    if len(rows) > limit:
        query = {**call.request.query_params, "cursor": cursor(rows[limit - 1])}
        following = f"{call.request.url.path}?{urlencode(query)}"
        call.response.headers["Link"] = f'<{following}>; rel="next"'
    return Page(items=items, next=following)
