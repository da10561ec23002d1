"""Parts of figures: five crops side by side, kernels drawn large."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.types import Kernel
from lensmodel.quality.images import Picture, crop_boxes


def strip(picture: Picture, side: int, gap: int = 6) -> Picture:
    """Put the five crops of `crop_boxes` side by side on white, `(side, 5 side + 4 gap, 3)`."""
    side = min(side, picture.shape[0] // 2, picture.shape[1] // 2)
    boxes = crop_boxes(picture.shape[0], picture.shape[1], side)
    sheet = np.full((side, len(boxes) * (side + gap) - gap, 3), 255, dtype=np.uint8)
    for i, (row, col) in enumerate(boxes.values()):
        left = i * (side + gap)
        sheet[:, left : left + side] = picture[row : row + side, col : col + side]
    return sheet


def kernel_tile(kernel: Kernel, zoom: int = 3, gamma: float = 0.5) -> NDArray[np.uint8]:
    """Draw a kernel, its peak white, each pixel `zoom` times; the paper's figures use gamma 0.5."""
    shown = np.rint((kernel / kernel.max()) ** gamma * 255).astype(np.uint8)
    return np.kron(shown, np.ones((zoom, zoom), dtype=np.uint8))
