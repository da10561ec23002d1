"""Receiving a photo: hashed while it is stored, refused as early as possible.

A raw body goes straight into storage, a form by a temporary file. Its type is determined by its first bytes;
the name and the media type that the client sends are ignored.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass
from typing import Final

from fastapi import Request
from starlette.datastructures import UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException

from app.blobs.storage import CHUNK, Storage
from app.errors import ServiceError
from app.http.middleware import MAX_FORM_BYTES, BodyError
from app.schemas import UploadFields
from app.store.tables import PROFILE_FILE
from lensmodel import photo

MAX_PARTS: Final = 32  # fields of a form at most (chosen): more than an upload has
FILE_FIELD: Final = "file"
REMEDY: Final = (
    "send multipart/form-data with one part `file`, or the bytes of the photo as the body "
    "with Content-Type application/octet-stream"
)


@dataclass(frozen=True, slots=True)
class Uploaded:
    """An upload that is complete and stored."""

    sha256: str
    byte_size: int
    kind: str
    filename: str
    fields: UploadFields


def safe_name(name: str | None) -> str:
    """Return a name for display: no folders, no control characters, not too long. It never becomes a path."""
    text = unicodedata.normalize("NFC", name or "")
    last = text.replace("\\", "/").rpartition("/")[2]
    shown = "".join(sign for sign in last if sign.isprintable()).strip(" .")
    stem, dot, suffix = shown.rpartition(".")
    if dot and len(suffix) <= 10:
        shown = f"{stem[: 190 - len(suffix)]}.{suffix}" if stem else shown
    return shown[:200] or "photo"


async def receive(request: Request, storage: Storage, key: str, lens_id: str | None) -> Uploaded:
    """Store the photo that a request brings under `key`; return it with what is said about it."""
    own = {} if lens_id is None else {"lens_id": lens_id}
    query = {name: value for name, value in request.query_params.items() if name != "filename"}
    UploadFields.model_validate(query)  # before the body: a wrong query need not send it
    kind = request.headers.get("content-type", "").partition(";")[0].strip().lower()
    if kind == "application/x-www-form-urlencoded":
        raise ServiceError(f"a form without a file: {REMEDY}", code="malformed_upload")
    if kind != "multipart/form-data":
        stored = await _stored(request.stream(), storage, key, photo.sniff)
        name, fields = request.query_params.get("filename"), UploadFields.model_validate(query | own)
    else:
        async with read_form(request) as (file, said):
            fields, name = UploadFields.model_validate(query | said | own), file.filename
            stored = await _stored(_pieces(file), storage, key, photo.sniff)
    return Uploaded(*stored, safe_name(name), fields)


async def receive_profile(request: Request, storage: Storage, key: str, lens_id: str) -> Uploaded:
    """Store a profile for a lens under `key`, which a worker reads; another lens may be sent the same."""
    digest, size, kind = await _stored(request.stream(), storage, key, _sniff_profile)
    name = f"{lens_id}.lensprofile"
    same = hashlib.sha256(f"{name}|{digest}".encode()).hexdigest()
    return Uploaded(same, size, kind, name, UploadFields.model_validate({"lens_id": lens_id}))


def _sniff_profile(head: bytes) -> str:
    if not head.startswith(b"PK"):
        raise ServiceError(
            "this is no lens profile: send one that ends in .lensprofile", code="malformed_upload"
        )
    return PROFILE_FILE


async def _stored(
    pieces: AsyncIterator[bytes], storage: Storage, key: str, sniff: Callable[[bytes], str]
) -> tuple[str, int, str]:
    """Store the bytes of a file; return their hash and number, and the kind that the first of them show."""
    digest, size, head, kind = hashlib.sha256(), 0, b"", ""
    async with storage.writer(key) as blob:
        async for piece in pieces:
            size += len(piece)
            if not kind:
                head += piece
                kind = sniff(head) if len(head) >= photo.HEAD_BYTES else ""
            digest.update(piece)
            await blob.write(piece)
        if size == 0:
            raise ServiceError(
                "the file is empty; copy it again from the camera or card", code="malformed_upload"
            )
        kind = kind or sniff(head)
    return digest.hexdigest(), size, kind


async def _pieces(file: UploadFile) -> AsyncIterator[bytes]:
    while piece := await file.read(CHUNK):
        yield piece


@asynccontextmanager
async def read_form(request: Request) -> AsyncIterator[tuple[UploadFile, dict[str, str]]]:
    """Provide the file of a form, and its fields."""
    try:
        form = await request.form(max_files=1, max_fields=MAX_PARTS, max_part_size=MAX_FORM_BYTES)
    except (MultiPartException, HTTPException) as error:
        if isinstance(error, BodyError):
            raise
        why = error.message if isinstance(error, MultiPartException) else error.detail
        raise _unreadable(why) from error
    try:
        file, entries = form.get(FILE_FIELD), form.multi_items()
        fields = {name: value for name, value in entries if isinstance(value, str)}
        if not isinstance(file, UploadFile):
            raise _unreadable("no part `file`, or no last boundary")
        if len(fields) != len(entries) - 1:
            raise _unreadable("a field is there twice")
        yield file, fields
    finally:
        await form.close()


def _unreadable(why: str) -> ServiceError:
    return ServiceError(f"the form cannot be read ({why}): {REMEDY}", code="malformed_upload")
