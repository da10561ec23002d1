"""Which places of a picture are looked at, and their crops side by side."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.gallery.pictures import Rendered
from lab.images import Picture as Shown
from lab.images import crop_boxes

SIDE: Final = 96
ZOOM: Final = 3
"""Pixels of a crop, and how many times each is shown."""

WORST: Final = 3  # crops of the worst places (chosen)
_BLOCK: Final = 48  # pixels of a square that is scored: half a crop, so that one shows all of it
_EVEN: Final = 0.02
"""Added to the local contrast: a change of an even place counts against it, not against nothing."""
_GAP: Final = 6  # pixels between crops (chosen)

Place = tuple[str, int, int]
"""Name, first row and first column."""


def places(
    before: Rendered,
    after: Rendered,
    named: Sequence[tuple[str, Sequence[int] | None]] = (),
) -> list[Place]:
    """Centre, corners, and the three places where most was changed."""
    height, width = before.shape[:2]
    side = side_of(before)
    found: list[Place] = [(name, *box) for name, box in crop_boxes(height, width, side).items()]
    for number, (row, col) in enumerate(_peaks(_change(before, after), side), start=1):
        found.append((f"most changed {number}", *_inside(row, col, side, height, width)))
    for name, pixel in named:
        if pixel is None:
            continue
        row, col = _inside(pixel[0], pixel[1], side, height, width)
        if all(max(abs(row - r), abs(col - c)) > side // 2 for _, r, c in found):
            found.append((name, row, col))
    return found


def side_of(picture: Rendered) -> int:
    """Side of the crops of a picture: less where it is small."""
    return min(SIDE, picture.shape[0] // 2, picture.shape[1] // 2)


def sheet(pictures: Sequence[Rendered], row: int, col: int, side: int) -> Shown:
    """One place of several pictures side by side, each pixel as a square of three."""
    tall = side * ZOOM
    out = np.full((tall, len(pictures) * (tall + _GAP) - _GAP, 3), 255, dtype=np.uint8)
    for number, picture in enumerate(pictures):
        crop = (picture[row : row + side, col : col + side] // 257).astype(np.uint8)
        left = number * (tall + _GAP)
        out[:, left : left + tall] = crop.repeat(ZOOM, axis=0).repeat(ZOOM, axis=1)
    return out


def _change(before: Rendered, after: Rendered) -> NDArray[np.float64]:
    """Mean change of each block over the original's contrast there."""
    across = before.shape[1] // _BLOCK
    rows = []
    for row in range(0, before.shape[0] - _BLOCK + 1, _BLOCK):
        strips = []
        for picture in (before, after):
            strip = np.asarray(picture[row : row + _BLOCK, : across * _BLOCK], dtype=np.float64) / 65535.0
            strips.append(strip.reshape(_BLOCK, across, _BLOCK, 3))
        old, new = strips
        contrast = old.std(axis=(0, 2)).mean(axis=-1)
        rows.append(np.abs(new - old).mean(axis=(0, 2, 3)) / (contrast + _EVEN))
    return np.array(rows)


def _peaks(score: NDArray[np.float64], side: int) -> list[tuple[int, int]]:
    """Middles of the highest blocks whose crops do not overlap; none where nothing was changed."""
    apart = -(-side // _BLOCK)
    left = score.copy()
    found: list[tuple[int, int]] = []
    while len(found) < WORST and left.size and left.max() > 0.0:
        row, col = (int(k) for k in np.unravel_index(int(left.argmax()), left.shape))
        found.append((row * _BLOCK + _BLOCK // 2, col * _BLOCK + _BLOCK // 2))
        left[max(row - apart, 0) : row + apart + 1, max(col - apart, 0) : col + apart + 1] = 0.0
    return found


def _inside(row: int, col: int, side: int, height: int, width: int) -> tuple[int, int]:
    """First pixel of a crop around a pixel."""
    return min(max(row - side // 2, 0), height - side), min(max(col - side // 2, 0), width - side)
