"""JPEG headers. Source: ITU-T T.81, annex B."""

from __future__ import annotations

import statistics
import struct
from collections.abc import Iterator
from dataclasses import replace
from typing import Final

from lensmodel.core.errors import NotAnImageError, TruncatedImageError
from lensmodel.photo.headers.header import MAX_SEGMENTS, Header, check_size
from lensmodel.photo.headers.ifd import Buffer, TiffReader
from lensmodel.photo.values import Limits

# Second bytes of markers SOS, EOI and DQT: ITU-T T.81, table B.1.
_START_OF_SCAN: Final = 0xDA
_END_OF_IMAGE: Final = 0xD9
_TABLES: Final = 0xDB

_BARE: Final = {0x00, 0x01, *range(0xD0, 0xD9), 0xFF}
"""What is no segment: a stuffed byte, markers without a length, and fill bytes."""

_NO_FRAMES: Final = {0xC4, 0xC8, 0xCC}
"""Markers in the range of the frame headers that are none: tables and an extension."""


def read_jpeg(buffer: Buffer, limits: Limits) -> Header:
    """Read the segments up to the first scan: frame size, EXIF, XMP, ICC profile, quantisation."""
    header, icc_parts = Header("jpeg"), dict[int, bytes]()
    for at, code, body in _segments(buffer):
        if 0xC0 <= code <= 0xCF and code not in _NO_FRAMES:
            if len(body) < 6:
                raise TruncatedImageError("the JPEG's frame header is cut off")
            bits, height, width, channels = struct.unpack(">BHHB", body[:6])
            header = replace(
                header,
                width=width,
                height=height,
                channels=channels,
                bits=bits,
                chroma_step=_chroma_step(body[6:]),
            )
        elif code == _START_OF_SCAN:  # in which a zero follows a byte of 0xFF
            header = replace(header, whole=buffer.find(bytes((0xFF, _END_OF_IMAGE)), at) >= 0)
        elif code == _TABLES:
            header = replace(header, coarseness=_coarseness(body) or header.coarseness)
        elif body.startswith(b"Exif\0") and (reader := TiffReader.open(body, 6)):
            header = replace(header, tiff=(*header.tiff, reader))
        elif body.startswith(b"http://ns.adobe.com/xap/1.0/\0"):
            header = replace(header, xmp=body[29:])
        elif body.startswith(b"ICC_PROFILE\0") and len(body) > 14:
            icc_parts[body[12]] = body[14:]
    if not header.width or not header.height:
        raise NotAnImageError("the JPEG has no frame header, or one without a size")
    check_size(header.width, header.height, len(buffer), limits)
    icc = b"".join(part for _, part in sorted(icc_parts.items()))
    return replace(header, icc=icc or None)


def _chroma_step(components: bytes) -> tuple[int, int]:
    """Rows and columns of pixels that share a value of chroma: luma's sampling factors over chroma's."""
    if len(components) < 9:
        return 1, 1  # grey
    luma, chroma = components[1], components[4]
    # a factor that is no power of two occurs in no camera's file, and is none of chroma's business here
    rows, cols = (
        own // other if other else 1 for own, other in ((luma & 15, chroma & 15), (luma >> 4, chroma >> 4))
    )
    return (rows, cols) if {rows, cols} <= {1, 2, 4} else (1, 1)


def _coarseness(tables: bytes) -> float:
    """Median step of the first quantisation table, which cameras give to luma; 0 where it is not there."""
    at = 0
    while at < len(tables):
        size = 128 if tables[at] >> 4 else 64
        steps = tables[at + 1 : at + 1 + size]
        if tables[at] & 15 == 0 and len(steps) == size:
            return statistics.median(struct.unpack(">64H" if size == 128 else "64B", steps))
        at += 1 + size
    return 0.0


def _segments(buffer: Buffer) -> Iterator[tuple[int, int, bytes]]:
    """Yield place, marker code and content of each segment up to the first scan, which has none.

    Stray bytes between them are passed over, as viewers do (libjpeg, `next_marker`).
    """
    at = 2
    for _ in range(MAX_SEGMENTS):
        at = buffer.find(b"\xff", at)
        marker = b"" if at < 0 else bytes(buffer[at : at + 4])
        if len(marker) < 4:
            raise TruncatedImageError("the JPEG ends inside its header; the upload was cut off")
        code, length = marker[1], struct.unpack(">H", marker[2:])[0]
        if code == _START_OF_SCAN:
            yield at, code, b""
        if code in {_START_OF_SCAN, _END_OF_IMAGE}:
            return
        if code in _BARE:
            at += 1
            continue
        yield at, code, bytes(buffer[at + 4 : at + 2 + length])
        at += 2 + length
