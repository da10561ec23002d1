"""Pictures for reports: sRGB as shown, and 1:1 crops of the centre and the corners."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Planes

Picture = NDArray[np.uint8]
"""`(row, col, 3)` sRGB, as shown."""

_EDGE = 4  # pixels of the border that demosaicing leaves unsure (chosen)


def as_shown(planes: Planes, gain: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Picture:
    """Encode linear planes `(3, row, col)` to 8-bit sRGB, each channel times its gain."""
    linear = np.clip(planes * np.asarray(gain, dtype=np.float32)[:, None, None], 0.0, 1.0)
    encoded = np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
    return np.ascontiguousarray(np.moveaxis(np.rint(encoded * 255), 0, -1).astype(np.uint8))


def crop_boxes(height: int, width: int, side: int) -> dict[str, tuple[int, int]]:
    """Top-left pixels of five crops: the centre and the four corners, clear of the border."""
    bottom, right = height - side - _EDGE, width - side - _EDGE
    return {
        "center": ((height - side) // 2, (width - side) // 2),
        "upper left": (_EDGE, _EDGE),
        "upper right": (_EDGE, right),
        "lower left": (bottom, _EDGE),
        "lower right": (bottom, right),
    }
