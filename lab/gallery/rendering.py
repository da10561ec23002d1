"""Pictures as a viewer sees them: written and read back as files, so that nothing else is judged."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Final

import numpy as np
import tifffile
from numpy.typing import NDArray

from lensmodel.core.types import Planes
from lensmodel.photo import Encoding, write_image

Rendered = NDArray[np.uint16]
"""A picture `(row, col, 3)`, sRGB, 0 to 65535, in sensor orientation."""

_MIDDLE: Final = 1024
"""Pixels on a side of the middle that is compared to find how two pictures lie."""

_TURNED_BACK: Final[Mapping[int, Callable[[Rendered], Rendered]]] = {
    2: lambda a: a[:, ::-1],
    3: lambda a: a[::-1, ::-1],
    4: lambda a: a[::-1],
    5: lambda a: a.swapaxes(0, 1),
    6: np.rot90,
    7: lambda a: a[::-1, ::-1].swapaxes(0, 1),
    8: lambda a: np.rot90(a, -1),
}
"""EXIF orientation -> how to turn an upright picture back as the sensor saw it."""


def rendered(planes: Planes, encoding: Encoding) -> Rendered:
    """Render linear planes as the program writes them for a viewer: an sRGB TIFF of 16 bits."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-gallery-") as name:
        path = Path(name) / "picture.tif"
        write_image(path, planes, encoding, format="tiff16", color_space="srgb")
        return read_rendered(path)


def read_rendered(path: Path) -> Rendered:
    """Read a TIFF of 16 bits a channel."""
    picture: Rendered = tifffile.imread(path)[..., :3].astype(np.uint16, copy=False)
    return picture


def aligned(picture: Rendered, like: Rendered, orientation: int) -> Rendered:
    """Lay another program's picture of a photo on ours: turned back, moved by whole pixels, of our size.

    Other programs turn a photo upright and cut its border differently; what they cut off is black.
    """
    turned = [picture]
    if orientation in _TURNED_BACK:
        turned.append(_TURNED_BACK[orientation](picture))
    scored = [(*_offset(one, like), k) for k, one in enumerate(turned)]
    _, row, col, best = max(scored)
    out = np.zeros_like(like)
    source = turned[best]
    top, left = max(row, 0), max(col, 0)
    bottom, right = min(row + source.shape[0], like.shape[0]), min(col + source.shape[1], like.shape[1])
    out[top:bottom, left:right] = source[top - row : bottom - row, left - col : right - col]
    return out


def _offset(picture: Rendered, like: Rendered) -> tuple[float, int, int]:
    """Height of the peak of the phase correlation of the middles, and where `picture` begins on `like`."""
    side = min(*picture.shape[:2], *like.shape[:2], _MIDDLE)
    corners = [tuple((n - side) // 2 for n in one.shape[:2]) for one in (picture, like)]
    window = np.outer(np.hanning(side), np.hanning(side))
    spectra = []
    for one, (row, col) in zip((picture, like), corners, strict=True):
        green = one[row : row + side, col : col + side, 1].astype(np.float64)
        spectra.append(np.fft.rfft2((green - green.mean()) * window))
    cross = np.conj(spectra[0]) * spectra[1]
    peak = np.fft.irfft2(cross / np.maximum(np.abs(cross), 1e-12), s=(side, side))
    at = np.unravel_index(int(peak.argmax()), peak.shape)
    moved = [int(k) - side if k > side // 2 else int(k) for k in at]
    row, col = (c1 - c0 + m for c0, c1, m in zip(*corners, moved, strict=True))
    return float(peak.max()), int(row), int(col)
