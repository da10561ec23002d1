"""Directories of TIFF tags, read with bounds and written: the skeleton of TIFF, DNG, EXIF and most RAW files.

Every offset is checked against the buffer, loops end, no count makes us allocate more than `MAX_VALUE_BYTES`;
a directory that is damaged half-way gives what came before.

Source: "TIFF Revision 6.0", Aldus, 1992, section 2.
"""

from __future__ import annotations

import math
import mmap
import struct
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from typing import BinaryIO, Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

Buffer: TypeAlias = bytes | mmap.mmap

# Against files made to cost time or memory (chosen): entries of a directory, of which cameras write below
# 150; directories, of which they write a dozen; and bytes of a value.
MAX_ENTRIES, MAX_DIRECTORIES, MAX_VALUE_BYTES = 1024, 64, 16 << 20

ENTRY: Final = 12  # bytes of an entry of a directory

# Tags that point to directories: Exif 3.0, section 4.6.3, and TIFF/EP.
EXIF, GPS, SUB_DIRECTORIES = 0x8769, 0x8825, 0x014A

# Types of TIFF 6.0, section 2.
BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10

# Type -> format of `struct`: TIFF 6.0, section 2; 13 is an offset of a directory.
_FORMATS: Final[Mapping[int, str]] = {
    1: "B", 2: "s", 3: "H", 4: "I", 5: "II", 6: "b", 7: "s", 8: "h",
    9: "i", 10: "ii", 11: "f", 12: "d", 13: "I",
}  # fmt: skip
_SIZES: Final = {kind: struct.calcsize("=" + code) for kind, code in _FORMATS.items()}
_VERSIONS: Final = {42, 0x55, 0x4F52, 0x5352}  # TIFF, Panasonic RW2, and two of Olympus ORF


@dataclass(frozen=True, slots=True)
class Tag:
    """One tag of a directory; the value is read from the buffer when asked for."""

    kind: int
    count: int
    offset: int
    order: str
    buffer: Buffer = field(repr=False)

    @property
    def size(self) -> int:
        """Bytes that the value claims to have."""
        return self.count * _SIZES[self.kind]

    def raw(self) -> bytes:
        """Bytes of the value; empty if it lies outside the buffer or is too large."""
        end = self.offset + self.size
        if self.offset < 0 or self.size > MAX_VALUE_BYTES or end > len(self.buffer):
            return b""
        return bytes(self.buffer[self.offset : end])


class Tags(dict[int, Tag]):
    """The tags of a directory; one that is not there gives an empty value, or `None`."""

    def raw(self, tag: int) -> bytes:
        """Bytes of a value."""
        return self[tag].raw() if tag in self else b""

    def numbers(self, tag: int, most: int = MAX_VALUE_BYTES) -> tuple[float, ...]:
        """The first `most` values as numbers: rationals as quotients, NaN over zero; text gives none."""
        if tag not in self or (code := _FORMATS[self[tag].kind]) == "s":
            return ()
        raw = self.raw(tag)[: most * _SIZES[self[tag].kind]]
        count = len(raw) // struct.calcsize("=" + code[0])
        values = struct.unpack(f"{self[tag].order}{count}{code[0]}", raw)
        if len(code) == 1:
            return values
        pairs = zip(values[::2], values[1::2], strict=True)
        return tuple(float(Fraction(a, b)) if b else math.nan for a, b in pairs)

    def number(self, tag: int) -> float | None:
        """The first value; `None` also where it is not finite."""
        return next((value for value in self.numbers(tag, 1) if math.isfinite(value)), None)

    def integers(self, tag: int, most: int = MAX_VALUE_BYTES) -> tuple[int, ...]:
        """The first `most` values where they are whole numbers by their type; others give none."""
        whole = tag in self and _FORMATS[self[tag].kind] in "BHIbhi"
        return tuple(int(value) for value in self.numbers(tag, most)) if whole else ()

    def integer(self, tag: int, default: int = 0) -> int:
        """The first value where it is a whole number by its type."""
        return next(iter(self.integers(tag, 1)), default)

    def text(self, tag: int) -> str | None:
        """Text up to the first NUL, stripped; bytes outside UTF-8 read as Latin-1, nothing as `None`."""
        raw = self.raw(tag).split(b"\0", 1)[0]
        try:
            read = raw.decode("utf-8")
        except UnicodeDecodeError:
            read = raw.decode("latin-1")
        return read.strip() or None


@dataclass(frozen=True, slots=True)
class TiffReader:
    """Directories of a TIFF structure inside a buffer."""

    buffer: Buffer = field(repr=False)  # the bytes; offsets count from `base`
    base: int  # where the structure starts in the buffer
    order: str  # byte order
    first: int  # offset of the first directory from `base`, 0 without one

    @classmethod
    def open(cls, buffer: Buffer, base: int = 0) -> TiffReader:
        """Read the header at `base`; what is no TIFF structure has no directory."""
        head = bytes(buffer[base : base + 8]).ljust(8, b"\0")
        order = ">" if head[:2] == b"MM" else "<"
        version, first = struct.unpack(order + "HI", head[2:])
        known = head[:2] in {b"II", b"MM"} and version in _VERSIONS
        return cls(buffer, base, order, first if known else 0)

    def directory(self, offset: int) -> tuple[Tags, int]:
        """Read the directory at `offset` from `base`; its tags and the offset of the next, or 0."""
        start, tags = self.base + offset, Tags()
        head = bytes(self.buffer[start : start + 2]) if offset > 0 and start > 0 else b""
        if len(head) < 2:
            return tags, 0
        count, at = struct.unpack(self.order + "H", head)[0], start + 2
        table = bytes(self.buffer[at : at + ENTRY * min(count, MAX_ENTRIES)])
        entries = struct.iter_unpack(self.order + "HHII", table[: len(table) // ENTRY * ENTRY])
        for number, kind, values, far in entries:
            if kind in _FORMATS:
                place = at + 8 if values * _SIZES[kind] <= 4 else self.base + far
                tags.setdefault(number, Tag(kind, values, place, self.order, self.buffer))
            at += ENTRY
        tail = bytes(self.buffer[at : at + 4])
        complete = len(table) == count * ENTRY and len(tail) == 4
        return tags, struct.unpack(self.order + "I", tail)[0] if complete else 0

    def walk(self, *pointers: int) -> Iterator[tuple[int, Tags]]:
        """Yield place and tags of the first directory and of those that it and others point to, each once."""
        waiting, seen = [self.first], set[int]()
        while waiting and len(seen) < MAX_DIRECTORIES:
            offset = waiting.pop(0)
            if offset <= 0 or offset in seen:
                continue
            seen.add(offset)
            tags, following = self.directory(offset)
            if tags:
                yield offset, tags
            waiting.append(following)
            waiting += [below for tag in pointers for below in tags.integers(tag, MAX_DIRECTORIES)]

    def below(self, tags: Tags, pointer: int) -> Tags:
        """Read the directory that a tag (EXIF, GPS, part of a maker note) points to; empty without one."""
        return self.directory(tags.integer(pointer))[0]


# --- writing -----------------------------------------------------------------------------------

Value: TypeAlias = "tuple[int, bytes | str | float | Sequence[float] | None]"
"""Type and value of a tag to be written: text, one number or several, or their bytes, little-endian."""

Written: TypeAlias = Mapping[int, "Value | Written"]
"""Tags of a directory to be written, such as others below it; what is `None` or empty is left out."""


def laid_out(tags: Written) -> bytes:
    """Lay out a TIFF structure: its header, a directory, and those below it."""
    return b"II*\0\x08\0\0\0" + _packed(tags, 8)


def _packed(directory: Written, offset: int) -> bytes:
    """Lay a directory out to stand at `offset` of the file; long values and those below it right behind."""
    entries = [
        (tag, value)
        for tag, value in sorted(directory.items())
        if (value if isinstance(value, Mapping) else value[1] not in (None, "", b""))
    ]
    position = offset + 2 + ENTRY * len(entries) + 4
    head, tail = struct.pack("<H", len(entries)), b""
    for tag, value in entries:
        tail += bytes(len(tail) % 2)  # values begin on a word boundary
        place = position + len(tail)
        if isinstance(value, Mapping):
            kind, data, behind = LONG, struct.pack("<I", place), _packed(value, place)
        else:
            kind, data = value[0], _bytes_of(*value)
            behind = data if len(data) > 4 else b""
        head += struct.pack("<HHI", tag, kind, len(data) // _SIZES[kind])
        head += struct.pack("<I", place) if behind else data.ljust(4, b"\0")
        tail += behind
    return head + bytes(4) + tail


def _bytes_of(kind: int, value: bytes | str | float | Sequence[float] | None) -> bytes:
    """Bytes of a value: quotients a millionth off at most, text in ASCII with question marks for the rest."""
    if isinstance(value, bytes):
        return value
    if isinstance(value, str):
        return value.encode("ascii", "replace") + b"\0"
    numbers = [value] if isinstance(value, int | float) else [*(value or ())]
    if kind in {RATIONAL, SRATIONAL}:
        most, quotients = (2**32 if kind == RATIONAL else 2**31) - 1, list[float]()
        for number in numbers:
            finite = min(number, most)  # by which EXIF writes infinity
            part = Fraction(finite).limit_denominator(min(1_000_000, int(most / max(abs(finite), 1.0))))
            quotients += part.numerator, part.denominator
        numbers = quotients
    return struct.pack(f"<{len(numbers)}{_FORMATS[kind][0]}", *numbers)


def write_strip(file: BinaryIO, tags: Written, pixels: NDArray[np.generic]) -> None:
    """Write a TIFF structure and the pixels `(row, col[, channel])`, as one strip that is not compressed."""
    height, width = pixels.shape[:2]
    samples = pixels.shape[2] if pixels.ndim == 3 else 1
    whole: dict[int, Value | Written] = {
        **tags,
        256: (LONG, width),
        257: (LONG, height),
        258: (SHORT, [8 * pixels.dtype.itemsize] * samples),
        259: (SHORT, 1),  # not compressed
        273: (LONG, 0),
        277: (SHORT, samples),
        278: (LONG, height),
        279: (LONG, pixels.nbytes),
        284: (SHORT, 1),  # interleaved
    }
    at = len(laid_out(whole))
    at += -at % 16
    whole[273] = LONG, at
    file.write(laid_out(whole).ljust(at, b"\0"))
    file.write(np.ascontiguousarray(pixels).astype(pixels.dtype.newbyteorder("<"), copy=False).data)
