"""Windows spread evenly over a whole photo: what attention over many patches wants.

The frame is cut into equal cells, one window in each, moved within the cell to where detail is richest.
Windows that are flat or clipped are left out; nothing else is judged, since the network weighs its patches.
"""

from __future__ import annotations

from typing import Final, Literal

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NoUsablePatchesError
from lensmodel.core.geometry import Frame
from lensmodel.estimation.patches.selector import Patch, Reason, Rejection, Selection
from lensmodel.photo.values import LinearPhoto

_BLOCK: Final = 16  # pixels: a window is eight of them along a side (chosen)
_LEAST_STEP: Final = 64  # pixels between windows: nearer ones share most of their pixels (chosen)
_CLIPPED: Final = 0.02  # of the pixels of a window: statistics of edges suffer beyond
_FULL: Final = 0.98  # of the level at which a plane clips
_SIGNAL: Final = 2.0  # power of gradients over that of noise: below, noise is all there is (chosen)
_MOVES: Final = (-0.8, -0.4, 0.0, 0.4, 0.8)  # within the room of a cell: neighbours do not meet


def spread_evenly(developed: LinearPhoto, *, count: int, size: int) -> Selection:
    """Choose at most `count` windows of side `size`, the same ones always.

    Raises
    ------
    NoUsablePatchesError
        If the photo is smaller than a window, or no window has detail.
    """
    frame = developed.frame
    if min(frame.height, frame.width) < size:
        raise NoUsablePatchesError(
            f"the photo is {frame.width} x {frame.height} px, a patch needs {size}; "
            "use the photo in its full size"
        )
    detail, noise, clipped = _blocks(developed)
    rows, cols = _cells(frame, count, size)
    patches: list[Patch] = []
    rejected: list[Rejection] = []
    for row, row_room in rows:
        for col, col_room in cols:
            moved = [
                (
                    _even(row + a * row_room, frame.height - size),
                    _even(col + b * col_room, frame.width - size),
                )
                for a in _MOVES
                for b in _MOVES
            ]
            looked = [_look(detail, noise, clipped, place, size) for place in dict.fromkeys(moved)]
            usable = [one for one in looked if one[1] == ""]
            score, reason, (top, left) = max(usable or looked, key=lambda one: (one[0], one[2]))
            if reason:
                rejected.append(Rejection(top, left, size, reason))
                continue
            center = (top + (size - 1) / 2.0, left + (size - 1) / 2.0)
            patches.append(Patch(top, left, size, frame.position(*center), min(score / 3.0, 1.0), 0))
    if not patches:
        reasons = sorted({rejection.reason for rejection in rejected})
        raise NoUsablePatchesError(
            f"none of {len(rejected)} windows is usable ({', '.join(reasons)}); "
            "take a scene with fine detail all over, at a lower ISO"
        )
    counts = {reason: sum(r.reason == reason for r in rejected) for reason in ("flat", "clipped")}
    return Selection(tuple(patches), tuple(rejected), counts)


def _cells(
    frame: Frame, count: int, size: int
) -> tuple[list[tuple[float, float]], list[tuple[float, float]]]:
    """First rows and columns of windows in the middle of their cells, with the room to either side."""
    most = [max((side - size) // _LEAST_STEP + 1, 1) for side in (frame.height, frame.width)]
    down = min(max(round((count * frame.height / frame.width) ** 0.5), 1), most[0], count)
    across = min(max(count // down, 1), most[1])

    def along(side: int, number: int) -> list[tuple[float, float]]:
        step = (side - size) / number
        return [((i + 0.5) * step, 0.5 * step) for i in range(number)]

    return along(frame.height, down), along(frame.width, across)


def _even(value: float, most: int) -> int:
    """Round to a pixel of the same colour as the first of a mosaic."""
    return min(max(2 * round(value / 2.0), 0), most // 2 * 2)


def _blocks(
    developed: LinearPhoto,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Power of the gradients of green, that of its noise, and the share of clipped pixels, by block."""
    height, width = (side // _BLOCK * _BLOCK for side in (developed.frame.height, developed.frame.width))
    shape = (height // _BLOCK, width // _BLOCK)
    detail, level, clipped = np.zeros(shape), np.zeros(shape), np.zeros(shape)
    model = developed.coarse_noise[1]
    for index in range(shape[0]):  # strips: a photo may be mapped from a file
        strip = developed.planes[:, index * _BLOCK : (index + 1) * _BLOCK, :width]
        full = np.zeros(strip.shape[1:], dtype=bool)
        for plane, clip in zip(strip, developed.clip, strict=True):
            full |= plane >= _FULL * clip
        green = np.asarray(strip[1, ::2, ::2], dtype=np.float32)
        power = np.zeros_like(green)
        power[:, :-1] += np.diff(green, axis=1) ** 2
        power[:-1] += np.diff(green, axis=0) ** 2
        half = _BLOCK // 2
        detail[index] = power.reshape(half, -1, half).mean(axis=(0, 2))
        level[index] = green.reshape(half, -1, half).mean(axis=(0, 2))
        clipped[index] = full.reshape(_BLOCK, -1, _BLOCK).mean(axis=(0, 2))
    return detail, 4.0 * model.variance(level), clipped  # two differences of two values each


def _look(
    detail: NDArray[np.float64],
    noise: NDArray[np.float64],
    clipped: NDArray[np.float64],
    place: tuple[int, int],
    size: int,
) -> tuple[float, Reason | Literal[""], tuple[int, int]]:
    """Mean logarithm of signal over noise of a window's blocks, and why it is not used."""
    top, left = (round(value / _BLOCK) for value in place)
    part = (slice(top, top + size // _BLOCK), slice(left, left + size // _BLOCK))
    ratio = detail[part] / np.maximum(noise[part], 1e-12)
    score = float(np.log10(np.maximum(ratio, 1.0)).mean())
    reason: Reason | Literal[""]
    reason = "clipped" if clipped[part].mean() > _CLIPPED else "flat" if ratio.mean() < _SIGNAL else ""
    return score, reason, place
