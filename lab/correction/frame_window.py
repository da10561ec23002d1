"""Windows of a large frame, photographed through lenses with known PSFs.

A frame of 6 megapixels is photographed only where it is looked at: a window in the centre, one half
way out and one in a corner, where the kernels are those of the whole field.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfField
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel, Planes

FRAME: Final = Frame(2000, 3000)
WINDOW: Final = (320, 480)  # rows and columns (chosen): a whole frame would take too long
CORNERS: Final[dict[str, tuple[int, int]]] = {"center": (840, 1260), "mid": (340, 660), "corner": (0, 0)}
"""First pixel of each window."""
_AROUND, _KERNEL, _NODES = 64, 55, 120
"""Pixels around a window that are corrected with it, across a kernel, and between kernels (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class Constant:
    """One kernel everywhere."""

    kernel: Kernel

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the kernel."""
        return self.kernel


@dataclass(frozen=True, slots=True, eq=False)
class FrameWindow:
    """One window of the frame."""

    zone: str  # its name
    top: int  # first pixel of what was photographed, in the frame
    left: int
    light: Planes  # blurred light without noise, wider than the window by what the correction looks at
    scene: Planes  # the sharp light at the same pixels
    roi: tuple[int, int, int, int]  # the window, as `correct_planes` takes it


def view(zone: str, scene: Planes, field: PsfField) -> FrameWindow:
    """Photograph a window of the frame through a lens."""
    row, col = CORNERS[zone]
    top, left = max(row - _AROUND, 0), max(col - _AROUND, 0)
    height, width = row + WINDOW[0] + _AROUND - top, col + WINDOW[1] + _AROUND - left
    half = _KERNEL // 2
    source = scene[:, : height + 2 * half, : width + 2 * half]
    light = np.zeros((len(CHANNELS), height, width), dtype=np.float32)
    rows, cols = _nodes(height + 2 * half), _nodes(width + 2 * half)
    for c, channel in enumerate(CHANNELS):
        for at_row, weight_row in rows:
            for at_col, weight_col in cols:
                place = FRAME.position(
                    float(np.clip(top - half + at_row, 0, FRAME.height - 1)),
                    float(np.clip(left - half + at_col, 0, FRAME.width - 1)),
                )
                kernel = field.kernel_at(place, channel, _KERNEL).astype(np.float32)
                # The windows act before the blur: a point keeps its light.
                share = source[c] * np.outer(weight_row, weight_col)
                light[c] += signal.oaconvolve(share, kernel, mode="valid").astype(np.float32)
    sharp = np.ascontiguousarray(source[:, half : half + height, half : half + width])
    return FrameWindow(zone, top, left, np.maximum(light, 0.0), sharp, (row, col, *WINDOW))


def _nodes(extent: int) -> list[tuple[float, NDArray[np.float32]]]:
    """Places some 120 pixels apart, and the triangles that share light among them."""
    count = max(2, round(extent / _NODES) + 1)
    places = np.linspace(0, extent - 1, count)
    t = np.arange(extent)
    return [
        (float(p), np.interp(t, places, row).astype(np.float32))
        for p, row in zip(places, np.eye(count), strict=True)
    ]
