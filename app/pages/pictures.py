"""Small pictures for the pages, upright: previews, 1:1 crops, the r-map over a photo."""

from __future__ import annotations

import io
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from PIL import Image

from app.errors import NotReadyError
from app.schemas import PatchOut
from lensmodel.errors import InvalidInputError
from lensmodel.patches import r_map
from lensmodel.photo import LinearPhoto, shown
from lensmodel.pipeline import load_developed

Picture = NDArray[np.uint8]

_TURN: dict[int, Callable[[NDArray[np.generic]], NDArray[np.generic]]] = {
    1: lambda a: a,
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: lambda a: a.swapaxes(0, 1)[:, ::-1],
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: a.swapaxes(0, 1)[::-1],
}
"""Arrays in sensor orientation to upright ones, by EXIF orientation."""


def upright(pixels: NDArray[np.generic], orientation: int) -> NDArray[np.generic]:
    """Turn an array `(row, col, ...)` from sensor orientation to upright."""
    return _TURN.get(orientation, _TURN[1])(pixels)


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


def open_developed(data_dir: Path, photo_id: str) -> LinearPhoto:
    """Open the developed photo that the worker keeps.

    Raises
    ------
    NotReadyError
        If it is not there: not developed yet, or dropped from the cache.
    """
    try:
        return load_developed(data_dir.resolve() / "developed" / photo_id)
    except InvalidInputError as error:
        raise NotReadyError("this photo has no developed picture yet: wait for its job") from error


def preview(developed: LinearPhoto, side: int) -> bytes:
    """Render a whole photo as JPEG, its longer side at most `side` pixels."""
    step = max(1, max(developed.frame.height, developed.frame.width) // max(side, 1))
    planes = developed.planes
    height, width = planes.shape[1] // step * step, planes.shape[2] // step * step
    mean = planes[:, :height, :width].reshape(3, height // step, step, width // step, step).mean(axis=(2, 4))
    picture = upright(
        shown(np.ascontiguousarray(mean, dtype=np.float32), developed.encoding), orientation_of(developed)
    )
    image = Image.fromarray(np.ascontiguousarray(picture))
    image.thumbnail((side, side))
    out = io.BytesIO()
    image.save(out, "JPEG", quality=85)
    return out.getvalue()


def confidence_map(developed: LinearPhoto, side: int) -> bytes:
    """Render the r-map of the green plane as a PNG of the preview's shape: bright where edges tell."""
    step = max(1, max(developed.frame.height, developed.frame.width) // 1600)
    green = np.ascontiguousarray(developed.planes[1][::step, ::step])
    values = r_map(green)
    scaled = np.clip(values / max(float(np.quantile(values, 0.99)), 1e-6), 0, 1)
    picture = upright((255 * scaled).astype(np.uint8), orientation_of(developed))
    heat = np.zeros((*picture.shape, 3), dtype=np.uint8)
    heat[..., 0], heat[..., 1] = picture, picture // 2
    image = Image.fromarray(heat)
    image.thumbnail((side, side))
    return png(image)


def crop_of_photo(developed: LinearPhoto, row: float, col: float, height: int, width: int) -> bytes:
    """Render a 1:1 part of the photo as it was, around a place given in shares of the upright picture."""
    turned = orientation_of(developed)
    planes = [np.asarray(upright(plane, turned)) for plane in developed.planes]
    top, left = corner(planes[0].shape, row, col, height, width)
    part = np.stack([plane[top : top + height, left : left + width] for plane in planes])
    return png(Image.fromarray(shown(np.ascontiguousarray(part, dtype=np.float32), developed.encoding)))


def crop_of_result(picture: Picture, row: float, col: float, height: int, width: int) -> bytes:
    """Render a 1:1 part of a corrected picture."""
    top, left = corner(picture.shape[:2], row, col, height, width)
    return png(Image.fromarray(np.ascontiguousarray(picture[top : top + height, left : left + width])))


def corner(shape: tuple[int, ...], row: float, col: float, height: int, width: int) -> tuple[int, int]:
    """Top-left pixel of a window around a place, kept inside the picture."""
    top = round(row * shape[0] - height / 2)
    left = round(col * shape[1] - width / 2)
    return max(0, min(top, shape[0] - height)), max(0, min(left, shape[1] - width))


@lru_cache(maxsize=2)
def decoded(read: Callable[[], bytes], key: str, media_type: str, orientation: int) -> Picture:
    """Decode a corrected file to an upright 8-bit picture; the newest two are kept."""
    del key
    data = read()
    if media_type == "image/tiff":
        pixels = tifffile.imread(io.BytesIO(data))
        pixels = (pixels >> 8).astype(np.uint8) if pixels.dtype == np.uint16 else pixels
        return np.ascontiguousarray(upright(pixels, orientation), dtype=np.uint8)
    with Image.open(io.BytesIO(data)) as image:
        pixels = np.asarray(image.convert("RGB"))
    return (
        pixels
        if media_type == "image/png"
        else np.ascontiguousarray(upright(pixels, orientation), dtype=np.uint8)
    )


def orientation_of(developed: LinearPhoto) -> int:
    """EXIF orientation of the photo."""
    return developed.encoding.orientation


def png(image: Image.Image) -> bytes:
    """Encode as PNG."""
    out = io.BytesIO()
    image.save(out, "PNG", compress_level=3)
    return out.getvalue()
