"""TIFF directories, read with bounds: the skeleton of TIFF, DNG, EXIF and most RAW files.

Every offset is checked against the buffer, loops end, and no count makes us allocate more
than `MAX_VALUE_BYTES`. A directory that is damaged half-way gives what came before.

Source: "TIFF Revision 6.0", Aldus, 1992, section 2; "The BigTIFF file format", 2004.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from fractions import Fraction
from typing import Final, TypeAlias

Buffer: TypeAlias = bytes | mmap.mmap

MAX_ENTRIES: Final = 1024
"""Entries read of one directory: cameras write below 150, and a false count must not cost time (chosen)."""

MAX_DIRECTORIES: Final = 64
"""Directories followed: cameras write a dozen, and a tree must not cost time (chosen)."""

MAX_VALUE_BYTES: Final = 16 << 20
"""Bytes read of one value: honest ones are smaller, a false size must not fill the memory (chosen)."""

# Type -> format of `struct`: TIFF 6.0, section 2, and from 16 on BigTIFF; 13 is an offset of a directory.
_FORMATS: Final[Mapping[int, str]] = {
    1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h",
    9: "i", 10: "ii", 11: "f", 12: "d", 13: "I", 16: "Q", 17: "q", 18: "Q",
}  # fmt: skip
_MAGIC: Final = {42: False, 43: True, 0x55: False, 0x4F52: False, 0x5352: False}
"""Version word -> is BigTIFF; the last three are Panasonic RW2 and Olympus ORF."""


@dataclass(frozen=True, slots=True)
class IfdEntry:
    """One tag of a directory; the value is read from the buffer when asked for."""

    kind: int
    count: int
    offset: int
    order: str
    buffer: Buffer = field(repr=False)

    @property
    def size(self) -> int:
        """Bytes that the value claims to have."""
        return self.count * struct.calcsize("=" + _FORMATS[self.kind])

    def raw(self) -> bytes:
        """Bytes of the value; empty if it lies outside the buffer or is too large."""
        end = self.offset + self.size
        if self.offset < 0 or self.size > MAX_VALUE_BYTES or end > len(self.buffer):
            return b""
        return bytes(self.buffer[self.offset : end])

    def numbers(self, most: int = MAX_VALUE_BYTES) -> tuple[float, ...]:
        """The first `most` values as numbers: rationals as quotients, NaN over zero; text gives none."""
        code, raw = _FORMATS[self.kind], self.raw()
        if code == "s":
            return ()
        raw = raw[: most * struct.calcsize("=" + code)]
        values = struct.unpack(f"{self.order}{len(raw) // struct.calcsize('=' + code[0])}{code[0]}", raw)
        if len(code) == 1:
            return values
        pairs = zip(values[::2], values[1::2], strict=True)
        return tuple(float(Fraction(a, b)) if b else float("nan") for a, b in pairs)

    def number(self) -> float | None:
        """First value as a number, `None` where there is none or it is not finite."""
        values = self.numbers(1)
        return values[0] if values and abs(values[0]) < float("inf") else None

    def integer(self) -> int | None:
        """First value as an integer."""
        value = self.number()
        return None if value is None else int(value)

    def integers(self, most: int = MAX_VALUE_BYTES) -> tuple[int, ...]:
        """The first `most` values where they are whole numbers by their type; others give none."""
        return tuple(int(v) for v in self.numbers(most)) if _FORMATS[self.kind] in "BHIbhiQq" else ()

    def text(self) -> str:
        """Value as text up to the first NUL, stripped; bytes outside UTF-8 read as Latin-1."""
        raw = self.raw().split(b"\0", 1)[0]
        try:
            return raw.decode("utf-8").strip()
        except UnicodeDecodeError:
            return raw.decode("latin-1").strip()


Directory: TypeAlias = Mapping[int, IfdEntry]


@dataclass(frozen=True, slots=True)
class TiffReader:
    """Directories of a TIFF structure inside a buffer."""

    buffer: Buffer = field(repr=False)  # the bytes; offsets count from `base`
    base: int  # where the structure starts in the buffer
    order: str  # byte order
    first: int  # offset of the first directory from `base`
    big: bool = False  # BigTIFF: 64-bit offsets

    @classmethod
    def open(cls, buffer: Buffer, base: int = 0) -> TiffReader | None:
        """Read the header at `base`; `None` if it is no TIFF structure."""
        head = bytes(buffer[base : base + 16])
        order = {b"II": "<", b"MM": ">"}.get(head[:2])
        if order is None or len(head) < 8:
            return None
        version = struct.unpack(order + "H", head[2:4])[0]
        if version not in _MAGIC:
            return None
        if not _MAGIC[version]:
            return cls(buffer, base, order, struct.unpack(order + "I", head[4:8])[0])
        if len(head) < 16:
            return None
        return cls(buffer, base, order, struct.unpack(order + "Q", head[8:16])[0], big=True)

    def directory(self, offset: int) -> tuple[dict[int, IfdEntry], int]:
        """Read the directory at `offset` from `base`; its tags and the offset of the next, or 0."""
        count_size, entry_size, word = (8, 20, "Q") if self.big else (2, 12, "I")
        word_size = struct.calcsize("=" + word)
        start = self.base + offset
        head = bytes(self.buffer[start : start + count_size]) if offset > 0 and start > 0 else b""
        if len(head) < count_size:
            return {}, 0
        count = struct.unpack(self.order + ("Q" if self.big else "H"), head)[0]
        entries: dict[int, IfdEntry] = {}
        at = start + count_size
        for _ in range(min(count, MAX_ENTRIES)):
            raw = bytes(self.buffer[at : at + entry_size])
            if len(raw) < entry_size:
                return entries, 0
            tag, kind, number = struct.unpack(f"{self.order}HH{word}", raw[: 4 + word_size])
            if kind in _FORMATS:
                size = number * struct.calcsize("=" + _FORMATS[kind])
                inline = at + 4 + word_size
                far = self.base + struct.unpack(self.order + word, raw[-word_size:])[0]
                place = inline if size <= word_size else far
                entries.setdefault(tag, IfdEntry(kind, number, place, self.order, self.buffer))
            at += entry_size
        tail = bytes(self.buffer[at : at + word_size])
        complete = count <= MAX_ENTRIES and len(tail) == word_size
        return entries, struct.unpack(self.order + word, tail)[0] if complete else 0

    def chain(self) -> Iterator[tuple[int, dict[int, IfdEntry]]]:
        """Yield place and tags of the directories linked from the first one; a loop ends the chain."""
        offset, seen = self.first, set[int]()
        while offset and offset not in seen and len(seen) < MAX_DIRECTORIES:
            seen.add(offset)
            entries, following = self.directory(offset)
            if entries:
                yield offset, entries
            offset = following

    def below(self, entry: IfdEntry | None) -> dict[int, IfdEntry]:
        """Read the directory that a pointer tag (EXIF, maker note part) points to; empty without one."""
        offset = None if entry is None else entry.integer()
        return {} if offset is None else self.directory(offset)[0]
