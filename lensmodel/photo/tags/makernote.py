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

from lensmodel.photo.headers.ifd import IfdEntry, TiffReader

_CENTIMETRES_INFINITY: Final = 65535  # Canon's word for infinity


@dataclass(frozen=True, slots=True)
class MakerNote:
    """What a maker note adds to EXIF; `None` is unknown."""

    lens_model: str | None = None
    lens_serial: str | None = None
    body_serial: str | None = None
    focus_m: float | None = None
    iso: float | None = None


def read_maker_note(maker: str, note: IfdEntry | None, reader: TiffReader) -> MakerNote:
    """Read the maker note of EXIF tag 0x927C."""
    if note is None:
        return MakerNote()
    head = bytes(reader.buffer[note.offset : note.offset + 16])
    for magic, parse in _BY_MAGIC:
        if head.startswith(magic):
            return parse(note, reader)
    by_maker = next((parse for word, parse in _BY_MAKER if maker.lower().startswith(word)), None)
    return by_maker(note, reader) if by_maker else MakerNote()


def _text(entry: IfdEntry | None) -> str | None:
    return None if entry is None else entry.text() or None


def _canon(note: IfdEntry, reader: TiffReader) -> MakerNote:
    reader = _unmoved(note, reader)
    tags, _ = reader.directory(note.offset - reader.base)
    serial = None
    if 0x4019 in tags:
        # Five bytes, of which exiftool prints ten hexadecimal digits; the number is in the last
        # four, and all zero (as "1c00000000") where the lens has none.
        info = tags[0x4019].raw()[:5]
        serial = info.hex() if len(info) == 5 and any(info[1:]) else None
    focus = _canon_focus(tags.get(0x0093), 20) or _canon_focus(tags.get(0x0004), 19)
    return MakerNote(lens_model=_text(tags.get(0x0095)), lens_serial=serial, focus_m=focus)


def _unmoved(note: IfdEntry, reader: TiffReader) -> TiffReader:
    """Correct the base of the offsets where a program moved the note without rewriting them.

    Canon ends its notes with a TIFF header of its own byte order whose offset is the note's
    original place.
    """
    end = note.offset + note.size
    if (footer := TiffReader.open(reader.buffer, end - 8)) is None:
        return reader
    return TiffReader(reader.buffer, note.offset - footer.first, footer.order, footer.first)


def _canon_focus(entry: IfdEntry | None, index: int) -> float | None:
    """Geometric mean of the far and near bounds that Canon gives, in metres; `None` without both."""
    raw = b"" if entry is None else entry.raw()[2 * index : 2 * index + 4]
    if entry is None or len(raw) < 4:
        return None
    far, near = struct.unpack(entry.order + "HH", raw)
    if near == 0 or far < near:
        return None
    return float("inf") if far == _CENTIMETRES_INFINITY else float(math.sqrt(far * near)) / 100.0


def _olympus(note: IfdEntry, reader: TiffReader) -> MakerNote:
    head = bytes(reader.buffer[note.offset : note.offset + 16])
    if head.startswith(b"OLYMP\0"):  # old: offsets count from the file's TIFF header
        inner, first = reader, note.offset - reader.base + 8
    else:
        start = 12 if head.startswith(b"OLYMPUS\0") else 16
        order = {b"II": "<", b"MM": ">"}.get(head[start - 4 : start - 2])
        if order is None:
            return MakerNote()
        inner, first = TiffReader(reader.buffer, note.offset, order, start), start
    tags, _ = inner.directory(first)
    equipment, focus = _olympus_part(inner, tags.get(0x2010)), _olympus_part(inner, tags.get(0x2050))
    # Millimetres over 1 in some models, centimetres over 10 in others: the numerator is in mm.
    distance = (
        int.from_bytes(focus[0x0305].raw()[:4], "little" if inner.order == "<" else "big")
        if 0x0305 in focus
        else 0
    )
    return MakerNote(
        lens_model=_text(equipment.get(0x0203)),
        lens_serial=_text(equipment.get(0x0202)),
        body_serial=_text(equipment.get(0x0101)),
        focus_m=_metres(distance),
    )


def _metres(millimetres: int) -> float | None:
    if not millimetres:
        return None
    return float("inf") if millimetres == 0xFFFFFFFF else millimetres / 1000.0


def _olympus_part(reader: TiffReader, entry: IfdEntry | None) -> dict[int, IfdEntry]:
    """Read a sub-directory, given by a pointer or, in older notes, in place."""
    if entry is None:
        return {}
    if entry.count == 1:
        return reader.below(entry)
    return reader.directory(entry.offset - reader.base)[0]


def _nikon(note: IfdEntry, reader: TiffReader) -> MakerNote:
    inner = TiffReader.open(reader.buffer, note.offset + 10)
    if inner is None:
        return MakerNote()
    tags, _ = inner.directory(inner.first)
    return MakerNote(body_serial=_text(tags.get(0x001D)), iso=_nikon_iso(tags.get(0x0002)))


def _nikon_first(note: IfdEntry, reader: TiffReader) -> MakerNote:
    tags, _ = reader.directory(note.offset - reader.base)
    return MakerNote(iso=_nikon_iso(tags.get(0x0002)))


def _nikon_iso(entry: IfdEntry | None) -> float | None:
    values = () if entry is None else entry.numbers()
    return values[1] if len(values) == 2 and values[1] > 0 else None


def _panasonic(note: IfdEntry, reader: TiffReader) -> MakerNote:
    tags, _ = reader.directory(note.offset - reader.base + 12)
    return MakerNote(lens_model=_text(tags.get(0x0051)), lens_serial=_text(tags.get(0x0052)))


_Parser = Callable[[IfdEntry, TiffReader], MakerNote]
_BY_MAGIC: Final[tuple[tuple[bytes, _Parser], ...]] = (
    (b"OLYMP", _olympus),
    (b"OM SYSTEM\0\0\0", _olympus),
    (b"Nikon\0\x02", _nikon),
    (b"Panasonic\0\0\0", _panasonic),
)
_BY_MAKER: Final[tuple[tuple[str, _Parser], ...]] = (("canon", _canon), ("nikon", _nikon_first))
