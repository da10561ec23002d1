"""Small pictures for the pages, upright: previews in any size, and 1:1 crops."""

from __future__ import annotations

import io
import threading
from functools import lru_cache
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from app.errors import NotReadyError
from app.previews import upright
from app.schemas import PatchOut
from app.storage import Storage

Picture = NDArray[np.uint8]


def upright_patch(patch: PatchOut, height: int, width: int, orientation: int) -> PatchOut:
    """Move a window to where it lies in the upright picture."""
    row, col = patch.row, patch.col
    below, right = height - row - patch.size, width - col - patch.size
    moved = {
        1: (row, col),
        2: (row, right),
        3: (below, right),
        4: (below, col),
        5: (col, row),
        6: (col, below),
        7: (right, below),
        8: (right, row),
    }.get(orientation, (row, col))
    return patch.model_copy(update={"row": moved[0], "col": moved[1]})


def stored(storage: Storage, key: str) -> bytes:
    """Return a picture that a worker has made.

    Raises
    ------
    NotReadyError
        If there is none: not made yet.
    """
    try:
        return storage.get(key)
    except FileNotFoundError as error:
        raise NotReadyError("there is no such picture yet: wait for the job that makes it") from error


def resized(data: bytes, side: int) -> bytes:
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
    return png(Image.fromarray(np.ascontiguousarray(picture[top : top + height, left : left + width])))


def corner(shape: tuple[int, ...], row: float, col: float, height: int, width: int) -> tuple[int, int]:
    """Top-left pixel of a window around a place, kept inside the picture."""
    top = round(row * shape[0] - height / 2)
    left = round(col * shape[1] - width / 2)
    return max(0, min(top, shape[0] - height)), max(0, min(left, shape[1] - width))


def decoded(storage: Storage, key: str, media_type: str, orientation: int) -> Picture:
    """Decode a picture to an upright 8-bit one; the newest few are kept.

    The tiles of a page are asked for all at once: the first one decodes, the others wait for it.
    """
    with _DECODING[hash(key) % len(_DECODING)]:
        return _decoded(storage, key, media_type, orientation)


_DECODING: Final = tuple(threading.Lock() for _ in range(16))


@lru_cache(maxsize=4)
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


def png(image: Image.Image) -> bytes:
    """Encode as PNG."""
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=3)
    return out.getvalue()
