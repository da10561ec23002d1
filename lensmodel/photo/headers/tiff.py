"""Headers of TIFF, DNG and RAW files. Source: "TIFF Revision 6.0", Aldus, 1992."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Final

from lensmodel.core.errors import (
    ImageTooLargeError,
    NotAnImageError,
    TruncatedImageError,
    UnsupportedFormatError,
)
from lensmodel.photo.headers.header import MAX_BLOCK_BYTES, Header, check_size
from lensmodel.photo.headers.ifd import MAX_DIRECTORIES, Buffer, Directory, TiffReader
from lensmodel.photo.headers.jpeg import read_jpeg
from lensmodel.photo.mosaic import require_known_mosaic
from lensmodel.photo.values import Limits

_DNG_VERSION: Final = 0xC612  # tag, DNG 1.6, chapter 4

_RAW_PHOTOMETRIC: Final = {32803, 34892}
"""PhotometricInterpretation: colour filter array (TIFF/EP) and linear RAW (DNG 1.6, chapter 3)."""

_READ_COLOURS: Final = {0, 1, 2, 3, 6}
"""PhotometricInterpretation: two kinds of grey, RGB, palette and YCbCr (TIFF 6.0, sections 3 to 6 and 21)."""

_OTHER_COLOURS: Final = {4: "a mask", 5: "CMYK, made for print", 8: "CIE Lab", 9: "CIE Lab", 10: "CIE Lab"}
_JPEG: Final = {6, 7}  # Compression, of TIFF 6.0 and of its technical note 2
_FILTERS: Final = "RGBCMYW"  # CFAPattern: TIFF/EP, section 5.2.1

_LOSSY: Final = 34892
"""Compression of a DNG by baseline JPEG, eight bits a sample: DNG 1.4, "Compression"."""

_RAW_COMPRESSION: Final = {32767, 32769, 32770, 34713, 65000, 65535}
"""Of Sony, Epson, Samsung, Nikon, Kodak and Pentax."""


def read_tiff(buffer: Buffer, limits: Limits) -> Header:
    """Read the directories; tells TIFF from DNG and from RAW files that look like TIFF."""
    reader = TiffReader.open(buffer)
    if reader is None:
        raise TruncatedImageError("the TIFF ends inside its header; the upload was cut off")
    chain = list(reader.chain())
    if not chain:
        raise TruncatedImageError("the TIFF has no readable directory; the upload was cut off")
    first, every = chain[0][1], list(_with_children(reader, chain))
    header = Header("tiff", tiff=(reader,), xmp=_block(first, 700), icc=_block(first, 34675))
    if _DNG_VERSION in first or _looks_raw(every):
        _, largest = max(every, key=_pixels)
        header = _sized(replace(header, kind="dng" if _DNG_VERSION in first else "raw"), largest)
        if header.kind == "dng":
            header = replace(
                header,
                opcodes_2=_block(largest, 51009) or b"",
                opcodes_3=_block(largest, 51022) or b"",
                whole=_ends_inside(largest, len(buffer)),
            )
        if header.kind == "dng" and header.compression == _LOSSY:
            header = replace(header, coarseness=_coarseness(buffer, largest, limits))
        elif (
            header.kind == "dng" and (white := largest.get(50717)) is not None
        ):  # LibRaw stretches lossy ones
            header = replace(header, white=tuple(int(level) for level in white.numbers(3)))
        check_size(header.width, header.height, len(buffer), limits)
        _check_mosaic(largest)
        return header
    place, photo = max(every, key=lambda at: (not _is_derived(at[1]), _pixels(at)))
    header = replace(_sized(header, photo), directory=place, icc=_block(photo, 34675))
    check_size(header.width, header.height, len(buffer), limits)
    if len(chain) >= MAX_DIRECTORIES:
        raise UnsupportedFormatError(f"the TIFF has more than {MAX_DIRECTORIES - 1} pictures; give one photo")
    _check_strips(photo, len(buffer))
    _check_colours(photo)
    return header


def _block(directory: Directory, tag: int) -> bytes | None:
    entry = directory.get(tag)
    return None if entry is None else entry.raw()[:MAX_BLOCK_BYTES] or None


def _value(directory: Directory, tag: int, default: int) -> int:
    entry = directory.get(tag)
    values = () if entry is None else entry.integers(1)
    return values[0] if values else default


def _sized(header: Header, directory: Directory) -> Header:
    return replace(
        header,
        width=_value(directory, 256, 0),
        height=_value(directory, 257, 0),
        channels=_value(directory, 277, 1),
        bits=_value(directory, 258, 1),
        compression=_value(directory, 259, 1),
    )


def _with_children(
    reader: TiffReader, chain: Sequence[tuple[int, Directory]]
) -> Iterator[tuple[int, Directory]]:
    for offset, directory in chain:
        yield offset, directory
        children = directory.get(330)
        for below in () if children is None else children.integers(16):
            yield below, reader.directory(below)[0]


def _looks_raw(every: Sequence[tuple[int, Directory]]) -> bool:
    return any(
        _value(d, 262, 0) in _RAW_PHOTOMETRIC or _value(d, 259, 0) in _RAW_COMPRESSION for _, d in every
    )


def _pixels(at: tuple[int, Directory]) -> int:
    return _value(at[1], 256, 0) * _value(at[1], 257, 0)


def _is_derived(directory: Directory) -> bool:
    """Whether a picture is a reduced one or a mask of another: NewSubfileType, or SubfileType before it."""
    return bool(_value(directory, 254, 0) & 0b101) or _value(directory, 255, 1) == 2


def _check_mosaic(directory: Directory) -> None:
    """Refuse a colour filter array that no demosaicing here is made for: LibRaw would take it for another."""
    size, colours = directory.get(33421), directory.get(33422)
    if size is None or colours is None or len(shape := size.integers(2)) != 2:
        return
    letters = "".join(_FILTERS[number] if number < len(_FILTERS) else "?" for number in colours.raw()[:256])
    require_known_mosaic([letters[k * shape[1] : (k + 1) * shape[1]] for k in range(shape[0])])


def _coarseness(buffer: Buffer, directory: Directory, limits: Limits) -> float:
    """Step of the quantised coefficients of a DNG by its first JPEG tile, which speaks for all; 0 unknown."""
    offsets, counts = (directory.get(tag) or directory.get(other) for tag, other in ((324, 273), (325, 279)))
    if offsets is None or counts is None:
        return 0.0
    at, size = offsets.integers(1), counts.integers(1)
    if not at or not size:
        return 0.0
    with contextlib.suppress(NotAnImageError, TruncatedImageError, ImageTooLargeError):
        return read_jpeg(bytes(buffer[at[0] : at[0] + min(size[0], MAX_BLOCK_BYTES)]), limits).coarseness
    return 0.0


def _ends_inside(directory: Directory, file_bytes: int) -> bool:
    """Whether no strip or tile that a directory lists goes beyond the file's end."""
    places = (directory.get(tag) or directory.get(other) for tag, other in ((273, 324), (279, 325)))
    starts, lengths = (() if place is None else place.integers() for place in places)
    return all(start + length <= file_bytes for start, length in zip(starts, lengths, strict=False))


def _check_strips(directory: Directory, file_bytes: int) -> None:
    """Refuse a picture whose strips or tiles do not lie in the file."""
    width, height = _value(directory, 256, 0), _value(directory, 257, 0)
    if width <= 0 or height <= 0:
        raise NotAnImageError(f"the TIFF gives no size ({width} x {height}); it holds no picture")
    offsets = directory.get(273) or directory.get(324)
    counts = directory.get(279) or directory.get(325)
    if offsets is None or counts is None:
        raise NotAnImageError("the TIFF has no strips or tiles; it holds no picture")
    if offsets.count != counts.count:
        raise NotAnImageError(f"the TIFF lists {offsets.count} strips but {counts.count} lengths")
    starts, lengths = offsets.integers(), counts.integers()
    if not starts or len(starts) != len(lengths):
        raise TruncatedImageError("the TIFF's strip table lies outside the file; the upload was cut off")
    if not _ends_inside(directory, file_bytes):
        raise TruncatedImageError("the TIFF's pixel data go beyond the file's end; the upload was cut off")
    stored = width * height * _value(directory, 277, 1) * max(_value(directory, 258, 1), 1) / 8
    if _value(directory, 259, 1) == 1 and _value(directory, 262, 1) != 6 and sum(lengths) < 0.999 * stored:
        raise TruncatedImageError(
            f"the TIFF holds {sum(lengths)} bytes of pixels where {stored:.0f} are needed"
        )


def _check_colours(directory: Directory) -> None:
    """Refuse numbers that stand for other things than light of three colours, before they are stored."""
    kind, samples = _value(directory, 262, 1), _value(directory, 277, 1)
    named = _OTHER_COLOURS.get(kind, f"kind {kind}")
    if kind not in _READ_COLOURS:
        raise UnsupportedFormatError(f"the TIFF's colours are {named}; convert it to RGB")
    if samples > 4 or (kind == 2 and samples < 3):
        raise UnsupportedFormatError(f"a picture of {samples} channels is no photo; give RGB")
    if _value(directory, 339, 1) not in {1, 3, 4}:
        raise UnsupportedFormatError("the TIFF's numbers are signed or complex; save it with 8 or 16 bits")
    chroma = directory.get(530)
    steps = (2, 2) if chroma is None else chroma.integers(2)
    if kind == 6 and _value(directory, 259, 1) not in _JPEG and steps != (1, 1):
        raise UnsupportedFormatError(
            f"the TIFF stores one colour (YCbCr) for {' x '.join(map(str, steps))} pixels; convert it to RGB"
        )


_CIFF_CAMERA: Final = re.compile(rb"Canon\0([ -~]{1,60})\0")
"""Record 0x080A of a CRW file: maker and model (CIFF 1.0, 1997)."""


def read_raw(buffer: Buffer, limits: Limits) -> Header:
    """Find the TIFF structures of RAW files that are not plain TIFF; LibRaw tells their size."""
    head = bytes(buffer[:12])
    if head[4:12] == b"ftypcrx ":
        return Header("raw", tiff=tuple(_canon_boxes(buffer)))
    if head[6:].startswith(b"HEAPCC"):
        named = _CIFF_CAMERA.search(buffer)
        return Header("raw", camera=("Canon", "" if named is None else named[1].decode("ascii")))
    if head.startswith(b"FUJIFILMCCD"):
        return _fujifilm(buffer, limits)
    reader = TiffReader.open(buffer)
    if reader is None:
        return Header("raw")
    header, chain = Header("raw", tiff=(reader,)), list(reader.chain())
    if chain:
        _, largest = max(_with_children(reader, chain), key=_pixels)
        header = _sized(replace(header, xmp=_block(chain[0][1], 700)), largest)
    check_size(header.width, header.height, len(buffer), limits)
    return header


def _fujifilm(buffer: Buffer, limits: Limits) -> Header:
    """Read what the JPEG in a RAF says."""
    at = int.from_bytes(bytes(buffer[84:88]), "big")
    if bytes(buffer[at : at + 3]) == b"\xff\xd8\xff":
        with contextlib.suppress(NotAnImageError, TruncatedImageError):
            preview = read_jpeg(bytes(buffer[at : at + MAX_BLOCK_BYTES]), limits)
            return Header("raw", tiff=preview.tiff, xmp=preview.xmp)
    return Header("raw")


def _canon_boxes(buffer: Buffer) -> Iterator[TiffReader]:
    """Yield the TIFF structures CMT1 (camera) and CMT2 (EXIF) of a CR3."""
    head = bytes(buffer[: 1 << 16])
    for name in (b"CMT1", b"CMT2"):
        at = head.find(name)
        if at > 0 and (reader := TiffReader.open(buffer, at + 4)):
            yield reader
