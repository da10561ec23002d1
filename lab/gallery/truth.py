"""What a correction gained against a known truth: by zone, and block by block.

A blind method leaves the place of the picture free, and a PSF's centre of mass is not its core: each block is
compared after its own best shift, estimated here and applied to the truth, which has no noise.
Like `figures`, this uses none of the library's code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lab.gallery.figures import Shown, luma

Stored: TypeAlias = NDArray[np.floating] | NDArray[np.uint16]
"""A picture `(row, col, 3)`, sRGB-encoded: 0 to 1, or whole numbers up to 65535."""

BLOCK: Final = 128  # pixels of a side (chosen)
LOSS_DB: Final = 0.5
"""A block that loses more than this counts."""

ZONE_LIMITS: Final = {"center": (0.0, 0.3), "mid": (0.3, 0.75), "corner": (0.75, 1.01)}
"""Distances from the middle in half diagonals, as the documentation defines them."""

_MARGIN: Final = 8  # pixels around a block: more than it is shifted
_LARGEST_SHIFT: Final = 3.0  # pixels (chosen): beyond, nothing in the block says where it lies
_STEPS: Final = 4  # of Gauss-Newton (chosen)
_LEAST_ERROR: Final = 1e-8  # mean square, full scale is 1 (chosen): 80 dB, so that ratios stay finite


@dataclass(frozen=True, slots=True)
class Gains:
    """What a correction gained against the truth; positive is better.

    Parameters
    ----------
    zones : dict of str to float
        dB of PSNR of the shown picture in each zone.
    worst_db : float
        Gain of the worst block.
    worst_at : tuple of int
        Its first row and column.
    loss_share : float
        Share of blocks that lose more than `LOSS_DB`.
    blocks : int
        How many there are.
    """

    zones: dict[str, float]
    worst_db: float
    worst_at: tuple[int, int]
    loss_share: float
    blocks: int


def gains(before: Stored, after: Stored, truth: Stored) -> Gains | None:
    """Compare original and corrected picture with the truth; None where not one block fits.

    Parameters
    ----------
    before, after, truth : Stored, shape (row, col, 3)
        May be memory-mapped.
    """
    height, width = truth.shape[:2]
    if min(height, width) < BLOCK + 2 * _MARGIN:
        return None
    errors = {zone: np.zeros(2) for zone in ZONE_LIMITS}
    found: list[tuple[float, tuple[int, int]]] = []
    rows = np.arange(height)[:, None] - (height - 1) / 2.0
    cols = np.arange(width)[None, :] - (width - 1) / 2.0
    radius = np.hypot(rows, cols) / (math.hypot(height, width) / 2.0)
    for row in _starts(height):
        for col in _starts(width):
            wide = (
                slice(row - _MARGIN, row + BLOCK + _MARGIN),
                slice(col - _MARGIN, col + BLOCK + _MARGIN),
            )
            sharp = unit(truth[wide])
            pair = [_error(unit(picture[wide]), sharp) for picture in (before, after)]
            r = radius[row : row + BLOCK, col : col + BLOCK]
            for zone, (low, high) in ZONE_LIMITS.items():
                inside = (r >= low) & (r < high)
                errors[zone] += [float(error[inside].sum()) for error in pair]
            found.append((_gain(*(float(error.mean()) for error in pair)), (row, col)))
    worst, at = min(found)
    return Gains(
        {zone: _gain(old, new) for zone, (old, new) in errors.items() if old > 0.0},
        worst,
        at,
        float(np.mean([gain < -LOSS_DB for gain, _ in found])),
        len(found),
    )


def unit(part: Stored) -> NDArray[np.float64]:
    """Bring whole numbers of 16 bits to 0..1; leave others."""
    if part.dtype == np.uint16:
        return np.asarray(part, dtype=np.float64) / 65535.0
    return np.asarray(part, dtype=np.float64)


def best_shift(picture: Shown, truth: Shown) -> tuple[float, float]:
    """Rows and columns by which the truth must move to lie on a picture.

    Gauss-Newton steps on the squared difference of lightness (B. Lucas, T. Kanade, "An iterative image
    registration technique", IJCAI 1981); no shift where the truth has too little structure to tell, or
    the answer lies beyond three pixels.
    """
    wanted, sharp = luma(picture), luma(truth)
    inner = (slice(_MARGIN, -_MARGIN), slice(_MARGIN, -_MARGIN))
    shift = np.zeros(2)
    for _ in range(_STEPS):
        moved = ndimage.shift(sharp, shift, order=3, mode="nearest")
        slope = np.stack([d[inner].ravel() for d in np.gradient(moved)])
        normal = slope @ slope.T
        if np.linalg.eigvalsh(normal)[0] < 1e-6 * slope.shape[1]:
            return 0.0, 0.0
        shift -= np.linalg.solve(normal, slope @ (wanted - moved)[inner].ravel())
        if np.abs(shift).max() > _LARGEST_SHIFT:
            return 0.0, 0.0
    return float(shift[0]), float(shift[1])


def _error(picture: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared error of the pixels of a block inside its margin, mean over channels."""
    row, col = best_shift(picture, truth)
    moved = truth
    if max(abs(row), abs(col)) > 0.01:
        moved = np.stack(
            [ndimage.shift(truth[..., k], (row, col), order=5, mode="nearest") for k in range(3)], axis=-1
        )
        moved = np.clip(moved, 0.0, 1.0)
    error: NDArray[np.float64] = np.square(picture - moved).mean(axis=-1)
    return error[_MARGIN:-_MARGIN, _MARGIN:-_MARGIN]


def _gain(old: float, new: float) -> float:
    return 10.0 * math.log10(max(old, _LEAST_ERROR) / max(new, _LEAST_ERROR))


def _starts(length: int) -> list[int]:
    """First pixels of blocks that lie side by side; the last one ends at the border's margin."""
    last = length - BLOCK - _MARGIN
    return sorted({*range(_MARGIN, last, BLOCK), last})
