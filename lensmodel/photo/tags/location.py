"""Where a photo was taken: found in its file, so that it can be overwritten in place.

Nothing moves and no length changes: GPS directories become empty ones, values in XMP become blanks. Read are
TIFF structures wherever they lie (TIFF, DNG and RAW files made so, the Exif blocks of JPEG files and of
previews inside RAW files, PNG, Canon's CR3), and XMP that is not compressed.

Sources: "Exif Version 3.0", CIPA DC-008, 2023, section 4.6.6; "XMP Specification Part 2", Adobe, 2016, 2.4;
"Portable Network Graphics, third edition", W3C, 2025, sections 5 and 11.
"""

from __future__ import annotations

import contextlib
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from lensmodel.core.errors import TruncatedImageError
from lensmodel.photo.headers.ifd import MAX_DIRECTORIES, Buffer, TiffReader
from lensmodel.photo.headers.opening import opened_header
from lensmodel.photo.headers.png import chunks_of
from lensmodel.photo.tags.exif_block import Directory
from lensmodel.photo.values import Limits

# Tags that point to directories: of Exif 3.0, section 4.6.3, and of TIFF/EP.
GPS: Final = 0x8825
EXIF: Final = 0x8769
SUB_DIRECTORIES: Final = 0x014A

_GPS_KINDS: Final = {1, 2, 3, 4, 5, 7, 10}  # types that its tags have

MAX_BLOCKS: Final = 64
"""Exif blocks of one file: the photo's, and one for each preview."""

MAX_TAGS: Final = 64
"""Tags of a GPS directory; there are 32. What has more is none."""

# Bounds against files made to cost time (chosen): bytes of a value, of which honest ones have some dozen,
# and places named in XMP.
MAX_VALUE: Final = 1 << 16
MAX_WORDS: Final = 1000

MAX_CHUNK_BYTES: Final = 16 << 20
"""Chosen like `lensmodel.photo.headers.header.MAX_BLOCK_BYTES`: of what is no image data."""

_PNG: Final = b"\x89PNG\r\n\x1a\n"
_EXIF_BLOCK: Final = b"Exif\0\0"
_CR3_GPS: Final = b"CMT4"
_VALUE: Final = rb'(?:\s*=\s*(?:"([^"<>]{0,200})"|\'([^\'<>]{0,200})\')|\s*>([^<>]{0,200})<)'
_XMP_GPS: Final = re.compile(rb":[Gg][Pp][Ss]\w{1,40}" + _VALUE)
"""`exif:GPSLatitude` as attribute or element, and the like that drones write in names of their own."""

_HIDDEN: Final = b"prVt"
"""Type of a chunk that every reader skips: ancillary, private, safe to copy."""


@dataclass(frozen=True, slots=True)
class Overwrite:
    """Bytes to be written over others of the same number."""

    start: int
    data: bytes


@dataclass(frozen=True, slots=True)
class LocationTraces:
    """Where a file says where it was taken."""

    overwrites: tuple[Overwrite, ...]  # what removes it; empty where the file says nothing
    complete: bool  # false where the file holds more than was looked at, as hostile ones may


def find_location(buffer: Buffer) -> LocationTraces:
    """Find what a photo file says of the place where it was taken.

    Not found: names of places in IPTC blocks and maker notes, and anything inside compressed blocks other
    than those of PNG.
    """
    spans: list[Overwrite] = []
    complete = True
    blocks = [TiffReader.open(buffer, 0)]
    for mark in (_EXIF_BLOCK, _CR3_GPS):
        places = list(_places(buffer, mark))
        complete = complete and len(places) <= MAX_BLOCKS
        for place in places[:MAX_BLOCKS]:
            reader = TiffReader.open(buffer, place + len(mark))
            if mark == _CR3_GPS and reader is not None:
                spans += _directory(buffer, reader, reader.first)
            else:
                blocks.append(reader)
    chunks = _chunks(buffer) if buffer[:8] == _PNG else []
    blocks += [TiffReader.open(buffer, start) for name, start, _ in chunks if name == b"eXIf"]
    for reader in blocks:
        if reader is not None:
            spans += _of_tiff(buffer, reader)
    for number, match in enumerate(_XMP_GPS.finditer(buffer)):
        if number == MAX_WORDS:
            complete = False
            break
        start, end = next(match.span(group) for group in (1, 2, 3) if match.span(group) != (-1, -1))
        if bytes(buffer[start:end]).strip():
            spans.append(Overwrite(start, b" " * (end - start)))
    spans = [span for span in spans if bytes(buffer[span.start : span.start + len(span.data)]) != span.data]
    if chunks:
        spans = _with_checksums(buffer, chunks, spans)
    return LocationTraces(tuple(spans), complete)


def gps_directory(path: Path) -> Directory | None:
    """Read the GPS directory of a photo, to be written into another file of it; None without one."""
    with opened_header(path, Limits()) as header:
        for reader in header.tiff:
            entries = reader.below(reader.directory(reader.first)[0].get(GPS))
            found = Directory()
            for tag, entry in entries.items():
                width = {3: 2, 4: 4, 5: 4, 8: 2, 9: 4, 10: 4}.get(entry.kind, 1)
                raw = entry.raw()
                if tag < MAX_TAGS and raw and len(raw) <= MAX_VALUE and entry.kind in _GPS_KINDS:
                    found.raw(
                        tag,
                        entry.kind,
                        np.frombuffer(raw, f"{entry.order}u{width}").astype(f"<u{width}").tobytes(),
                    )
            if found.entries:
                return found
    return None


def _places(buffer: Buffer, mark: bytes) -> Iterator[int]:
    """Yield where a mark stands; one more than is looked at."""
    at = -1
    for _ in range(MAX_BLOCKS + 1):
        at = buffer.find(mark, at + 1)
        if at < 0:
            return
        yield at


def _of_tiff(buffer: Buffer, reader: TiffReader) -> Iterator[Overwrite]:
    """Yield the GPS directories of a TIFF structure: of its chain, and of what hangs on that."""
    waiting, visited = [reader.first], set[int]()
    while waiting and len(visited) < MAX_DIRECTORIES:
        offset = waiting.pop()
        if offset in visited or offset <= 0:
            continue
        visited.add(offset)
        entries, following = reader.directory(offset)
        waiting.append(following)
        for tag in (SUB_DIRECTORIES, EXIF):
            if tag in entries:
                waiting += list(entries[tag].integers(MAX_DIRECTORIES))
        gps = entries[GPS].integer() if GPS in entries else None
        if gps is not None:
            yield from _directory(buffer, reader, gps)


def _directory(buffer: Buffer, reader: TiffReader, offset: int) -> Iterator[Overwrite]:
    """Yield what empties a GPS directory: its values that lie elsewhere, then its tags."""
    entries, _ = reader.directory(offset)
    count_size, entry_size = (8, 20) if reader.big else (2, 12)
    start = reader.base + offset
    head = bytes(buffer[start : start + count_size])
    count = struct.unpack(reader.order + ("Q" if reader.big else "H"), head)[0] if entries else 0
    end = start + count_size + count * entry_size
    if not 0 < count <= MAX_TAGS or end > len(buffer):
        return
    for entry in entries.values():
        far = not start <= entry.offset < end
        if far and 0 < entry.size <= MAX_VALUE and entry.raw():
            yield Overwrite(entry.offset, bytes(entry.size))
    yield Overwrite(start, bytes(end - start))


def _chunks(buffer: Buffer) -> list[tuple[bytes, int, int]]:
    """Name, start and length of a PNG's chunks, as far as it is whole."""
    chunks: list[tuple[bytes, int, int]] = []
    with contextlib.suppress(TruncatedImageError):
        chunks.extend(chunks_of(buffer))
    return chunks


def _is_packed(body: bytes, name: bytes) -> bool:
    """Whether a text chunk holds metadata in a form that cannot be searched."""
    if name not in {b"tEXt", b"zTXt", b"iTXt"}:
        return False
    keyword, _, rest = body[:120].partition(b"\0")
    return keyword.startswith(b"Raw profile type ") or (
        name == b"iTXt" and keyword == b"XML:com.adobe.xmp" and rest[:1] == b"\1"
    )


def _with_checksums(
    buffer: Buffer, chunks: Iterable[tuple[bytes, int, int]], spans: list[Overwrite]
) -> list[Overwrite]:
    """Renew the checksums of the chunks that change; hide those whose metadata cannot be searched."""
    renewed = list(spans)
    for name, start, length in chunks:
        if name == b"IDAT" or length > MAX_CHUNK_BYTES:
            continue
        if _is_packed(bytes(buffer[start : start + 120]), name):
            data = bytes(length)
            check = struct.pack(">I", zlib.crc32(_HIDDEN + data))
            renewed.append(Overwrite(start - 4, _HIDDEN + data + check))
            continue
        inside = [span for span in spans if start <= span.start < start + length]
        if inside:
            chunk = bytearray(buffer[start - 4 : start + length])
            for span in inside:
                at = span.start - start + 4
                chunk[at : at + len(span.data)] = span.data
            renewed.append(Overwrite(start + length, struct.pack(">I", zlib.crc32(chunk[: length + 4]))))
    return renewed
