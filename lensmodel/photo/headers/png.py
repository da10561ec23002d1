"""PNG headers. Source: "Portable Network Graphics, third edition", W3C, 2025, sections 5 and 11."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import replace

from lensmodel.core.errors import NotAnImageError, TruncatedImageError
from lensmodel.photo.colour import profile_by_chunks
from lensmodel.photo.headers.header import MAX_BLOCK_BYTES, MAX_SEGMENTS, Header, check_size
from lensmodel.photo.headers.ifd import Buffer, TiffReader
from lensmodel.photo.values import Limits


def read_png(buffer: Buffer, limits: Limits) -> Header:
    """Read the chunks; image data are skipped, not read."""
    first = bytes(buffer[8:33])
    if len(first) < 25:
        raise TruncatedImageError("the PNG ends inside its header; the upload was cut off")
    if first[4:8] != b"IHDR" or zlib.crc32(first[4:21]) != struct.unpack(">I", first[21:])[0]:
        raise NotAnImageError("the PNG's header chunk is damaged")
    width, height, bits, colour = struct.unpack(">IIBB", first[8:18])
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(colour, 0)
    if not (width and height and channels and bits in {1, 2, 4, 8, 16}):
        raise NotAnImageError(
            f"the PNG's header is impossible: {width} x {height}, {bits} bits, type {colour}"
        )
    check_size(width, height, len(buffer), limits)
    header, has_data, colour = Header("png", width, height, channels, bits), False, dict[bytes, bytes]()
    for name, start, length in chunks_of(buffer):
        has_data = has_data or name == b"IDAT"
        if name in {b"eXIf", b"iTXt", b"iCCP"} and length <= MAX_BLOCK_BYTES:
            header = _with_chunk(header, name, bytes(buffer[start : start + length]))
        elif name in {b"cICP", b"sRGB", b"gAMA", b"cHRM"} and length <= 32:
            colour[name] = bytes(buffer[start : start + length])
    if not has_data:
        raise TruncatedImageError("the PNG has no image data")
    return replace(header, icc=profile_by_chunks(header.icc, colour))


def chunks_of(buffer: Buffer) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, start and length of the chunks; of a run of image data only the first."""
    at, count, before = 33, 0, b"IHDR"
    while count < MAX_SEGMENTS:
        head = bytes(buffer[at : at + 8])
        if len(head) < 8:
            raise TruncatedImageError("the PNG ends before its end chunk; the upload was cut off")
        length, name = struct.unpack(">I4s", head)
        if at + 12 + length > len(buffer):
            raise TruncatedImageError(f"the PNG ends inside chunk {name!r}; the upload was cut off")
        if name == b"IEND":
            return
        if not name == before == b"IDAT":
            count += 1
            yield name, at + 8, length
        before, at = name, at + 12 + length


def _with_chunk(header: Header, name: bytes, body: bytes) -> Header:
    if name == b"eXIf" and (reader := TiffReader.open(body)):
        return replace(header, tiff=(*header.tiff, reader))
    if name == b"iCCP":
        rest = body.partition(b"\0")[2]
        return replace(header, icc=_inflated(rest[1:]))
    if name == b"iTXt" and body.startswith(b"XML:com.adobe.xmp\0"):
        packed, rest = body[18:19] == b"\1", body[20:]
        text = rest.partition(b"\0")[2].partition(b"\0")[2]
        return replace(header, xmp=_inflated(text) if packed else text)
    return header


def _inflated(packed: bytes) -> bytes | None:
    """Decompress at most `MAX_BLOCK_BYTES`; `None` where there is more, or damage."""
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(packed, MAX_BLOCK_BYTES)
    except zlib.error:
        return None
    return data if inflater.eof else None
