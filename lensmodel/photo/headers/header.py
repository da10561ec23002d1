"""What a container says of its picture, before a pixel is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from lensmodel.core.errors import DecompressionBombError, ImageTooLargeError
from lensmodel.photo.headers.ifd import TiffReader
from lensmodel.photo.values import FileKind, Limits

MAX_BLOCK_BYTES: Final = 8 << 20
"""Largest ICC profile or XMP packet that is read."""

BOMB_MEGAPIXELS: Final = 4.0
"""Below this a false claim costs nothing worth refusing."""

BOMB_PIXELS_PER_BYTE: Final = 200.0
"""An evenly grey JPEG reaches about 100 pixels a byte, and a photograph is never evenly grey."""

MAX_SEGMENTS: Final = 4096
"""Segments of a JPEG or chunks of a PNG that are looked at; image data do not count."""


@dataclass(frozen=True, slots=True)
class Header:
    """What the container says: kind, size and the blocks in which metadata lie."""

    kind: FileKind  # kind of file
    width: int = 0  # size as stored; 0 where only LibRaw can tell
    height: int = 0
    channels: int = 0  # samples of a pixel; 0 unknown
    bits: int = 0  # bits of a sample; 0 unknown
    compression: int = 1  # TIFF tag 259; 1 is none
    directory: int = 0  # offset of the directory of a TIFF's picture; 0 where it is not said which
    tiff: tuple[TiffReader, ...] = ()  # TIFF structures with EXIF in them
    camera: tuple[str, str] | None = None  # maker and model of a CRW file, which has no TIFF structure
    xmp: bytes | None = None  # XMP packet, and ICC profile: of a PNG also one made of what its chunks declare
    icc: bytes | None = None
    # median step of the quantised cosine coefficients of luma in a JPEG, or in the tiles of a lossy DNG, in
    # 8-bit numbers; 0 unknown, or not compressed so
    coarseness: float = 0.0
    # WhiteLevel of a DNG, of all channels or of each; empty where it does not say
    white: tuple[int, ...] = ()
    opcodes_2: bytes = b""  # OpcodeList2 and 3 of a DNG
    opcodes_3: bytes = b""
    # rows and columns of pixels that share one value of a JPEG's chroma
    chroma_step: tuple[int, int] = (1, 1)
    whole: bool = True  # false where the file ends before its picture does


def check_size(width: int, height: int, file_bytes: int, limits: Limits) -> None:
    """Refuse what would be too large to decode."""
    megapixels = width * height / 1e6
    proportion = width * height / max(file_bytes, 1)
    if megapixels > BOMB_MEGAPIXELS and proportion > BOMB_PIXELS_PER_BYTE:
        raise DecompressionBombError(
            f"{file_bytes} bytes claim to be {width} x {height} pixels; no photograph is packed like that"
        )
    if megapixels > limits.max_megapixels:
        raise ImageTooLargeError(
            f"{width} x {height} pixels are {megapixels:.0f} MP; "
            f"the limit is {limits.max_megapixels:g} MP, scale or crop it"
        )
