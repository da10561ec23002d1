"""What a photo file says of its picture, before a pixel is decoded: kind, size, and where its metadata lie.

Sources: ITU-T T.81, annex B; ICC.1:2022, annex B.4 (profiles in a JPEG); "Portable Network Graphics, third
edition", W3C, 2025, sections 4.3, 5 and 11; "TIFF Revision 6.0", Aldus, 1992; Adobe, "Digital Negative (DNG)
Specification" 1.6, 2021; CIFF 1.0, 1997.
"""

from __future__ import annotations

import contextlib
import io
import math
import mmap
import re
import statistics
import struct
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from pathlib import Path
from typing import BinaryIO, Final, TypeAlias, cast

import numpy as np
from numpy.typing import NDArray
from PIL.JpegImagePlugin import JpegImageFile

from lensmodel.core import errors
from lensmodel.photo.values import FileKind, Limits

HEAD_BYTES: Final = 64  # that `sniff` wants to see
MAX_BLOCK_BYTES: Final = 8 << 20  # largest ICC profile or XMP packet that is read
BOMB_MEGAPIXELS: Final = 4.0  # below this a false claim costs nothing worth refusing
BOMB_PIXELS_PER_BYTE: Final = 200.0  # an evenly grey JPEG reaches 100, and a photograph is never evenly grey
MAX_CHUNKS: Final = 4096  # of a PNG that are looked at; image data do not count
MAX_HEAD_BYTES: Final = 64 << 20  # of a JPEG before its picture: phones put whole pictures there (chosen)


# --- directories of TIFF tags: the skeleton of TIFF, DNG, EXIF and most RAW files ------------------
#
# Every offset is checked against the buffer, loops end, no count makes us allocate more than
# `MAX_VALUE_BYTES`; a directory that is damaged half-way gives what came before. TIFF 6.0, section 2.

Buffer: TypeAlias = bytes | mmap.mmap

# Against files made to cost time or memory (chosen): entries of a directory, of which cameras write below
# 150; directories, of which they write a dozen; bytes of a value; and of a text, which a JPEG must hold.
MAX_ENTRIES, MAX_DIRECTORIES, MAX_VALUE_BYTES, MAX_TEXT = 1024, 64, 16 << 20, 4096

ENTRY: Final = 12  # bytes of an entry of a directory
EXIF, GPS, SUB_DIRECTORIES = (0x8769, 0x8825, 0x014A)  # to directories: Exif 3.0, 4.6.3; TIFF/EP

# Types of values, and their formats of `struct`; 13 is an offset of a directory
BYTE, ASCII, SHORT, LONG, RATIONAL, UNDEFINED, SRATIONAL = 1, 2, 3, 4, 5, 7, 10
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


class Tags(dict[int, Tag]):
    """The tags of a directory; one that is not there gives an empty value, or `None`."""

    def raw(self, tag: int) -> bytes:
        """Bytes of a value; empty if it lies outside the buffer or is too large."""
        entry = self.get(tag)
        if entry is None or entry.offset < 0 or entry.size > MAX_VALUE_BYTES:
            return b""
        end = entry.offset + entry.size
        return bytes(entry.buffer[entry.offset : end]) if end <= len(entry.buffer) else b""

    def numbers(self, tag: int, most: int = MAX_VALUE_BYTES) -> tuple[float, ...]:
        """The first `most` values as numbers: rationals as quotients, NaN over zero; text gives none."""
        if tag not in self or (code := _FORMATS[self[tag].kind]) == "s":
            return ()
        raw = self.raw(tag)[: most * _SIZES[self[tag].kind]]
        values = struct.iter_unpack(self[tag].order + code, raw)
        return tuple(a if not over else a / over[0] if over[0] else math.nan for a, *over in values)

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
        raw = self.raw(tag)[:MAX_TEXT].split(b"\0", 1)[0]
        try:
            return raw.decode("utf-8").strip() or None
        except UnicodeDecodeError:
            return raw.decode("latin-1").strip() or None


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
        waiting, seen = [self.first], {0}
        while waiting and len(seen) <= MAX_DIRECTORIES:
            offset = waiting.pop(0)
            if offset in seen:
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
        place = struct.pack("<I", position + len(tail))
        if isinstance(value, Mapping):
            kind, data, behind = LONG, place, _packed(value, position + len(tail))
        else:
            kind, data = value[0], _bytes_of(*value)
            behind = data if len(data) > 4 else b""
        head += struct.pack("<HHI", tag, kind, len(data) // _SIZES[kind])
        head += place if behind else data.ljust(4, b"\0")
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
    height, width, samples = (*pixels.shape, 1)[:3]
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
    }
    at = len(laid_out(whole))
    at += -at % 16
    whole[273] = LONG, at
    file.write(laid_out(whole).ljust(at, b"\0"))
    file.write(np.ascontiguousarray(pixels).astype(pixels.dtype.newbyteorder("<"), copy=False).data)


# --- files ---------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Header:
    """What the container says: kind, size and the blocks in which metadata lie."""

    kind: FileKind  # kind of file
    width: int = 0  # size as stored; 0 where only LibRaw can tell
    height: int = 0
    channels: int = 0  # samples of a pixel; 0 unknown
    compression: int = 1  # TIFF tag 259; 1 is none
    directory: int = 0  # offset of the directory of the picture of a TIFF or DNG; 0 where there is none
    tiff: tuple[TiffReader, ...] = ()  # TIFF structures with EXIF in them
    camera: tuple[str, str] | None = None  # maker and model of a CRW file, which has no TIFF structure
    xmp: bytes | None = None
    icc: bytes | None = None  # empty where there is a profile that cannot be read at all
    # median step of the quantised cosine coefficients of luma in a JPEG or lossy DNG, in 8-bit numbers
    coarseness: float = 0.0  # 0 unknown, or not compressed so
    chroma_step: tuple[int, int] = (1, 1)  # rows and columns that share one value of a JPEG's chroma
    whole: bool = True  # false where the file ends before its picture does


def check_size(width: int, height: int, file_bytes: int, limits: Limits) -> None:
    """Refuse what would be too large to decode."""
    megapixels = width * height / 1e6
    if megapixels > BOMB_MEGAPIXELS and width * height > BOMB_PIXELS_PER_BYTE * max(file_bytes, 1):
        said = f"{file_bytes} bytes claim to be {width} x {height} pixels; no photograph is packed like that"
        raise errors.DecompressionBombError(said)
    if megapixels > limits.max_megapixels:
        most = f"the limit is {limits.max_megapixels:g} MP, scale or crop it"
        raise errors.ImageTooLargeError(f"{width} x {height} pixels are {megapixels:.0f} MP; {most}")


# --- which kind --------------------------------------------------------------------------------

_KINDS: Final[tuple[tuple[int, bytes, str], ...]] = (
    (0, b"FUJIFILMCCD-RAW", "raw"),
    (0, b"IIU\0", "raw"),  # Panasonic
    (0, b"IIRO", "raw"), (0, b"IIRS", "raw"), (0, b"MMOR", "raw"),  # Olympus
    (8, b"CR\x02", "raw"),  # Canon CR2
    (6, b"HEAPCCDR", "raw"),  # Canon CRW
    (4, b"ftypcrx ", "raw"),  # Canon CR3
    (0, b"\0MRM", "raw"),  # Minolta
    (0, b"FOVb", "raw"),  # Sigma
    (0, b"II*\0", "tiff"), (0, b"MM\0*", "tiff"),
    (0, b"\x89PNG\r\n\x1a\n", "png"),
    (0, b"\xff\xd8\xff", "jpeg"),
    # known, and not read
    (0, b"GIF8", "GIF"), (8, b"WEBP", "WebP"), (0, b"BM", "BMP"), (0, b"8BPS", "Photoshop"),
    (4, b"ftypheic", "HEIC"), (4, b"ftypmif1", "HEIF"), (4, b"ftypavif", "AVIF"),
    (0, b"\xff\x0a", "JPEG XL"), (4, b"JXL ", "JPEG XL"), (4, b"jP  ", "JPEG 2000"),
    (0, b"%PDF", "PDF"), (0, b"v/1\x01", "OpenEXR"), (0, b"PGF", "PGF"),
    (0, b"II+\0", "BigTIFF"), (0, b"MM\0+", "BigTIFF"),
)  # fmt: skip
_READABLE: Final = "give RAW, DNG, TIFF, PNG or JPEG"
COPY_AGAIN: Final = "copy it again from the camera or card"
_SAVE_ANEW: Final = "save it anew from the original"


def sniff(head: bytes) -> FileKind:
    """Tell the kind of file by its first bytes alone, by which NEF, ARW, PEF and DNG are TIFF too."""
    for at, magic, kind in _KINDS:
        if head.startswith(magic, at):
            if kind in _PARSERS:
                return cast("FileKind", kind)
            raise errors.UnsupportedFormatError(f"{kind} files are not read; {_READABLE}")
    said = f"the first bytes ({head[:8].hex(' ')}) belong to no photo format" if head else "the file is empty"
    raise errors.NotAnImageError(f"{said}; {_READABLE}")


@contextlib.contextmanager
def opened_header(path: Path, limits: Limits) -> Iterator[Header]:
    """Map a file and parse its header; the header is valid inside the `with` only."""
    with path.open("rb") as file:
        read = _PARSERS[sniff(file.read(HEAD_BYTES))]
        size = file.seek(0, 2)
        if size > limits.max_bytes:
            raise errors.ImageTooLargeError(f"the file has {size} bytes; the limit is {limits.max_bytes}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            header = read(buffer, limits)
            check_size(header.width, header.height, size, limits)
            yield header


# --- JPEG --------------------------------------------------------------------------------------

_END_OF_IMAGE: Final = b"\xff\xd9"  # marker: ITU-T T.81, table B.1
_MAX_READS: Final = 1 << 17  # of a header: four of each segment and one of each stray byte (chosen)


class JpegSegments(io.BytesIO):
    """Bytes of a JPEG for Pillow; Exif and profile in its header are kept here, and blank there.

    Pillow joins blocks of Exif in quadratic time, reads all values of their directories into memory however
    often they overlap, drops an ICC profile whose parts are miscounted, and fails at a part without a number.
    """

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.exif, self.parts = list[bytes](), list[bytes]()
        self.reads, self.in_header = 0, True

    def read(self, size: int | None = -1, /) -> bytes:
        """Read on, as a file does."""
        data = super().read(size)
        self.reads += self.in_header
        if self.reads > _MAX_READS:
            said = f"the JPEG's header does not end within {_MAX_READS // 4} segments"
            raise errors.NotAnImageError(f"{said}; {_SAVE_ANEW}")
        for word, kept in ((b"Exif\0", self.exif), (b"ICC_PROFILE\0", self.parts)):
            if self.in_header and data.startswith(word):
                kept.append(data)
                return bytes(len(data))
        return data


def opened_jpeg(segments: JpegSegments) -> JpegImageFile:
    """Read the header of a JPEG, of several pictures that of the first."""
    image = JpegImageFile(segments)
    segments.in_header = False
    return image


def _read_jpeg(buffer: Buffer, _: Limits) -> Header:
    """Let Pillow read the segments up to the first scan: frame size, XMP, profile, quantisation."""
    segments = JpegSegments(buffer[:MAX_HEAD_BYTES])
    try:
        image = opened_jpeg(segments)
    except (OSError, SyntaxError, ValueError) as error:
        if segments.tell() < len(segments.getbuffer()):
            said = f"the JPEG has no frame header, or none of 8 bits ({error})"
            raise errors.NotAnImageError(f"{said}; {_SAVE_ANEW}") from error
        raise errors.TruncatedImageError(f"the JPEG ends inside its header; {COPY_AGAIN}") from error
    # the byte behind the word is the number of a part
    parts = sorted(dict.fromkeys(segments.parts), key=lambda part: part[12:13])
    luma, chroma = (2 * (image.layer or [(0, 1, 1, 0)]))[:2]  # grey is its own chroma
    step = luma[2] // max(chroma[2], 1), luma[1] // max(chroma[1], 1)
    whole = buffer.find(_END_OF_IMAGE, segments.tell()) >= 0  # in a scan a zero follows each byte of 0xFF
    return Header(
        "jpeg",
        *image.size,
        channels=image.layers,
        tiff=tuple(TiffReader.open(block, 6) for block in segments.exif),
        xmp=image.info.get("xmp"),
        icc=b"".join(part[14:] for part in parts) if parts else None,
        # cameras give the first table to luma
        coarseness=float(statistics.median(image.quantization.get(0, [0]))),
        chroma_step=step if {*step} <= {1, 2, 4} else (1, 1),
        whole=whole,
    )


# --- PNG ---------------------------------------------------------------------------------------

_OF_PICTURE: Final = {b"PLTE", b"tRNS", b"IDAT"}
# What the chunks that declare colours hold for sRGB: ITU-T H.273; PNG, section 11.3.2
_OF_SRGB: Final = {
    b"cICP": bytes((1, 13, 0, 1)),
    b"gAMA": struct.pack(">I", 45455),
    b"cHRM": struct.pack(">8I", 31270, 32900, 64000, 33000, 30000, 60000, 15000, 6000),
}
_ROUNDED: Final = 500  # of 100,000, by which programs round gamma and places (chosen)
_HDR: Final = {b"\x10", b"\x12"}  # curves PQ and HLG in cICP, which goes before a profile
_READ: Final = {b"IDAT", b"eXIf", b"iCCP", b"iTXt", b"sRGB", *_OF_SRGB}
_PNG_END: Final = struct.pack(">I4sI", 0, b"IEND", zlib.crc32(b"IEND"))


def _read_png(buffer: Buffer, limits: Limits) -> Header:
    """Read the chunks; image data are skipped, not read."""
    first = bytes(buffer[8:33])
    if len(first) < 25:
        raise errors.TruncatedImageError(f"the PNG ends inside its header; {COPY_AGAIN}")
    if first[4:8] != b"IHDR" or zlib.crc32(first[4:21]) != struct.unpack(">I", first[21:])[0]:
        raise errors.NotAnImageError("the PNG's header chunk is damaged")
    width, height, bits, colour = struct.unpack(">IIBB", first[8:18])
    channels = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}.get(colour, 0)
    if not (width and height and channels and bits in {1, 2, 4, 8, 16}):
        raise errors.NotAnImageError(f"no PNG has {width} x {height} pixels of {bits} bits, type {colour}")
    check_size(width, height, len(buffer), limits)  # before a bomb's end is missed
    found = dict[bytes, bytes]()
    for name, start, length in png_chunks(buffer):
        if name in _READ:
            body = bytes(buffer[start : start + min(length, MAX_BLOCK_BYTES if name != b"IDAT" else 0)])
            if name != b"iTXt" or body.startswith(b"XML:com.adobe.xmp\0"):
                found.setdefault(name, body)
    if b"IDAT" not in found:
        raise errors.TruncatedImageError("the PNG has no image data")
    text = found.get(b"iTXt", b"")
    xmp = text[20:].partition(b"\0")[2].partition(b"\0")[2]
    icc = _inflated(found[b"iCCP"].partition(b"\0")[2][1:]) if b"iCCP" in found else None
    known = _OF_SRGB if b"sRGB" not in found else {b"cICP"}  # sRGB goes before gAMA and cHRM
    other = b", ".join(name for name in known if _differs(name, found.get(name, b"")))
    if (other and not icc) or found.get(b"cICP", b"")[1:2] in _HDR:
        said = f"the PNG's {other.decode()} declares colours other than sRGB"
        raise errors.UnsupportedFormatError(f"{said}; convert it to sRGB, or save it with an ICC profile")
    return Header(
        "png",
        width,
        height,
        channels,
        tiff=(TiffReader.open(found.get(b"eXIf", b"")),),
        xmp=_inflated(xmp) if text[18:19] == b"\1" else xmp,
        icc=icc,
    )


def _differs(name: bytes, said: bytes) -> bool:
    """Tell whether a chunk declares other colours, by more than programs round; zeros say nothing."""
    if len(said) != len(_OF_SRGB[name]) or not any(said):
        return False
    a, b = (np.frombuffer(numbers, ">u4").astype(np.int64) for numbers in (said, _OF_SRGB[name]))
    return bool(np.abs(a - b).max() > (_ROUNDED if name != b"cICP" else 0))


def png_chunks(buffer: Buffer) -> Iterator[tuple[bytes, int, int]]:
    """Yield name, start and length of the chunks; a run of image data counts as one."""
    at, count, before = 33, 0, b"IHDR"
    while count < MAX_CHUNKS:
        head = bytes(buffer[at : at + 8])
        if len(head) < 8:
            raise errors.TruncatedImageError(f"the PNG ends before its end chunk; {COPY_AGAIN}")
        length, name = struct.unpack(">I4s", head)
        if at + 12 + length > len(buffer):
            raise errors.TruncatedImageError(f"the PNG ends inside chunk {name!r}; {COPY_AGAIN}")
        if name == b"IEND":
            return
        yield name, at + 8, length
        count += not name == before == b"IDAT"
        before, at = name, at + 12 + length


def png_picture(data: bytes) -> bytes:
    """A PNG without all that is not its picture: decoders unpack that too, and print what they find amiss."""
    chunks = (data[at - 8 : at + length + 4] for name, at, length in png_chunks(data) if name in _OF_PICTURE)
    return data[:33] + b"".join(chunks) + _PNG_END


def _inflated(packed: bytes) -> bytes:
    """Decompress at most `MAX_BLOCK_BYTES`; empty where there is more, or damage."""
    inflater = zlib.decompressobj()
    try:
        data = inflater.decompress(packed, MAX_BLOCK_BYTES)
    except zlib.error:
        return b""
    return data if inflater.eof else b""


# --- TIFF, DNG and RAW files that look like TIFF -----------------------------------------------

_ICC: Final = 34675  # tag of the profile: ICC.1:2022, annex B.4
_DNG_VERSION: Final = 0xC612  # tag, DNG 1.6, chapter 4
LOSSY_DNG: Final = 34892  # compression of a DNG by baseline JPEG, eight bits a sample: DNG 1.4, "Compression"
_STRIPS: Final = (273, 324), (279, 325)  # tags of the places of strips and of tiles, and of their lengths
_RAW_COMPRESSION: Final = {32767, 32769, 32770, 34713, 65000, 65535}  # Sony to Pentax: libtiff, tiff.h
_FILTERS: Final = "RGBCMYW"  # CFAPattern: TIFF/EP, section 5.2.1

# PhotometricInterpretation: colour filter array (TIFF/EP), linear RAW (DNG 1.6, chapter 3); grey is 1, RGB 2
_RAW_PHOTOMETRIC: Final = {32803, 34892}
_DEPTHS: Final = {1: {8, 16}, 3: {16, 32, 64}, 4: {8, 16}}  # bits by SampleFormat: integer, floating, unsaid
_OTHER_COLOURS: Final = {0: "inverted grey", 3: "a palette", 5: "CMYK", 6: "YCbCr", 8: "CIE Lab"}


def _read_tiff(buffer: Buffer, limits: Limits, kind: FileKind = "tiff") -> Header:
    """Read the directories; tells TIFF from DNG and from RAW files that look like TIFF."""
    reader = TiffReader.open(buffer)
    every = list(reader.walk(SUB_DIRECTORIES))
    if not every:
        raise errors.TruncatedImageError(f"the TIFF has no readable directory; {COPY_AGAIN}")
    first = every[0][1]
    if _DNG_VERSION in first:
        kind = "dng"
    elif any(t.integer(262) in _RAW_PHOTOMETRIC or t.integer(259) in _RAW_COMPRESSION for _, t in every):
        kind = "raw"
    place, photo = max(every, key=lambda at: (kind != "tiff" or not _is_derived(at[1]), _pixels(at[1])))
    starts, lengths = (photo.integers(strip if strip in photo else tile) for strip, tile in _STRIPS)
    header = Header(
        kind,
        width=photo.integer(256),
        height=photo.integer(257),
        channels=photo.integer(277, 1),
        compression=photo.integer(259, 1),
        directory=0 if kind == "raw" else place,
        tiff=(reader,),
        xmp=first.raw(700)[:MAX_BLOCK_BYTES],
        icc=photo.raw(_ICC)[:MAX_BLOCK_BYTES] if _ICC in photo else None,
        whole=kind == "raw" or all(at + n <= len(buffer) for at, n in zip(starts, lengths, strict=False)),
    )
    check_size(header.width, header.height, len(buffer), limits)
    if kind != "tiff":
        # LibRaw would take an array that no demosaicing here is made for, for another
        if 33422 in photo and len(shape := photo.integers(33421, 2)) == 2:
            letters = "".join(_FILTERS[n : n + 1] or "?" for n in photo.raw(33422)[:256])
            rows = range(min(shape[0], 256))
            require_known_mosaic([letters[k * shape[1] : (k + 1) * shape[1]] for k in rows])
        if header.compression == LOSSY_DNG and starts and lengths:
            tile = buffer[starts[0] : starts[0] + min(lengths[0], MAX_BLOCK_BYTES)]  # the first for all
            with contextlib.suppress(errors.NotAnImageError, errors.TruncatedImageError):
                return replace(header, coarseness=_read_jpeg(tile, limits).coarseness)
        return header
    if len(every) >= MAX_DIRECTORIES:
        said = f"the TIFF has more than {MAX_DIRECTORIES - 1} pictures; give one photo"
        raise errors.UnsupportedFormatError(said)
    if not _pixels(photo) or not all(photo.keys() & either for either in _STRIPS):
        raise errors.NotAnImageError("the TIFF gives no size or no strips: it holds no picture")
    _check_numbers(photo)
    stored = _pixels(photo) * header.channels * photo.integer(258, 1) / 8
    missing = header.compression == 1 and sum(lengths) < 0.999 * stored
    return replace(header, whole=header.whole and 0 < len(starts) == len(lengths) and not missing)


def _pixels(tags: Tags) -> int:
    return tags.integer(256) * tags.integer(257)


def _is_derived(tags: Tags) -> bool:
    """Whether a picture is a reduced one or a mask of another: NewSubfileType, or SubfileType before it."""
    return bool(tags.integer(254) & 0b101) or tags.integer(255, 1) == 2


def require_known_mosaic(rows: Sequence[str]) -> None:
    """Refuse every mosaic but those of Bayer, 2 x 2, and of X-Trans, 6 x 6."""
    # the shorter of the rows counts: a damaged file may name fewer colours than it says
    height, width = len(rows), min(map(len, rows), default=0)
    bayer = (height, width) == (2, 2) and "".join(rows) in {"RGGB", "BGGR", "GRBG", "GBRG"}
    if not bayer and (height, width) != (6, 6):
        raise errors.UnsupportedFormatError(
            f"the colours of the sensor repeat every {height} x {width} pixels ({' '.join(rows)}); only "
            "2 x 2 Bayer mosaics and X-Trans are read: have the camera or a raw converter bin or develop it"
        )


def _check_numbers(tags: Tags) -> None:
    """Refuse numbers that are not read, or stand for other things than light, before they are stored."""
    kind, samples, bits, form = (tags.integer(tag, 1) for tag in (262, 277, 258, 339))
    read = kind in {1, 2} and (1, 3)[kind == 2] <= samples <= 4
    if not read or bits not in _DEPTHS.get(form, ()):
        colours = _OTHER_COLOURS.get(kind, f"PhotometricInterpretation {kind}")
        raise errors.UnsupportedFormatError(
            f"the TIFF holds no RGB or grey of unsigned 8 or 16 bits, or of floating-point numbers, but "
            f"{samples} samples of {bits} bits, SampleFormat {form}, {colours}; convert it"
        )


# --- RAW files that are not plain TIFF ---------------------------------------------------------

_CIFF_CAMERA: Final = re.compile(rb"Canon\0([ -~]{1,60})\0")  # record 0x080A of a CRW file: CIFF 1.0, 1997


def _read_raw(buffer: Buffer, limits: Limits) -> Header:
    """Find the TIFF structures of RAW files that are not plain TIFF; LibRaw tells their size."""
    head = bytes(buffer[: 1 << 16])
    if head[4:12] == b"ftypcrx ":
        boxes = (head.find(name) for name in (b"CMT1", b"CMT2"))  # camera and EXIF of a CR3
        return Header("raw", tiff=tuple(TiffReader.open(buffer, at + 4) for at in boxes if at > 0))
    if head[6:].startswith(b"HEAPCC"):
        named = _CIFF_CAMERA.search(buffer)
        return Header("raw", camera=("Canon", "" if named is None else named[1].decode("ascii")))
    if head.startswith(b"FUJIFILMCCD"):
        at = int.from_bytes(head[84:88], "big")  # of a JPEG
        with contextlib.suppress(errors.NotAnImageError, errors.TruncatedImageError):
            preview = _read_jpeg(buffer[at : at + MAX_BLOCK_BYTES], limits)
            return Header("raw", tiff=preview.tiff, xmp=preview.xmp)
    with contextlib.suppress(errors.TruncatedImageError):
        return _read_tiff(buffer, limits, "raw")
    return Header("raw")


_PARSERS: Final[Mapping[FileKind, Callable[[Buffer, Limits], Header]]] = {
    "raw": _read_raw,
    "tiff": _read_tiff,
    "png": _read_png,
    "jpeg": _read_jpeg,
}
