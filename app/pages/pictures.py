"""Small pictures for the pages, upright: previews in any size, and 1:1 crops."""

from __future__ import annotations

import io
import threading
from functools import lru_cache
from typing import Final, TypeVar

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from app.blobs.storage import Storage
from app.errors import NotReadyError, UnknownPictureError
from app.schemas import PatchOut, Region
from lensmodel.photo import upright

Picture = NDArray[np.uint8]
N = TypeVar("N", int, float)

TILE: Final = 512
"""Side of a tile in pixels, as `static/tiles.js` has it."""


def upright_patch(patch: PatchOut, height: int, width: int, orientation: int) -> PatchOut:
    """Return a window in the coordinates of the upright picture."""
    row, col = _turned(patch.row, patch.col, height - patch.size, width - patch.size, orientation)
    return patch.model_copy(update={"row": row, "col": col})


def upright_point(row: float, col: float, height: int, width: int, orientation: int) -> tuple[int, int]:
    """Return a point, `(row, col)`, in the coordinates of the upright picture."""
    row, col = _turned(row, col, height - 1, width - 1, orientation)
    return round(row), round(col)


def _turned(row: N, col: N, last_row: int, last_col: int, orientation: int) -> tuple[N, N]:
    """Turn a place that lies in rows 0..last_row and columns 0..last_col as an EXIF orientation says."""
    below, right = last_row - row, last_col - col
    return {
        1: (row, col),
        2: (row, right),
        3: (below, right),
        4: (below, col),
        5: (col, row),
        6: (col, below),
        7: (right, below),
        8: (right, row),
    }.get(orientation, (row, col))


_BACK: Final = {6: 8, 8: 6}
"""EXIF orientations whose inverse differs from them, with that inverse."""


def in_sensor(part: Region, height: int, width: int, orientation: int) -> Region:
    """Return a part of the upright picture in the coordinates of the sensor.

    Parameters
    ----------
    part : Region
        In pixels of the upright picture.
    height, width : int
        Of the picture as the sensor has it.
    orientation : int
        EXIF orientation.
    """
    shape = (width, height) if orientation > 4 else (height, width)
    back = _BACK.get(orientation, orientation)
    corners = [
        upright_point(row, col, *shape, back)
        for row in (part.y, part.y + part.height - 1)
        for col in (part.x, part.x + part.width - 1)
    ]
    rows, cols = [row for row, _ in corners], [col for _, col in corners]
    return Region(x=min(cols), y=min(rows), width=max(cols) - min(cols) + 1, height=max(rows) - min(rows) + 1)


def exists(storage: Storage, key: str) -> bool:
    """Say whether a picture is stored."""
    try:
        storage.info(key)
    except FileNotFoundError:
        return False
    return True


def stored(storage: Storage, key: str) -> bytes:
    """Return a picture that a worker has made."""
    try:
        return storage.get(key)
    except FileNotFoundError as error:
        raise NotReadyError("there is no such picture yet: wait for the job that makes it") from error


def shrunk_preview(data: bytes, side: int) -> bytes:
    """Make a preview smaller, its longer side at most `side` pixels."""
    with Image.open(io.BytesIO(data)) as image:
        kind = str(image.format)
        if max(image.size) <= side:
            return data
        image.thumbnail((side, side))
        out = io.BytesIO()
        image.save(out, kind)
    return out.getvalue()


def crop(picture: Picture, row: float, col: float, height: int, width: int) -> bytes:
    """Render a 1:1 part of a picture, around a place given in shares of it."""
    top, left = corner(picture.shape[:2], row, col, height, width)
    return png(picture[top : top + height, left : left + width])


def corner(shape: tuple[int, ...], row: float, col: float, height: int, width: int) -> tuple[int, int]:
    """Top-left pixel of a window around a place, kept inside the picture."""
    top = round(row * shape[0] - height / 2)
    left = round(col * shape[1] - width / 2)
    return max(0, min(top, shape[0] - height)), max(0, min(left, shape[1] - width))


def level(storage: Storage, key: str, media_type: str, orientation: int, half: int) -> Picture:
    """Return an upright 8-bit picture, halved `half` times; the newest few are kept.

    The tiles of a page are asked for all at once: the first one decodes, the others wait for it.
    """
    with _DECODING[hash(key) % len(_DECODING)]:
        return _level(storage, key, media_type, orientation, half)


def decoded(storage: Storage, key: str, media_type: str, orientation: int) -> Picture:
    """Return an upright 8-bit picture in its full size, see `level`."""
    return level(storage, key, media_type, orientation, 0)


_DECODING: Final = tuple(threading.RLock() for _ in range(16))
"""Locks by the hash of the key (16 chosen): one picture is decoded once, different ones at the same time."""


@lru_cache(maxsize=12)
def _level(storage: Storage, key: str, media_type: str, orientation: int, half: int) -> Picture:
    if half > 0:
        larger = _level(storage, key, media_type, orientation, half - 1)
        height, width = larger.shape[0] // 2 * 2, larger.shape[1] // 2 * 2
        if not height or not width:
            return larger
        four = larger[:height, :width].astype(np.uint16)
        mean = (four[::2, ::2] + four[1::2, ::2] + four[::2, 1::2] + four[1::2, 1::2] + 2) >> 2
        return mean.astype(np.uint8)
    return _decoded(storage, key, media_type, orientation)


@lru_cache(maxsize=3)
def _decoded(storage: Storage, key: str, media_type: str, orientation: int) -> Picture:
    data = stored(storage, key)
    if media_type == "image/tiff":
        pixels = tifffile.imread(io.BytesIO(data))
        pixels = (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels
    else:
        with Image.open(io.BytesIO(data)) as image:
            pixels = np.asarray(image.convert("RGB"))
    turned = 1 if media_type == "image/png" else orientation  # PNG is written upright
    return np.ascontiguousarray(upright(pixels, turned), dtype=np.uint8)


def tile(picture: Picture, col: int, row: int) -> bytes:
    """Render one of the tiles that a picture is cut into, from the top left."""
    part = picture[row * TILE : (row + 1) * TILE, col * TILE : (col + 1) * TILE]
    if not part.size:
        raise UnknownPictureError(f"the picture has no tile in column {col}, row {row}")
    return jpeg(part)


def jpeg(picture: Picture) -> bytes:
    """Encode as JPEG of high quality without chroma subsampling."""
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(out, "JPEG", quality=92, subsampling=0)
    return out.getvalue()


def png(picture: Picture) -> bytes:
    """Encode as PNG."""
    out = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(picture)).save(out, "PNG", compress_level=3)
    return out.getvalue()
