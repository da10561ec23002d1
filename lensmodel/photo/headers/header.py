"""What a container says of its picture, before a pixel is decoded."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from lensmodel.core.errors import DecompressionBombError, ImageTooLargeError
from lensmodel.photo.headers.ciff import CiffShot
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
    compression : int
        TIFF tag 259; 1 is none.
    directory : int
        Offset of the directory of a TIFF's picture; 0 where it is not said which.
    tiff : tuple of TiffReader
        TIFF structures with EXIF in them.
    ciff : CiffShot or None
        What the heap of a CRW file says, which has no TIFF structure.
    xmp, icc : bytes or None
        XMP packet, and ICC profile: of a PNG also one made of what its chunks declare.
    coarseness : float
        Median step of the quantised cosine coefficients of luma in a JPEG, or in the tiles of a lossy DNG,
        in 8-bit numbers; 0 unknown, or not compressed so.
    white : tuple of int
        WhiteLevel of a DNG, of all channels or of each; empty where it does not say.
    opcodes_2, opcodes_3 : bytes
        OpcodeList2 and 3 of a DNG.
    chroma_step : tuple of int
        Rows and columns of pixels that share one value of a JPEG's chroma.
    """

    kind: FileKind
    width: int = 0
    height: int = 0
    channels: int = 0
    bits: int = 0
    compression: int = 1
    directory: int = 0
    tiff: tuple[TiffReader, ...] = ()
    ciff: CiffShot | None = None
    xmp: bytes | None = None
    icc: bytes | None = None
    coarseness: float = 0.0
    white: tuple[int, ...] = ()
    opcodes_2: bytes = b""
    opcodes_3: bytes = b""
    chroma_step: tuple[int, int] = (1, 1)


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
            f"{width} x {height} pixels are {megapixels:.0f} MP; "
            f"the limit is {limits.max_megapixels:g} MP, scale or crop it"
        )
