"""The safe part of EXIF as bytes: camera, lens, exposure and time, and nothing else.

No GPS, no maker notes, no serials. Built here rather than by an image library so that
numbers are true rationals: a double, as some write, is read back by others as an empty tag.

Source: CIPA DC-008-2023 (Exif 3.0), sections 4.5 and 4.6.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Final

from lensmodel.photo.values import PhotoMetadata

SOFTWARE: Final = "lensmodel"
SOFTWARE_TAG: Final = 0x0131  # TIFF 6.0, section 8
EXIF_POINTER: Final = 0x8769  # Exif 3.0, section 4.6.3

# Types of Exif 3.0, section 4.6.2.
_ASCII, _SHORT, _LONG, _RATIONAL, _UNDEFINED = 2, 3, 4, 5, 7


@dataclass(frozen=True, slots=True)
class Field:
    """One tag to be written, little-endian."""

    tag: int
    kind: int
    count: int
    data: bytes


def text(tag: int, value: str | None) -> list[Field]:
    """Field of ASCII text; none for none."""
    if not value:
        return []
    data = value.encode("ascii", "replace") + b"\0"
    return [Field(tag, _ASCII, len(data), data)]


def short(tag: int, value: float | None) -> list[Field]:
    """Field of one 16-bit number, held at 65535."""
    return [] if value is None else [Field(tag, _SHORT, 1, struct.pack("<H", min(round(value), 65535)))]


def rational(tag: int, value: float | None) -> list[Field]:
    """Field of one quotient with a denominator up to 10000, finer for short times."""
    if value == math.inf:
        return [Field(tag, _RATIONAL, 1, struct.pack("<II", 2**32 - 1, 1))]  # EXIF's word for infinity
    if value is None or not 0 < value < 2**31:
        return []
    limit = 10_000 if value >= 1e-3 else 2**31
    quotient = Fraction(value).limit_denominator(limit)
    return [Field(tag, _RATIONAL, 1, struct.pack("<II", quotient.numerator, quotient.denominator))]


def pointer(offset: int) -> Field:
    """Field by which the main directory points to the EXIF directory."""
    return Field(EXIF_POINTER, _LONG, 1, struct.pack("<I", offset))


def main_fields(metadata: PhotoMetadata, orientation: int, description: str) -> list[Field]:
    """Tags of the main directory."""
    return [
        *text(0x010E, description),
        *text(0x010F, metadata.camera_maker),
        *text(0x0110, metadata.camera_model),
        *short(0x0112, orientation),
        *text(SOFTWARE_TAG, SOFTWARE),
    ]


def exif_fields(metadata: PhotoMetadata) -> list[Field]:
    """Tags of the EXIF directory."""
    when = metadata.taken_at
    return [
        *rational(0x829A, metadata.exposure_s),
        *rational(0x829D, metadata.aperture),
        *short(0x8827, metadata.iso),
        Field(0x9000, _UNDEFINED, 4, b"0232"),
        *text(0x9003, None if when is None else when.strftime("%Y:%m:%d %H:%M:%S")),
        *rational(0x9206, metadata.focus_m),
        *rational(0x920A, metadata.focal_mm),
        *text(0xA433, metadata.lens.maker),
        *text(0xA434, metadata.lens.model),
    ]


def directory(fields: Sequence[Field], offset: int) -> bytes:
    """Lay out a directory that will stand at `offset` of its file, with its values behind it."""
    table, values = struct.pack("<H", len(fields)), b""
    values_at = offset + 2 + 12 * len(fields) + 4
    for field in sorted(fields, key=lambda f: f.tag):
        inline = field.data.ljust(4, b"\0")
        if len(field.data) > 4:
            inline = struct.pack("<I", values_at + len(values))
            values += field.data + bytes(len(field.data) % 2)
        table += struct.pack("<HHI", field.tag, field.kind, field.count) + inline
    return table + struct.pack("<I", 0) + values


def exif_block(metadata: PhotoMetadata, orientation: int, description: str = "") -> bytes:
    """Make a complete EXIF structure, from its TIFF header on.

    Parameters
    ----------
    metadata : PhotoMetadata
        What to write; serials in it are left out.
    orientation : int
        EXIF orientation of the pixels as written.
    description : str
        Goes into ImageDescription; signs outside ASCII become "?".
    """
    main = main_fields(metadata, orientation, description)
    exif_at = 8 + len(directory([*main, pointer(0)], 8))
    return (
        b"II*\0\x08\0\0\0"
        + directory([*main, pointer(exif_at)], 8)
        + directory(exif_fields(metadata), exif_at)
    )
