"""Opening a photo file: what kind it is by its first bytes, and what its container says."""

from __future__ import annotations

import contextlib
import mmap
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

from lensmodel.core.errors import ImageTooLargeError, NotAnImageError, UnsupportedFormatError
from lensmodel.photo.headers.header import Header
from lensmodel.photo.headers.ifd import Buffer
from lensmodel.photo.headers.jpeg import read_jpeg
from lensmodel.photo.headers.png import read_png
from lensmodel.photo.headers.tiff import read_raw, read_tiff
from lensmodel.photo.values import FileKind, Limits

HEAD_BYTES: Final = 64
"""Bytes that `sniff` wants to see."""

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


_PARSERS: Final[Mapping[FileKind, Callable[[Buffer, Limits], Header]]] = {
    "raw": read_raw,
    "tiff": read_tiff,
    "png": read_png,
    "jpeg": read_jpeg,
}


@contextlib.contextmanager
def opened_header(path: Path, limits: Limits) -> Iterator[Header]:
    """Map a file and parse its header; the header is valid inside the `with` only."""
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
        kind = sniff(head)
        size = file.seek(0, 2)
        if size > limits.max_bytes:
            raise ImageTooLargeError(f"the file has {size} bytes; the limit is {limits.max_bytes}")
        with mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as buffer:
            yield _PARSERS[kind](buffer, limits)
