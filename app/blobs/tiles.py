"""A picture for the pages as one file: JPEG tiles of each size, after a table of where each one lies.

A child writes it, since only children decode photos; the API hands out its bytes and decodes nothing. It
begins with `_HEAD`, then the offsets of its pictures and the end of the last, 8 bytes each, little-endian.
Its pictures are the whole one, small parts at nine places, and the tiles row by row, first those pixel
by pixel, then those of half the size, until one tile holds all.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from app.blobs.storage import Storage
from app.errors import NotReadyError, UnknownError

TILE: Final = 512  # side of a tile in pixels, as `static/viewer.js` has it
# Longer side of the whole picture in pixels at most (chosen): fills most screens until there are tiles
WHOLE: Final = 1600
# Places of the small parts, as fractions of height and width
PLACES: Final = tuple((row, col) for row in (0.0, 0.5, 1.0) for col in (0.0, 0.5, 1.0))
# Height and width of a small part in pixels (chosen): nine of them fill the width of a page
PART: Final = (170, 255)
# Bytes of one picture at most (chosen): JPEG of noise takes 1 MiB for a tile, 3 MiB for the whole
MAX_PICTURE: Final = 4 << 20
_HEAD: Final = struct.Struct("<4sIII")  # signature, height, width, number of pictures
_SIGNATURE: Final = b"LTL1"
_FIRST_TILE: Final = 1 + len(PLACES)


def write_tiles(path: Path, picture: NDArray[np.uint8]) -> None:
    """Write the tiles of an upright picture, `(row, col, 3)`."""
    height, width = picture.shape[:2]
    count = _FIRST_TILE + sum(rows * cols for rows, cols in _levels(height, width))
    ends = [_HEAD.size + 8 * (count + 1)]
    with path.open("wb") as file:
        file.seek(ends[0])
        for part in _pictures(Image.fromarray(picture)):
            part.save(file, "JPEG", quality=92, subsampling=0)
            ends.append(file.tell())
        file.seek(0)
        file.write(_HEAD.pack(_SIGNATURE, height, width, count) + struct.pack(f"<{count + 1}Q", *ends))


def _levels(height: int, width: int) -> list[tuple[int, int]]:
    """Return how many rows and columns of tiles each size has."""
    levels = []
    while height and width:
        levels.append((-(-height // TILE), -(-width // TILE)))
        if max(height, width) <= TILE:
            break
        height, width = -(-height // 2), -(-width // 2)
    return levels


def _pictures(picture: Image.Image) -> Iterator[Image.Image]:
    width, height = picture.size
    yield picture.reduce(-(-max(width, height) // WHOLE))
    for row, col in PLACES:
        top = max(0, min(round(row * height - PART[0] / 2), height - PART[0]))
        left = max(0, min(round(col * width - PART[1] / 2), width - PART[1]))
        yield picture.crop((left, top, min(left + PART[1], width), min(top + PART[0], height)))
    for rows, cols in _levels(height, width):
        width, height = picture.size
        for top, left in ((row * TILE, col * TILE) for row in range(rows) for col in range(cols)):
            yield picture.crop((left, top, min(left + TILE, width), min(top + TILE, height)))
        picture = picture.reduce(2)


def whole(storage: Storage, key: str) -> bytes:
    """Return the whole picture of stored tiles."""
    return _read(storage, key, 0)


def part(storage: Storage, key: str, place: int) -> bytes:
    """Return the small part at one of `PLACES`."""
    if not 0 <= place < len(PLACES):
        raise UnknownError("photo", f"with a place {place}")
    return _read(storage, key, 1 + place)


def tile(storage: Storage, key: str, level: int, col: int, row: int) -> bytes:
    """Return a tile of the picture halved `level` times."""
    height, width, _ = _table(storage, key)
    levels = _levels(height, width)
    if not (level < len(levels) and row < levels[level][0] and col < levels[level][1]):
        raise UnknownError("photo", f"with a tile {level}/{col}_{row}")
    before = sum(rows * cols for rows, cols in levels[:level])
    return _read(storage, key, _FIRST_TILE + before + row * levels[level][1] + col)


def _read(storage: Storage, key: str, number: int) -> bytes:
    offsets = _table(storage, key)[2]
    return b"".join(storage.stream(key, offsets[number], offsets[number + 1]))


def _table(storage: Storage, key: str) -> tuple[int, int, tuple[int, ...]]:
    """Return height, width and offsets."""
    try:
        return _checked(storage, key, storage.size(key))  # made anew it has another size
    except FileNotFoundError as error:
        raise NotReadyError("there is no such picture yet: wait for the job that makes it") from error


@lru_cache(maxsize=256)
def _checked(storage: Storage, key: str, size: int) -> tuple[int, int, tuple[int, ...]]:
    """Read the table as untrusted, since a child wrote it."""
    try:
        head = b"".join(storage.stream(key, 0, min(size, _HEAD.size)))
        signature, height, width, count = _HEAD.unpack(head)
        expected = _FIRST_TILE + sum(rows * cols for rows, cols in _levels(height, width))
        start = _HEAD.size + 8 * (count + 1)
        if signature == _SIGNATURE and count == expected and start <= size:
            offsets = struct.unpack(f"<{count + 1}Q", b"".join(storage.stream(key, _HEAD.size, start)))
            fit = all(0 < end - begin <= MAX_PICTURE for begin, end in pairwise(offsets))
            if offsets[0] == start and offsets[-1] <= size and fit:
                return height, width, offsets
    except struct.error:
        pass  # too short
    raise NotReadyError("this picture is damaged: ask for the work anew")
