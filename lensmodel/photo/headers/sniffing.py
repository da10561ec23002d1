"""What kind of file it is, by its first bytes."""

from __future__ import annotations

from typing import Final

from lensmodel.core.errors import NotAnImageError, UnsupportedFormatError
from lensmodel.photo.values import FileKind

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
