"""Small pictures of photos that children make before these are developed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

import numpy as np
import rawpy
import tifffile
from PIL import Image, ImageOps

from lensmodel.photo import upright

# Longer side of a thumbnail in pixels at most (chosen): sharp at 240 CSS pixels on a high-density screen
THUMBNAIL_SIDE: Final = 480
_EXIF_OF_FLIP: Final = {3: 3, 5: 8, 6: 6}  # libRaw's `flip` as EXIF orientation
_PLAIN: Final = frozenset({"jpeg", "png"})
_ORIENTATION: Final = 0x0112  # EXIF 2.3, tag Orientation


def thumbnail(path: Path, kind: str, orientation: int) -> bytes:
    """Render a photo file as a small upright JPEG, as cheaply as its kind allows."""
    # Of RAW files the camera's embedded preview is used, or where there is none every second pixel
    if kind in _PLAIN:
        with Image.open(path) as image:
            image.draft("RGB", (2 * THUMBNAIL_SIDE, 2 * THUMBNAIL_SIDE))
            return _small(_turned(image, orientation))
    if kind == "tiff":
        pixels = tifffile.imread(path)
        step = max(1, max(pixels.shape[:2]) // THUMBNAIL_SIDE)
        return _small(Image.fromarray(upright(_eight_bits(pixels[::step, ::step]), orientation)))
    with rawpy.imread(str(path)) as raw:
        flip = _EXIF_OF_FLIP.get(int(raw.sizes.flip), 1)
        try:
            thumb = raw.extract_thumb()
        except rawpy.LibRawError:  # type: ignore[attr-defined, unused-ignore]  # it has no types
            return _small(Image.fromarray(raw.postprocess(half_size=True, use_camera_wb=True, output_bps=8)))
        if isinstance(thumb.data, bytes):
            with Image.open(io.BytesIO(thumb.data)) as image:
                image.draft("RGB", (2 * THUMBNAIL_SIDE, 2 * THUMBNAIL_SIDE))
                return _small(_turned(image, flip))
        return _small(Image.fromarray(np.ascontiguousarray(upright(thumb.data, flip))))


def _turned(image: Image.Image, orientation: int) -> Image.Image:
    """Turn a picture upright by its own EXIF orientation, else by the given one."""
    if image.getexif().get(_ORIENTATION):
        return ImageOps.exif_transpose(image)
    return Image.fromarray(np.ascontiguousarray(upright(np.asarray(image.convert("RGB")), orientation)))


def _eight_bits(pixels: np.ndarray) -> np.ndarray:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels)
    if pixels.dtype == np.uint16:
        return (pixels >> 8).astype(np.uint8)
    light = np.clip(np.nan_to_num(pixels.astype(np.float64)), 0.0, 1.0)
    return np.rint(255.0 * light ** (1 / 2.2)).astype(np.uint8)


def _small(image: Image.Image) -> bytes:
    shown = image.convert("RGB")
    shown.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    out = io.BytesIO()
    shown.save(out, "JPEG", quality=82)
    return out.getvalue()
