"""Directories of tags to be written: what a photo says of camera, lens, exposure, time, maker and rights.

No maker notes; the place (GPS) and serials only where they are asked for. Built here rather than by an image
library: those that write 16 bits a colour write no EXIF directory, and doubles, as others write, are empty
tags to some readers.

Sources: CIPA DC-008-2023 (Exif 3.0), sections 4.5 and 4.6; "TIFF Revision 6.0", Aldus, 1992, section 2.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Mapping, Sequence
from datetime import datetime
from fractions import Fraction
from typing import Final

from lensmodel.core.errors import InvalidInputError
from lensmodel.photo.values import PhotoMetadata

SOFTWARE: Final = "lensmodel"
START: Final = 8  # of the first directory, behind the TIFF header

# Tags that point to directories: Exif 3.0, section 4.6.3.
EXIF_POINTER: Final = 0x8769
GPS_POINTER: Final = 0x8825

# Types of TIFF 6.0, section 2, and their bytes.
BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
_SIZES: Final = {BYTE: 1, ASCII: 1, SHORT: 2, LONG: 4, RATIONAL: 8, UNDEFINED: 1, SRATIONAL: 8}
_MAX_UINT32: Final = 2**32 - 1  # largest number of a LONG; as a distance, infinity


class Directory:
    """Entries of one directory, by tag; little-endian."""

    def __init__(self) -> None:
        self.entries: dict[int, tuple[int, bytes]] = {}

    def raw(self, tag: int, kind: int, data: bytes) -> None:
        """Take a value as its bytes."""
        self.entries[tag] = (kind, data)

    def shorts(self, tag: int, *values: int) -> None:
        """Take numbers of 16 bits."""
        self.raw(tag, SHORT, struct.pack(f"<{len(values)}H", *values))

    def longs(self, tag: int, *values: int) -> None:
        """Take numbers of 32 bits."""
        self.raw(tag, LONG, struct.pack(f"<{len(values)}I", *values))

    def text(self, tag: int, value: str | None, encoding: str = "ascii") -> None:
        """Take a text; ASCII by the standard, what does not fit becomes a question mark."""
        if value:
            self.raw(tag, ASCII, value.encode(encoding, "replace") + b"\0")

    def date(self, tag: int, value: datetime | None) -> None:
        """Take the time of a camera's clock."""
        self.text(tag, None if value is None else value.strftime("%Y:%m:%d %H:%M:%S"))

    def rationals(self, tag: int, *values: float | None) -> None:
        """Take positive numbers as quotients; nothing unless all of them are known and fit."""
        parts = [None if value is None else _rational(value) for value in values]
        if None not in parts:
            self.raw(tag, RATIONAL, b"".join(struct.pack("<2I", *part) for part in parts if part))

    def signed_rationals(self, tag: int, values: Sequence[float]) -> None:
        """Take numbers as signed quotients."""
        parts = [Fraction(float(value)).limit_denominator(1_000_000) for value in values]
        self.raw(tag, SRATIONAL, b"".join(struct.pack("<2i", p.numerator, p.denominator) for p in parts))

    def packed(self, offset: int) -> bytes:
        """Lay it out to stand at `offset` of the file, its longer values right behind it."""
        position = offset + 2 + 12 * len(self.entries) + 4
        head, tail = [struct.pack("<H", len(self.entries))], b""
        for tag in sorted(self.entries):
            kind, data = self.entries[tag]
            field = data.ljust(4, b"\0")
            if len(data) > 4:
                tail += bytes(len(tail) % 2)  # values begin on a word boundary
                field = struct.pack("<I", position + len(tail))
                tail += data
            head.append(struct.pack("<HHI", tag, kind, len(data) // _SIZES[kind]) + field)
        return b"".join(head) + bytes(4) + tail


def laid_out(main: Directory, below: Mapping[int, Directory]) -> bytes:
    """Lay out a TIFF structure: its header, the main directory, and those that its tags point to."""
    below = {tag: directory for tag, directory in below.items() if directory.entries}
    for tag in below:
        main.longs(tag, 0)
    end, parts = START + len(main.packed(START)), []
    for tag, directory in below.items():
        parts.append(bytes(end % 2) + directory.packed(end + end % 2))
        main.longs(tag, end + end % 2)
        end += len(parts[-1])
    return struct.pack("<2sHI", b"II", 42, START) + main.packed(START) + b"".join(parts)


def main_directory(metadata: PhotoMetadata, orientation: int, description: str = "") -> Directory:
    """Tags of the main directory; names of people are UTF-8, as most programs read them."""
    tags = Directory()
    tags.text(0x010E, description)
    tags.text(0x010F, metadata.camera_maker)
    tags.text(0x0110, metadata.camera_model)
    tags.shorts(0x0112, orientation)
    tags.text(0x0131, SOFTWARE)
    tags.date(0x0132, metadata.taken_at)
    tags.text(0x013B, metadata.artist, "utf-8")
    tags.text(0x8298, metadata.copyright, "utf-8")
    if metadata.rating is not None and metadata.rating >= 0:
        tags.shorts(0x4746, metadata.rating)
    return tags


def exif_directory(metadata: PhotoMetadata) -> Directory:
    """Tags of the EXIF directory, without serials."""
    tags = Directory()
    tags.rationals(0x829A, metadata.exposure_s)
    tags.rationals(0x829D, metadata.aperture)
    if metadata.iso is not None:
        tags.shorts(0x8827, min(round(metadata.iso), 65535))
    tags.raw(0x9000, UNDEFINED, b"0232")  # ExifVersion
    tags.date(0x9003, metadata.taken_at)
    tags.rationals(0x9206, metadata.focus_m)
    tags.rationals(0x920A, metadata.focal_mm)
    if metadata.pixel_pitch_um is not None:
        per_cm = 10_000.0 / metadata.pixel_pitch_um
        tags.rationals(0xA20E, per_cm)  # FocalPlaneXResolution
        tags.rationals(0xA20F, per_cm)
        tags.shorts(0xA210, 3)  # per centimetre
    tags.text(0xA433, metadata.lens.maker)
    tags.text(0xA434, metadata.lens.model)
    return tags


def exif_block(
    metadata: PhotoMetadata, orientation: int, description: str = "", gps: Directory | None = None
) -> bytes:
    """Make a complete EXIF structure, from its TIFF header on."""
    main = main_directory(metadata, orientation, description)
    return laid_out(main, {EXIF_POINTER: exif_directory(metadata), GPS_POINTER: gps or Directory()})


def _rational(value: float) -> tuple[int, int] | None:
    """Quotient of a positive number, at most a millionth off; infinity as EXIF writes it."""
    if math.isinf(value):
        return _MAX_UINT32, 1
    for largest in (1_000_000, 10_000, 100, 1):
        part = Fraction(value).limit_denominator(largest)
        if 0 < part.numerator <= _MAX_UINT32:
            return part.numerator, part.denominator
    if 0.0 <= value < 1e-6:
        return 0, 1
    raise InvalidInputError(f"{value} does not fit a TIFF rational")
