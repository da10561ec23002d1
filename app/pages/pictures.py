"""Places of the upright picture and of the sensor, which an EXIF orientation relates."""

from __future__ import annotations

from typing import Final, TypeVar

from app.blobs.storage import Storage
from app.schemas import PatchOut, Region

N = TypeVar("N", int, float)


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
