"""Headers of photo files: size and metadata blocks, without decoding a pixel.

Only what is needed is parsed, each count and length is bounded, and what cannot be right is
refused with a text that says so.
"""

from __future__ import annotations

import contextlib
import mmap
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from lensmodel.errors import (
    DecompressionBombError,
    ImageTooLargeError,
    NotAnImageError,
    TruncatedImageError,
    UnsupportedFormatError,
)
from lensmodel.photo.ifd import MAX_DIRECTORIES, Buffer, Directory, Entry, TiffReader
from lensmodel.photo.model import FileKind, Limits

HEAD_BYTES: Final = 64
"""Bytes that `sniff` wants to see."""

MAX_BLOCK_BYTES: Final = 8 << 20
"""Largest ICC profile or XMP packet that is read."""

BOMB_MEGAPIXELS: Final = 4.0
"""Below this a false claim costs nothing worth refusing."""

BOMB_PIXELS_PER_BYTE: Final = 200.0
"""An evenly grey JPEG reaches about 100 pixels a byte, and a photograph is never evenly grey."""

MAX_SEGMENTS: Final = 4096
"""Segments of a JPEG or chunks of a PNG that are looked at; image data do not count."""

_RAW_MAGIC: Final[tuple[tuple[int, bytes], ...]] = (
    (0, b"FUJIFILMCCD-RAW"),
    (0, b"IIU\0"),  # Panasonic
    (0, b"IIRO"), (0, b"IIRS"), (0, b"MMOR"),  # Olympus
    (8, b"CR\x02"),  # Canon CR2
    (6, b"HEAPCCDR"),  # Canon CRW
    (4, b"ftypcrx "),  # Canon CR3
    (0, b"\0MRM"),  # Minolta
    (0, b"FOVb"),  # Sigma
)  # fmt: skip
_REFUSED: Final[tuple[tuple[int, bytes, str], ...]] = (
    (0, b"GIF8", "GIF"), (8, b"WEBP", "WebP"), (0, b"BM", "BMP"), (0, b"8BPS", "Photoshop"),
    (4, b"ftypheic", "HEIC"), (4, b"ftypmif1", "HEIF"), (4, b"ftypavif", "AVIF"),
    (0, b"\xff\x0a", "JPEG XL"), (4, b"JXL ", "JPEG XL"), (4, b"jP  ", "JPEG 2000"),
    (0, b"%PDF", "PDF"), (0, b"v/1\x01", "OpenEXR"), (0, b"PGF", "PGF"),
)  # fmt: skip
_READABLE: Final = "give RAW, DNG, TIFF, PNG or JPEG"


def sniff(head: bytes) -> FileKind:
    """Tell the kind of file by its first bytes alone; names and declared types are not trusted.

    RAW files that look like TIFF up to their directories (NEF, ARW, PEF, DNG) are "tiff" here;
    `inspect` looks into the directories and tells them apart.

    Parameters
    ----------
    head : bytes
        The first `HEAD_BYTES` bytes of the file, or fewer where it is shorter.

    Raises
    ------
    NotAnImageError
        If the bytes belong to no image format.
    UnsupportedFormatError
        If they belong to one that is not read here.
    """
    for at, magic in _RAW_MAGIC:
        if head[at : at + len(magic)] == magic:
            return "raw"
    if head[:4] in {b"II*\0", b"MM\0*", b"II+\0", b"MM\0+"}:
        return "tiff"
    if head.startswith(b"\x89PNG\r\n\x1a\n"):
        return "png"
    if head.startswith(b"\xff\xd8\xff"):
        return "jpeg"
    for at, magic, name in _REFUSED:
        if head[at : at + len(magic)] == magic:
            raise UnsupportedFormatError(f"{name} files are not read; {_READABLE}")
    if not head:
        raise NotAnImageError(f"the file is empty; {_READABLE}")
    raise NotAnImageError(f"the first bytes ({head[:8].hex(' ')}) belong to no photo format; {_READABLE}")


@dataclass(frozen=True, slots=True)
class Header:
    """What the container says: kind, size and the blocks in which metadata lie.

    Parameters
    ----------
    kind : FileKind
        Kind of file.
    width, height : int
        Size as stored; 0 where only LibRaw can tell.
    channels : int
        Samples of a pixel; 0 unknown.
    bits : int
        Bits of a sample; 0 unknown.
    tiff : tuple of TiffReader
        TIFF structures with EXIF in them.
    xmp, icc : bytes or None
        XMP packet and ICC profile.
    linear : bool
        The file declares its numbers to be linear light (PNG gamma 1).
    """

    kind: FileKind
    width: int = 0
    height: int = 0
    channels: int = 0
    bits: int = 0
    tiff: tuple[TiffReader, ...] = ()
    xmp: bytes | None = None
    icc: bytes | None = None
    linear: bool = False


@contextlib.contextmanager
def opened_header(path: Path, limits: Limits) -> Iterator[Header]:
    """Map a file and parse its header; the header is valid inside the `with` only.

    Raises
    ------
    NotAnImageError, UnsupportedFormatError, TruncatedImageError
        If it is no photo, none that we read, or ends early.
    ImageTooLargeError
        If the file has more bytes than the limits allow.
    """
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        kind = sniff(head)
        size = file.seek(0, 2)
        if size > limits.max_bytes:
            raise ImageTooLargeError(f"the file has {size} bytes; the limit is {limits.max_bytes}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            yield _PARSERS[kind](buffer, limits)


def check_size(width: int, height: int, file_bytes: int, limits: Limits) -> None:
    """Refuse what would be too large to decode.

    Raises
    ------
    ImageTooLargeError
        If it has more pixels than the limits allow.
    DecompressionBombError
        If the claimed picture is out of all proportion to the file.
    """
    megapixels = width * height / 1e6
    proportion = width * height / max(file_bytes, 1)
    if megapixels > BOMB_MEGAPIXELS and proportion > BOMB_PIXELS_PER_BYTE:
        raise DecompressionBombError(
            f"{file_bytes} bytes claim to be {width} x {height} pixels; no photograph is packed like that"
        )
    if megapixels > limits.max_megapixels:
        raise ImageTooLargeError(
            f"{width} x {height} pixels are {megapixels:.0f} MP; the limit is {limits.max_megapixels:g} MP, scale or crop it"
        )


def _jpeg(buffer: Buffer, limits: Limits) -> Header:
    """Walk the segments up to the first scan.

    Source: ITU-T T.81, annex B.
    """
    header, icc_parts, at = Header("jpeg"), dict[int, bytes](), 2
    for _ in range(MAX_SEGMENTS):
        while bytes(buffer[at : at + 2]) == b"\xff\xff":  # fill bytes
            at += 1
        marker = bytes(buffer[at : at + 4])
        if len(marker) < 4:
            raise TruncatedImageError("the JPEG ends inside its header; the upload was cut off")
        if marker[0] != 0xFF:
            raise NotAnImageError(f"the JPEG is damaged at byte {at}: no marker where one must be")
        code, length = marker[1], struct.unpack(">H", marker[2:])[0]
        if code in {0xDA, 0xD9}:
            break
        body = at + 4, at + 2 + length
        if 0xC0 <= code <= 0xCF and code not in {0xC4, 0xC8, 0xCC}:
            frame = bytes(buffer[body[0] : min(body[1], body[0] + 6)])
            if len(frame) < 6:
                raise TruncatedImageError("the JPEG's frame header is cut off")
            bits, height, width, channels = struct.unpack(">BHHB", frame)
            header = replace(header, width=width, height=height, channels=channels, bits=bits)
        elif code in {0xE1, 0xE2}:
            payload = bytes(buffer[slice(*body)])
            if payload.startswith(b"Exif\0") and (reader := TiffReader.open(payload, 6)):
                header = replace(header, tiff=(*header.tiff, reader))
            elif payload.startswith(b"http://ns.adobe.com/xap/1.0/\0"):
                header = replace(header, xmp=payload[29:])
            elif payload.startswith(b"ICC_PROFILE\0") and len(payload) > 14:
                icc_parts[payload[12]] = payload[14:]
        at = body[1]
    if not header.width or not header.height:
        raise NotAnImageError("the JPEG has no frame header, or one without a size")
    check_size(header.width, header.height, len(buffer), limits)
    icc = b"".join(part for _, part in sorted(icc_parts.items()))
    return replace(header, icc=icc or None)


def _png(buffer: Buffer, limits: Limits) -> Header:
    """Walk the chunks; image data are skipped, not read.

    Source: "Portable Network Graphics, third edition", W3C, 2025, sections 5 and 11.
    """
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
    header, at, seen_data = Header("png", width, height, channels, bits), 33, False
    for _ in range(MAX_SEGMENTS):
        head = bytes(buffer[at : at + 8])
        if len(head) < 8:
            raise TruncatedImageError("the PNG ends before its end chunk; the upload was cut off")
        length, name = struct.unpack(">I4s", head)
        if at + 12 + length > len(buffer):
            raise TruncatedImageError(f"the PNG ends inside chunk {name!r}; the upload was cut off")
        if name in {b"eXIf", b"iTXt", b"iCCP", b"gAMA"} and length <= MAX_BLOCK_BYTES:
            header = _png_chunk(header, name, bytes(buffer[at + 8 : at + 8 + length]))
        seen_data = seen_data or name == b"IDAT"
        at += 12 + length
        if name == b"IEND":
            break
        if name == b"IDAT":  # millions of them are allowed; jump to the last
            at = _after_data(buffer, at)
    if not seen_data:
        raise TruncatedImageError("the PNG has no image data")
    return header


def _after_data(buffer: Buffer, at: int) -> int:
    while bytes(buffer[at + 4 : at + 8]) == b"IDAT":
        at += 12 + int.from_bytes(buffer[at : at + 4], "big")
    return at


def _png_chunk(header: Header, name: bytes, body: bytes) -> Header:
    if name == b"eXIf" and (reader := TiffReader.open(body)):
        return replace(header, tiff=(*header.tiff, reader))
    if name == b"gAMA" and len(body) == 4:
        return replace(header, linear=struct.unpack(">I", body)[0] == 100000)
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


def _tiff(buffer: Buffer, limits: Limits) -> Header:
    reader = TiffReader.open(buffer)
    if reader is None:
        raise TruncatedImageError("the TIFF ends inside its header; the upload was cut off")
    directories = list(reader.chain())
    if not directories:
        raise TruncatedImageError("the TIFF has no readable directory; the upload was cut off")
    first = directories[0]
    header = Header("tiff", tiff=(reader,), xmp=_block(first, 700), icc=_block(first, 34675))
    if 0xC612 in first:
        header = replace(header, kind="dng", **_size(_largest(reader, directories)))
    elif _looks_raw(reader, directories):
        header = replace(header, kind="raw", **_size(_largest(reader, directories)))
    else:
        header = replace(header, **_size(first))
    check_size(header.width, header.height, len(buffer), limits)
    if header.kind != "tiff":
        return header
    if len(directories) >= MAX_DIRECTORIES:
        raise UnsupportedFormatError(f"the TIFF has more than {MAX_DIRECTORIES - 1} pictures; give one photo")
    _check_strips(first, len(buffer))
    return header


def _block(directory: Directory, tag: int) -> bytes | None:
    entry = directory.get(tag)
    return None if entry is None else entry.raw()[:MAX_BLOCK_BYTES] or None


def _value(directory: Directory, tag: int, default: int) -> int:
    entry = directory.get(tag)
    value = None if entry is None else entry.integer()
    return default if value is None else value


def _size(directory: Directory) -> dict[str, int]:
    return {
        "width": _value(directory, 256, 0),
        "height": _value(directory, 257, 0),
        "channels": _value(directory, 277, 1),
        "bits": _value(directory, 258, 1),
    }


def _with_children(reader: TiffReader, directories: list[dict[int, Entry]]) -> Iterator[Directory]:
    for directory in directories[:MAX_DIRECTORIES]:
        yield directory
        children = directory.get(330)
        for offset in () if children is None else children.numbers()[:16]:
            yield reader.directory(int(offset))[0]


_RAW_PHOTOMETRIC: Final = {32803, 34892}  # colour filter array, linear RAW
_RAW_COMPRESSION: Final = {
    32767,
    32769,
    32770,
    34713,
    65000,
    65535,
}  # of Sony, Epson, Samsung, Nikon, Kodak, Pentax


def _looks_raw(reader: TiffReader, directories: list[dict[int, Entry]]) -> bool:
    return any(
        _value(d, 262, 0) in _RAW_PHOTOMETRIC or _value(d, 259, 0) in _RAW_COMPRESSION
        for d in _with_children(reader, directories)
    )


def _largest(reader: TiffReader, directories: list[dict[int, Entry]]) -> Directory:
    return max(_with_children(reader, directories), key=lambda d: _value(d, 256, 0) * _value(d, 257, 0))


def _check_strips(directory: Directory, file_bytes: int) -> None:
    """Refuse a picture whose strips or tiles do not lie in the file.

    Raises
    ------
    NotAnImageError, TruncatedImageError, UnsupportedFormatError
        If there is no picture, it ends early, or its tables are absurd.
    """
    width, height = _value(directory, 256, 0), _value(directory, 257, 0)
    if width <= 0 or height <= 0:
        raise NotAnImageError(f"the TIFF gives no size ({width} x {height}); it holds no picture")
    offsets = directory.get(273) or directory.get(324)
    counts = directory.get(279) or directory.get(325)
    if offsets is None or counts is None:
        raise NotAnImageError("the TIFF has no strips or tiles; it holds no picture")
    if offsets.count != counts.count:
        raise NotAnImageError(f"the TIFF lists {offsets.count} strips but {counts.count} lengths")
    starts, lengths = offsets.numbers(), counts.numbers()
    if not starts or len(starts) != len(lengths):
        raise TruncatedImageError("the TIFF's strip table lies outside the file; the upload was cut off")
    if any(a + n > file_bytes for a, n in zip(starts, lengths, strict=True)):
        raise TruncatedImageError("the TIFF's pixel data go beyond the file's end; the upload was cut off")
    stored = width * height * _value(directory, 277, 1) * max(_value(directory, 258, 1), 1) / 8
    if _value(directory, 259, 1) == 1 and _value(directory, 262, 1) != 6 and sum(lengths) < 0.999 * stored:
        raise TruncatedImageError(
            f"the TIFF holds {sum(lengths):.0f} bytes of pixels where {stored:.0f} are needed"
        )


def _raw(buffer: Buffer, limits: Limits) -> Header:
    """Find the TIFF structures of RAW files that are not plain TIFF; LibRaw tells their size."""
    head = bytes(buffer[:128])
    if head[4:12] == b"ftypcrx ":
        return Header("raw", tiff=tuple(_canon_boxes(buffer)))
    if head.startswith(b"FUJIFILMCCD-RAW"):
        at = int.from_bytes(head[84:88], "big")
        if bytes(buffer[at : at + 3]) != b"\xff\xd8\xff":
            return Header("raw")
        with contextlib.suppress(NotAnImageError, TruncatedImageError):
            preview = _jpeg(bytes(buffer[at : at + MAX_BLOCK_BYTES]), limits)
            return Header("raw", tiff=preview.tiff, xmp=preview.xmp)
        return Header("raw")
    reader = TiffReader.open(buffer)
    if reader is None:
        return Header("raw")
    directories = list(reader.chain())
    size = _size(_largest(reader, directories)) if directories else {}
    check_size(size.get("width", 0), size.get("height", 0), len(buffer), limits)
    return Header("raw", tiff=(reader,), xmp=_block(directories[0], 700) if directories else None, **size)


def _canon_boxes(buffer: Buffer) -> Iterator[TiffReader]:
    """Yield the TIFF structures CMT1 (camera), CMT2 (EXIF) and CMT3 (maker note) of a CR3."""
    head = bytes(buffer[: 1 << 16])
    for name in (b"CMT1", b"CMT2", b"CMT3"):
        at = head.find(name)
        if at > 0 and (reader := TiffReader.open(buffer, at + 4)):
            yield reader


_PARSERS: Final = {"raw": _raw, "tiff": _tiff, "png": _png, "jpeg": _jpeg}
