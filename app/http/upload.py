"""Receiving a photo: parsed while it streams, hashed while it is stored, refused as early as possible.

The body goes straight into storage: no copy in memory, none in a temporary folder. Its type is
determined by its first bytes; the name and the media type that the client sends are ignored.
"""

from __future__ import annotations

import hashlib
import unicodedata
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass, field
from typing import Final

from fastapi import Request
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import MultipartParser, parse_options_header
from starlette.requests import ClientDisconnect

from app.blobs.storage import AsyncBlobWriter, Storage
from app.errors import MalformedUploadError, TooLargeError
from app.schemas import UploadFields
from app.store.tables import PROFILE_FILE
from lensmodel import photo

SNIFF_BYTES: Final = photo.HEAD_BYTES
MAX_FORM_BYTES: Final = 64 * 1024
"""Bytes of all form fields at most (chosen): far more than the fields of an upload can have."""

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

    def __init__(self, blob: AsyncBlobWriter, limit: int, sniff: Callable[[bytes], str]) -> None:
        self._blob, self._limit, self._sniff = blob, limit, sniff
        self._hash = hashlib.sha256()
        self._head = b""
        self.size = 0
        self.kind: str | None = None

    async def write(self, data: bytes) -> None:
        self.size += len(data)
        if self.size > self._limit:
            raise too_large(self._limit)
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


def too_large(limit: int) -> TooLargeError:
    """Return the error for an upload that is too large."""
    return TooLargeError(
        f"the file is larger than {limit} bytes: send a smaller one, "
        "or raise LENS_MAX_UPLOAD_MB where you run the service"
    )


@dataclass(slots=True)
class _Part:
    """One part of a multipart body."""

    name: str
    filename: str | None
    value: bytearray = field(default_factory=bytearray)


@dataclass(slots=True)
class _Form:
    """Turns the parser's callbacks into parts, and the file's bytes into a queue."""

    fields: dict[str, str] = field(default_factory=dict)
    filename: str | None = None
    files: int = 0
    pending: list[bytes] = field(default_factory=list)
    ended: bool = False
    _headers: dict[str, str] = field(default_factory=dict)
    _name: bytearray = field(default_factory=bytearray)
    _value: bytearray = field(default_factory=bytearray)
    _part: _Part | None = None
    _parts: int = 0
    _form_bytes: int = 0

    def on_part_begin(self) -> None:
        self._headers, self._part = {}, None
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
        name = options.get(b"name", b"").decode("utf-8", "replace")
        if disposition != b"form-data" or not name:
            raise MalformedUploadError(f"a part without Content-Disposition: form-data; name=...: {REMEDY}")
        filename = options.get(b"filename")
        self._part = _Part(name, None if filename is None else filename.decode("utf-8", "replace"))
        if name == FILE_FIELD:
            self.files += 1
            self.filename = self._part.filename
            if self.files > 1:
                raise MalformedUploadError("two parts `file`: send each photo in a request of its own")
        elif name in self.fields:
            raise MalformedUploadError(f"the field {name[:60]!r} is there twice: send it once")
        elif filename is not None:
            raise MalformedUploadError(f"a file in the field {name[:60]!r}: {REMEDY}")

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        assert self._part is not None
        if self._part.name == FILE_FIELD:
            self.pending.append(data[start:end])
            return
        self._form_bytes += end - start
        if self._form_bytes > MAX_FORM_BYTES:
            raise MalformedUploadError(f"form fields of more than {MAX_FORM_BYTES} bytes: {REMEDY}")
        self._part.value += data[start:end]

    def on_part_end(self) -> None:
        assert self._part is not None
        if self._part.name != FILE_FIELD:
            try:
                self.fields[self._part.name] = self._part.value.decode("utf-8")
            except UnicodeDecodeError as error:
                raise MalformedUploadError(
                    f"the field {self._part.name[:60]!r} is not UTF-8: encode it so"
                ) from error

    def on_end(self) -> None:
        self.ended = True

    def parser(self, boundary: bytes) -> MultipartParser:
        """Return a parser that feeds this form."""
        return MultipartParser(
            boundary,
            {
                "on_part_begin": self.on_part_begin,
                "on_part_data": self.on_part_data,
                "on_part_end": self.on_part_end,
                "on_header_field": self.on_header_field,
                "on_header_value": self.on_header_value,
                "on_header_end": self.on_header_end,
                "on_headers_finished": self.on_headers_finished,
                "on_end": self.on_end,
            },
        )


async def receive(
    request: Request,
    storage: Storage,
    key: str,
    *,
    limit: int,
) -> Uploaded:
    """Stream the body of a request into the blob `key`."""
    query = {name: value for name, value in request.query_params.items() if name != "filename"}
    UploadFields.model_validate(query)  # before the body: a wrong query need not send it
    if declared_length(request) > limit + 2 * MAX_FORM_BYTES:
        raise too_large(limit)
    media_type, options = parse_options_header(request.headers.get("content-type", ""))
    async with storage.writer(key) as blob:
        sink = _Sink(blob, limit, photo.sniff)
        if media_type == b"multipart/form-data":
            form = await _receive_form(request, options.get(b"boundary", b""), sink)
            name, fields = form.filename, form.fields
        elif media_type == b"application/x-www-form-urlencoded":
            raise MalformedUploadError(f"a form without a file: {REMEDY}")
        else:
            async for piece in _body(request):
                await sink.write(piece)
            name, fields = request.query_params.get("filename"), {}
        sha256, kind = sink.finish()
        checked = UploadFields.model_validate({**query, **fields})
    return Uploaded(sha256, sink.size, kind, safe_name(name), checked)


async def receive_profile(request: Request, storage: Storage, key: str, *, limit: int) -> tuple[str, int]:
    """Stream a lens profile into the blob `key`; return its SHA-256 and size. A worker reads it."""
    async with storage.writer(key) as blob:
        sink = _Sink(blob, limit, _sniff_profile)
        async for piece in _body(request):
            await sink.write(piece)
        return sink.finish()[0], sink.size


def _sniff_profile(head: bytes) -> str:
    if not head.startswith(b"PK"):
        raise MalformedUploadError("this is no lens profile: send one that ends in .lensprofile")
    return PROFILE_FILE


def declared_length(request: Request) -> int:
    """Return the declared length of the body in bytes; 0 where none is declared."""
    declared = request.headers.get("content-length", "0")
    if not declared.isdecimal() or len(declared) > 18:
        raise MalformedUploadError(f"Content-Length {declared[:40]!r} is no number: send the number of bytes")
    return int(declared)


async def _body(request: Request) -> AsyncIterator[bytes]:
    while True:
        message = await request.receive()
        if message["type"] == "http.disconnect":
            raise ClientDisconnect
        if message.get("body"):
            yield message["body"]
        if not message.get("more_body", False):
            return


async def _receive_form(request: Request, boundary: bytes, sink: _Sink) -> _Form:
    form = _Form()
    if not boundary:
        raise MalformedUploadError(f"multipart/form-data without a boundary: {REMEDY}")
    try:
        parser = form.parser(boundary)
        async for piece in _body(request):
            parser.write(piece)
            for data in form.pending:
                await sink.write(data)
            form.pending.clear()
        parser.finalize()
    except FormParserError as error:
        raise MalformedUploadError(f"the multipart body cannot be parsed ({error}): {REMEDY}") from error
    if not form.ended:
        raise MalformedUploadError("the multipart body ends before its last boundary: send it again")
    if form.files == 0:
        raise MalformedUploadError(f"no part `file`: {REMEDY}")
    return form
