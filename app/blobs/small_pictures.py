"""Small pictures of photos that children make before these are developed."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Final

import numpy as np
import rawpy
import tifffile
from numpy.typing import NDArray
from PIL import Image, ImageOps

from lensmodel.photo import upright

# Longer side of a thumbnail in pixels at most (chosen): sharp at 240 CSS pixels on a high-density screen
THUMBNAIL_SIDE: Final = 480


def thumbnail(path: Path, kind: str, orientation: int) -> bytes:
    """Render a photo file as a small upright JPEG."""
    if kind in {"jpeg", "png"}:
        with Image.open(path) as image:
            image.draft("RGB", (2 * THUMBNAIL_SIDE, 2 * THUMBNAIL_SIDE))
            shown = ImageOps.exif_transpose(image).convert("RGB")
    elif kind == "tiff":
        pixels = tifffile.imread(path)
        step = max(1, max(pixels.shape[:2]) // THUMBNAIL_SIDE)
        shown = Image.fromarray(upright(_eight_bits(pixels[::step, ::step]), orientation)).convert("RGB")
    else:
        with rawpy.imread(str(path)) as raw:
            shown = Image.fromarray(raw.postprocess(half_size=True, use_camera_wb=True, output_bps=8))
    shown.thumbnail((THUMBNAIL_SIDE, THUMBNAIL_SIDE))
    out = io.BytesIO()
    shown.save(out, "JPEG", quality=82)
    return out.getvalue()


def _eight_bits(pixels: np.ndarray) -> NDArray[np.uint8]:
    if pixels.dtype == np.uint8:
        return np.ascontiguousarray(pixels, dtype=np.uint8)
    if pixels.dtype == np.uint16:
        return (pixels >> 8).astype(np.uint8)
    light = np.clip(np.nan_to_num(pixels.astype(np.float64)), 0.0, 1.0)
    return np.rint(255.0 * light ** (1 / 2.2)).astype(np.uint8)
