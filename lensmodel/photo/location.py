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
from itertools import islice
from pathlib import Path
from typing import Final, NamedTuple

import numpy as np

from lensmodel.core.errors import TruncatedImageError
from lensmodel.photo.containers import MAX_BLOCK_BYTES, opened_header, png_chunks
from lensmodel.photo.tiff import ENTRY, EXIF, GPS, SUB_DIRECTORIES, Buffer, TiffReader, Value
from lensmodel.photo.values import Limits

# Bounds against files made to cost time (chosen): Exif blocks, of which a photo has one and each preview;
# tags of GPS, of which there are 32; bytes of a value, of which honest ones have some dozen; words of XMP.
MAX_BLOCKS, MAX_TAGS, MAX_VALUE, MAX_WORDS = 64, 64, 1 << 16, 1000

_WIDTHS: Final = {1: 1, 2: 1, 3: 2, 4: 4, 5: 4, 7: 1, 10: 4}  # type of a GPS tag -> bytes of its numbers
_BLOCKS: Final = re.compile(rb"Exif\0\0|CMT4")  # before a TIFF structure; the latter in CR3, of GPS alone
_VALUE: Final = rb'(?:\s*=\s*(?:"([^"<>]{0,200})"|\'([^\'<>]{0,200})\')|\s*>([^<>]{0,200})<)'
_XMP_GPS: Final = re.compile(rb":[Gg][Pp][Ss]\w{1,40}" + _VALUE)
"""`exif:GPSLatitude` as attribute or element, and the like that drones write in names of their own."""

_PACKED: Final = re.compile(rb"Raw profile type |XML:com\.adobe\.xmp\x00\x01")
"""How the text of a PNG chunk begins that holds metadata in a form that cannot be searched."""

_HIDDEN: Final = b"prVt"  # type of a chunk that every reader skips: ancillary, private, safe to copy


class Overwrite(NamedTuple):
    """Bytes to be written over others of the same number."""

    start: int
    data: bytes


def find_location(buffer: Buffer) -> tuple[list[Overwrite], bool]:
    """Find what removes the place where a photo was taken, and whether all of the file was looked at.

    Not found: names of places in IPTC blocks and maker notes, and anything inside compressed blocks other
    than those of PNG.
    """
    spans, chunks = list[Overwrite](), list[tuple[bytes, int, int]]()
    if buffer[:4] == b"\x89PNG":
        with contextlib.suppress(TruncatedImageError):
            chunks.extend(png_chunks(buffer))
    for place in (0, *(start for name, start, _ in chunks if name == b"eXIf")):
        if reader := TiffReader.open(buffer, place):
            spans += _of_tiff(buffer, reader)
    blocks = list(islice(_BLOCKS.finditer(buffer), MAX_BLOCKS + 1))
    for block in blocks[:MAX_BLOCKS]:
        if reader := TiffReader.open(buffer, block.end()):
            of_gps = block[0] == b"CMT4"
            spans += _directory(buffer, reader, reader.first) if of_gps else _of_tiff(buffer, reader)
    words = list(islice(_XMP_GPS.finditer(buffer), MAX_WORDS + 1))
    for match in words[:MAX_WORDS]:
        start, end = match.span(match.lastindex or 0)
        spans.append(Overwrite(start, b" " * (end - start)))
    spans = [span for span in spans if bytes(buffer[span.start : span.start + len(span.data)]) != span.data]
    complete = len(blocks) <= MAX_BLOCKS and len(words) <= MAX_WORDS
    return _with_checksums(buffer, chunks, spans), complete


def gps_directory(path: Path) -> dict[int, Value]:
    """Read the GPS directory of a photo, to be written into another file of it; empty without one."""
    with opened_header(path, Limits()) as header:
        for reader in header.tiff:
            values = dict[int, Value]()
            for tag, entry in reader.below(reader.directory(reader.first)[0], GPS).items():
                width = _WIDTHS.get(entry.kind)
                if tag < MAX_TAGS and width and 0 < entry.size <= MAX_VALUE and (raw := entry.raw()):
                    numbers = np.frombuffer(raw, f"{entry.order}u{width}").astype(f"<u{width}")
                    values[tag] = entry.kind, numbers.tobytes()
            if values:
                return values
    return {}


def _of_tiff(buffer: Buffer, reader: TiffReader) -> Iterator[Overwrite]:
    """Yield the GPS directories of a TIFF structure: of its chain, and of what hangs on that."""
    for _, tags in reader.walk(SUB_DIRECTORIES, EXIF):
        yield from _directory(buffer, reader, tags.integer(GPS))


def _directory(buffer: Buffer, reader: TiffReader, offset: int) -> Iterator[Overwrite]:
    """Yield what empties a GPS directory: its values that lie elsewhere, then its tags."""
    tags, _ = reader.directory(offset)
    start = reader.base + offset
    head = bytes(buffer[start : start + 2]) if tags else b""
    count = int.from_bytes(head, "little" if reader.order == "<" else "big")
    end = start + 2 + count * ENTRY
    if not 0 < count <= MAX_TAGS or end > len(buffer):
        return
    for entry in tags.values():
        if not start <= entry.offset < end and 0 < entry.size <= MAX_VALUE and entry.raw():
            yield Overwrite(entry.offset, bytes(entry.size))
    yield Overwrite(start, bytes(end - start))


def _with_checksums(
    buffer: Buffer, chunks: Iterable[tuple[bytes, int, int]], spans: list[Overwrite]
) -> list[Overwrite]:
    """Renew the checksums of a PNG's chunks that change; hide those whose metadata cannot be searched."""
    renewed = list(spans)
    for name, start, length in chunks:
        if name == b"IDAT" or length > 2 * MAX_BLOCK_BYTES:
            continue
        chunk = bytearray(buffer[start - 4 : start + length])
        if name in {b"tEXt", b"zTXt", b"iTXt"} and _PACKED.match(chunk, 4):
            chunk = bytearray(_HIDDEN + bytes(length))
            renewed.append(Overwrite(start - 4, bytes(chunk)))
        else:
            inside = [span for span in spans if start <= span.start < start + length]
            if not inside:
                continue
            for span in inside:
                at = span.start - start + 4
                chunk[at : at + len(span.data)] = span.data
        renewed.append(Overwrite(start + length, struct.pack(">I", zlib.crc32(chunk[: length + 4]))))
    return renewed
