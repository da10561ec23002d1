"""Maker notes: the makers' own tags, read only for what EXIF leaves out.

The layouts are undocumented by their makers; tag numbers as published by ExifTool's tag
tables (P. Harvey) and checked against files of these cameras. A note that does not look as
expected gives nothing.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from lensmodel.photo.tiff import Tag, Tags, TiffReader


@dataclass(frozen=True, slots=True)
class MakerNote:
    """What a maker note adds to EXIF; `None` is unknown."""

    lens_model: str | None = None
    lens_serial: str | None = None
    body_serial: str | None = None
    focus_m: float | None = None
    iso: float | None = None


def read_maker_note(maker: str, note: Tag | None, reader: TiffReader) -> MakerNote:
    """Read the maker note of EXIF tag 0x927C."""
    if note is None:
        return MakerNote()
    head = bytes(reader.buffer[note.offset : note.offset + 16])
    for magic, word, parse in _LAYOUTS:
        if head.startswith(magic) and maker.lower().startswith(word):
            return parse(note, reader)
    return MakerNote()


def _canon(note: Tag, reader: TiffReader) -> MakerNote:
    # Canon ends its notes with a TIFF header of its own byte order whose offset is the note's original place:
    # a program may have moved the note without rewriting its offsets.
    footer = TiffReader.open(reader.buffer, note.offset + note.size - 8)
    if footer is not None:
        reader = TiffReader(reader.buffer, note.offset - footer.first, footer.order, footer.first)
    tags, _ = reader.directory(note.offset - reader.base)
    # Five bytes, of which exiftool prints ten hexadecimal digits; the number is in the last
    # four, and all zero (as "1c00000000") where the lens has none.
    serial = tags.raw(0x4019)[:5]
    return MakerNote(
        lens_model=tags.text(0x0095),
        lens_serial=serial.hex() if len(serial) == 5 and any(serial[1:]) else None,
        focus_m=_canon_focus(tags, 0x0093, 20) or _canon_focus(tags, 0x0004, 19),
    )


def _canon_focus(tags: Tags, tag: int, index: int) -> float | None:
    """Geometric mean of the far and near bounds that Canon gives, in metres; `None` without both."""
    raw = tags.raw(tag)[2 * index : 2 * index + 4]
    far, near = struct.unpack(tags[tag].order + "HH", raw) if len(raw) == 4 else (0, 0)
    if near == 0 or far < near:
        return None
    return math.inf if far == 65535 else math.sqrt(far * near) / 100.0


def _olympus(note: Tag, reader: TiffReader) -> MakerNote:
    head, first = bytes(reader.buffer[note.offset : note.offset + 16]), note.offset - reader.base + 8
    if not head.startswith(b"OLYMP\0"):  # of which the offsets count from the file's TIFF header
        first = 12 if head.startswith(b"OLYMPUS\0") else 16
        order = {b"II": "<", b"MM": ">"}.get(head[first - 4 : first - 2])
        if order is None:
            return MakerNote()
        reader = TiffReader(reader.buffer, note.offset, order, first)
    tags, _ = reader.directory(first)
    equipment, focus = (_olympus_part(reader, tags, pointer) for pointer in (0x2010, 0x2050))
    # Millimetres over 1 in some models, centimetres over 10 in others: the numerator is in mm.
    millimetres = int.from_bytes(focus.raw(0x0305)[:4], "little" if reader.order == "<" else "big")
    return MakerNote(
        lens_model=equipment.text(0x0203),
        lens_serial=equipment.text(0x0202),
        body_serial=equipment.text(0x0101),
        focus_m=(math.inf if millimetres == 0xFFFFFFFF else millimetres / 1000.0) or None,
    )


def _olympus_part(reader: TiffReader, tags: Tags, pointer: int) -> Tags:
    """Read a sub-directory, given by a pointer or, in older notes, in place."""
    if pointer in tags and tags[pointer].count != 1:
        return reader.directory(tags[pointer].offset - reader.base)[0]
    return reader.below(tags, pointer)


def _nikon(note: Tag, reader: TiffReader) -> MakerNote:
    inner = TiffReader.open(reader.buffer, note.offset + 10)
    return MakerNote() if inner is None else _nikon_tags(inner.directory(inner.first)[0])


def _first_nikon(note: Tag, reader: TiffReader) -> MakerNote:
    return _nikon_tags(reader.directory(note.offset - reader.base)[0])


def _nikon_tags(tags: Tags) -> MakerNote:
    speeds = tags.numbers(0x0002)
    return MakerNote(
        body_serial=tags.text(0x001D), iso=speeds[1] if len(speeds) == 2 and speeds[1] > 0 else None
    )


def _panasonic(note: Tag, reader: TiffReader) -> MakerNote:
    tags, _ = reader.directory(note.offset - reader.base + 12)
    return MakerNote(lens_model=tags.text(0x0051), lens_serial=tags.text(0x0052))


_LAYOUTS: Final[tuple[tuple[bytes, str, Callable[[Tag, TiffReader], MakerNote]], ...]] = (
    (b"OLYMP", "", _olympus),
    (b"OM SYSTEM\0\0\0", "", _olympus),
    (b"Nikon\0\x02", "", _nikon),
    (b"Panasonic\0\0\0", "", _panasonic),
    (b"", "canon", _canon),
    (b"", "nikon", _first_nikon),
)
"""First bytes of a note, and of the maker's name, by which its layout is known."""
