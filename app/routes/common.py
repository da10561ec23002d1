"""What several routes share: parameters, files, refusals of another lens, descriptions of answers."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Annotated, Any, Final, TypeAlias
from urllib.parse import quote

from fastapi import Query

from app.errors import OTHER_LENS_REMEDY, ConflictError
from app.http.dependencies import Call
from app.http.errors import MEDIA_TYPE
from app.schemas import OptionalName, Problem
from app.store.tables import LensRow, PhotoRow
from lensmodel.model.identity import Camera, Identity, difference

Limit = Annotated[int, Query(ge=1, le=200, description="items on a page")]
_ID: Final = "^[A-Za-z0-9]{1,40}$"
Cursor = Annotated[str | None, Query(pattern=_ID, description="from `next` of the page before")]
OnlyId = Annotated[str | None, Query(pattern=_ID)]
OnlyName = Annotated[OptionalName, Query()]

Answers: TypeAlias = dict[int | str, dict[str, Any]]
# OpenAPI entries of what any endpoint may answer
_PROBLEM: Final = {"schema": {"$ref": "#/components/schemas/Problem"}}
PROBLEMS: Final[Answers] = {
    status: {"model": Problem, "description": "Problem", "content": {MEDIA_TYPE: _PROBLEM}}
    for status in ("4XX", "5XX")
}
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


def check_same_lens(call: Call, lens: LensRow, other: LensRow | PhotoRow, what: str) -> None:
    """Refuse a photo, or a lens, that seems to be of another lens, as the command line does."""
    why = difference(_identity(call, lens), _identity(call, other))
    if why is not None:
        raise ConflictError(f"{what}: {why}; {OTHER_LENS_REMEDY}", code="other_lens")


def _identity(call: Call, it: LensRow | PhotoRow) -> Identity:
    """Return what is known of a lens by itself and its newest photos, or what a photo says of its lens."""
    photos: Sequence[PhotoRow]
    if isinstance(it, PhotoRow):
        said = {"maker": it.lens_maker, "model": it.lens_model, "serial": it.lens_serial}
        names, photos = {key: name for key, name in said.items() if name}, [it]
    else:
        photos = call.store.photos.page(call.owner, before=None, limit=200, lens_id=it.public_id)
        names = it.names
    cameras = {Camera(row.camera_maker, row.camera_model, row.body_key) for row in photos if row.camera_model}
    focals = {row.focal_mm for row in photos if row.focal_mm}
    return Identity(names, cameras, focals)
