"""Receiving a photo: parsed while it streams, hashed while it is stored, refused as early as possible.

The body goes straight into storage: no copy in memory, none in a temporary folder. Its type is
determined by its first bytes; the name and the media type that the client sends are ignored.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header

from app.blobs.storage import AsyncBlobWriter, Storage
from app.errors import MalformedUploadError
from app.http.middleware import MAX_FORM_BYTES
from app.schemas import UploadFields
from app.store.tables import PROFILE_FILE
from lensmodel import photo

SNIFF_BYTES: Final = photo.HEAD_BYTES
MAX_PARTS: Final = 32
"""Parts of a form at most (chosen): more than an upload has fields."""

FILE_FIELD: Final = "file"
REMEDY: Final = (
    "send multipart/form-data with one part `file`, or the bytes of the photo as the body "
    "with Content-Type application/octet-stream"
)


@dataclass(frozen=True, slots=True)
class Uploaded:
    """An upload that is complete and stored."""

    sha256: str
    size: int
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


class _Sink:
    """Stores the bytes of the photo, counts and hashes them, and determines the type by the first."""

    def __init__(self, blob: AsyncBlobWriter, sniff: Callable[[bytes], str]) -> None:
        self._blob, self._sniff = blob, sniff
        self._hash = hashlib.sha256()
        self._head = b""
        self.size = 0
        self.kind: str | None = None

    async def write(self, data: bytes) -> None:
        self.size += len(data)
        if self.kind is None:
            self._head += data
            if len(self._head) >= SNIFF_BYTES:
                self.kind = self._sniff(self._head)
        self._hash.update(data)
        await self._blob.write(data)

    def finish(self) -> tuple[str, str]:
        """Return hash and kind once the photo is complete."""
        if self.size == 0:
            raise MalformedUploadError(f"the photo is empty: {REMEDY}")
        return self._hash.hexdigest(), self.kind or self._sniff(self._head)


class _Form:
    """Turns what the parser finds into fields, and the file's bytes into a list to be fetched."""

    def __init__(self) -> None:
        self.fields: dict[str, str] = {}
        self.filename: str | None = None
        self.has_file = self.ended = False
        self.pending: list[bytes] = []
        self._headers: dict[str, str] = {}
        self._name, self._value = bytearray(), bytearray()
        self._field = ""
        self._parts = self._form_bytes = 0

    def on_part_begin(self) -> None:
        self._headers, self._field = {}, ""
        self._parts += 1
        if self._parts > MAX_PARTS:
            raise MalformedUploadError(f"more than {MAX_PARTS} parts: {REMEDY}")

    def on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def on_header_end(self) -> None:
        # latin-1 preserves the bytes: the options are returned as bytes, and are UTF-8
        self._headers[self._name.decode("latin-1").lower()] = self._value.decode("latin-1")
        self._name, self._value = bytearray(), bytearray()

    def on_headers_finished(self) -> None:
        disposition, options = parse_options_header(self._headers.get("content-disposition", ""))
        self._field = options.get(b"name", b"").decode("utf-8", "replace")
        filename = options.get(b"filename")
        if disposition != b"form-data" or not self._field:
            raise MalformedUploadError(f"a part without Content-Disposition: form-data; name=...: {REMEDY}")
        if self._field == FILE_FIELD:
            if self.has_file:
                raise MalformedUploadError("two parts `file`: send each photo in a request of its own")
            self.has_file = True
            self.filename = None if filename is None else filename.decode("utf-8", "replace")
        elif self._field in self.fields:
            raise MalformedUploadError(f"the field {self._field[:60]!r} is there twice: send it once")
        elif filename is not None:
            raise MalformedUploadError(f"a file in the field {self._field[:60]!r}: {REMEDY}")

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        if self._field == FILE_FIELD:
            self.pending.append(data[start:end])
            return
        self._form_bytes += end - start
        if self._form_bytes > MAX_FORM_BYTES:
            raise MalformedUploadError(f"form fields of more than {MAX_FORM_BYTES} bytes: {REMEDY}")
        self._value += data[start:end]

    def on_part_end(self) -> None:
        if self._field != FILE_FIELD:
            try:
                self.fields[self._field] = self._value.decode("utf-8")
            except UnicodeDecodeError as error:
                raise MalformedUploadError(
                    f"the field {self._field[:60]!r} is not UTF-8: encode it so"
                ) from error
            self._value = bytearray()

    def on_end(self) -> None:
        self.ended = True


async def receive(request: Request, storage: Storage, key: str) -> Uploaded:
    """Stream the body of a request into the blob `key`."""
    query = {name: value for name, value in request.query_params.items() if name != "filename"}
    UploadFields.model_validate(query)  # before the body: a wrong query need not send it
    media_type, options = parse_options_header(request.headers.get("content-type", ""))
    async with storage.writer(key) as blob:
        sink = _Sink(blob, photo.sniff)
        if media_type == b"multipart/form-data":
            form = await _receive_form(request, options.get(b"boundary", b""), sink)
            name, fields = form.filename, form.fields
        elif media_type == b"application/x-www-form-urlencoded":
            raise MalformedUploadError(f"a form without a file: {REMEDY}")
        else:
            async for piece in request.stream():
                await sink.write(piece)
            name, fields = request.query_params.get("filename"), {}
        sha256, kind = sink.finish()
        checked = UploadFields.model_validate({**query, **fields})
    return Uploaded(sha256, sink.size, kind, safe_name(name), checked)


async def receive_profile(request: Request, storage: Storage, key: str) -> tuple[str, int]:
    """Stream a lens profile into the blob `key`; return its SHA-256 and size. A worker reads it."""
    async with storage.writer(key) as blob:
        sink = _Sink(blob, _sniff_profile)
        async for piece in request.stream():
            await sink.write(piece)
        return sink.finish()[0], sink.size


def _sniff_profile(head: bytes) -> str:
    if not head.startswith(b"PK"):
        raise MalformedUploadError("this is no lens profile: send one that ends in .lensprofile")
    return PROFILE_FILE


async def _receive_form(request: Request, boundary: bytes, sink: _Sink) -> _Form:
    form = _Form()
    if not boundary:
        raise MalformedUploadError(f"multipart/form-data without a boundary: {REMEDY}")
    callbacks: Any = {name: getattr(form, name) for name in vars(_Form) if name.startswith("on_")}
    try:
        parser = MultipartParser(boundary, callbacks)
        async for piece in request.stream():
            parser.write(piece)
            for data in form.pending:
                await sink.write(data)
            form.pending.clear()
        parser.finalize()
    except FormParserError as error:
        raise MalformedUploadError(f"the multipart body cannot be parsed ({error}): {REMEDY}") from error
    if not form.ended:
        raise MalformedUploadError("the multipart body ends before its last boundary: send it again")
    if not form.has_file:
        raise MalformedUploadError(f"no part `file`: {REMEDY}")
    return form
