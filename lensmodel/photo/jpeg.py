"""JPEG by Pillow, which sees the picture alone: what a stranger wrote beside it is read here, within bounds.

Pillow joins blocks of Exif in quadratic time, reads all values of their directories into memory however often
they overlap, and warns of each damaged entry. It also drops an ICC profile whose parts are counted wrongly.

Sources: ITU-T T.81, annex B; ICC.1:2022, annex B.4 (the parts of a profile).
"""

from __future__ import annotations

import io
from typing import Final

from PIL.JpegImagePlugin import JpegImageFile

from lensmodel.core.errors import NotAnImageError

MAX_READS: Final = 1 << 17  # of a header: four of each segment and one of each stray byte (chosen)
_NUMBER: Final = 12  # of a part of a profile: its place, behind the identifying text
_DATA: Final = 14


class JpegSegments(io.BytesIO):
    """Bytes of a JPEG for Pillow; Exif and profile in its header are kept here, and blank there."""

    def __init__(self, data: bytes) -> None:
        super().__init__(data)
        self.exif, self.parts = list[bytes](), list[bytes]()
        self.reads, self.in_header = 0, True

    def read(self, size: int | None = -1, /) -> bytes:
        """Read on, as a file does."""
        data = super().read(size)
        if not self.in_header:
            return data
        self.reads += 1
        if self.reads > MAX_READS:
            raise NotAnImageError(
                f"the JPEG's header does not end within {MAX_READS // 4} segments, or "
                f"{MAX_READS} stray bytes; save it anew from the original"
            )
        if data.startswith(b"Exif\0"):
            self.exif.append(data)
        elif data.startswith(b"ICC_PROFILE\0"):
            self.parts.append(data)
        else:
            return data
        return bytes(len(data))

    def profile(self) -> bytes | None:
        """Put the parts of the ICC profile together by their numbers, however many they say to be."""
        ordered = sorted(dict.fromkeys(self.parts), key=lambda part: part[_NUMBER : _NUMBER + 1])
        return b"".join(part[_DATA:] for part in ordered) if ordered else None


def opened_jpeg(segments: JpegSegments) -> JpegImageFile:
    """Read the header of a JPEG, of several pictures that of the first."""
    image = JpegImageFile(segments)
    segments.in_header = False
    return image
