"""Which way a program has turned the pixels of a photo upright.

Cameras store pixels as the sensor lies, wider than high, and say by EXIF how to turn them. A program that
turns them and sets the orientation to 1 hides which side of the picture was the top of the sensor. Most leave
the camera's thumbnail as it was: of both quarter turns that one is right which lays the picture over it.
"""

from __future__ import annotations

import io
import math
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from lensmodel.core.errors import TurnedPixelsError
from lensmodel.photo.containers import Header
from lensmodel.photo.raster import UNDECODABLE, unwarned
from lensmodel.photo.values import PhotoInfo, PhotoMetadata

ORIENTATION: Final = {1: 6, 3: 8}
"""EXIF orientation of the sensor's pixels, by the quarter turns that lead from the upright ones to them."""

_OFFSET, _LENGTH = 0x0201, 0x0202  # of a JPEG thumbnail in the second directory of EXIF
_MOST_BYTES: Final = 1 << 20  # of a thumbnail: the block of EXIF in a JPEG holds 64 KiB
_MOST_PIXELS: Final = 1 << 20
_ROWS: Final = 48  # of both pictures when they are compared (chosen)
_ALIKE: Final = 0.9
"""Correlation of a picture with its own thumbnail, at least (chosen: compression leaves more than .98)."""
_CLEARER: Final = 0.2  # by which the other turn correlates less, at least (chosen)


def turns_to_sensor(path: Path, header: Header, metadata: PhotoMetadata) -> int | None:
    """Quarter turns, counter-clockwise, from the stored pixels to the sensor's; None if nothing tells."""
    if header.height <= header.width or metadata.orientation != 1 or metadata.camera_model is None:
        return 0
    thumbnail = _thumbnail(header)
    if thumbnail is None or thumbnail.height >= thumbnail.width:
        return None
    try:
        with unwarned(), Image.open(path, formats=("JPEG", "PNG", "TIFF")) as image:
            image.draft("L", (256, 256))
            picture = np.asarray(image.convert("L"), dtype=np.float64)
    except UNDECODABLE:
        return None
    aspect = picture.shape[0] / picture.shape[1]
    seen = _sized(_without_bars(np.asarray(thumbnail, dtype=np.float64), aspect), aspect)
    alike = {k: _correlation(_sized(np.rot90(picture, k), aspect), seen) for k in ORIENTATION}
    best, other = sorted(alike, key=alike.__getitem__, reverse=True)
    return best if alike[best] > _ALIKE and alike[best] - alike[other] > _CLEARER else None


def require_known_turn(info: PhotoInfo) -> None:
    """Refuse to learn from a photo of which nobody can tell how it lay on the sensor."""
    if info.turns is None:
        raise TurnedPixelsError(
            "a program has turned its pixels upright, and nothing tells which way: no place of it is "
            "known on the sensor; give the file as the camera wrote it"
        )


def _thumbnail(header: Header) -> Image.Image | None:
    for reader in header.tiff:
        tags, _ = reader.directory(reader.directory(reader.first)[1])
        if start := tags.integer(_OFFSET):
            begin = reader.base + start
            data = bytes(reader.buffer[begin : begin + min(tags.integer(_LENGTH), _MOST_BYTES)])
            try:
                with unwarned():
                    image = Image.open(io.BytesIO(data), formats=("JPEG",))
                if image.width * image.height <= _MOST_PIXELS:
                    return image.convert("L")
            except UNDECODABLE:
                continue
    return None


def _without_bars(thumbnail: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    """The middle of a thumbnail of 4 : 3 that holds a wider picture between black bars."""
    rows = min(thumbnail.shape[0], round(thumbnail.shape[1] / aspect))
    top = (thumbnail.shape[0] - rows) // 2
    return thumbnail[top : top + rows]


def _sized(picture: NDArray[np.float64], aspect: float) -> NDArray[np.float64]:
    size = (math.ceil(_ROWS * aspect), _ROWS)
    small = Image.fromarray(picture.astype(np.float32)).resize(size, Image.Resampling.BOX)
    return np.asarray(small, dtype=np.float64)


def _correlation(one: NDArray[np.float64], two: NDArray[np.float64]) -> float:
    a, b = one - one.mean(), two - two.mean()
    return float((a * b).sum() / max(math.sqrt((a * a).sum() * (b * b).sum()), 1e-9))
