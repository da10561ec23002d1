"""PSNR and SSIM of a photo by zone, block by block at the best shift."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from lensmodel import quality
from lensmodel.core.geometry import CENTER_ZONE_R, CORNER_ZONE_R, Frame
from lensmodel.core.types import ZONES, Planes, Zone

BLOCK: Final = 128  # pixels of a side (chosen)
BORDER: Final = 8  # pixels of a block that do not count: more than it is shifted
EVERY: Final = 120
"""Up to so many blocks all are looked at, of more every second one, as on a chessboard."""

_LARGEST_SHIFT = 3.0  # pixels (chosen)
_CORE = (slice(BORDER, -BORDER), slice(BORDER, -BORDER))


@dataclass(frozen=True, slots=True)
class _Sum:
    """Squared errors and SSIM of the pixels of a zone, summed."""

    error: float = 0.0
    likeness: float = 0.0
    count: int = 0

    def plus(self, other: _Sum) -> _Sum:
        return _Sum(self.error + other.error, self.likeness + other.likeness, self.count + other.count)


def fidelity(image: Planes, reference: Planes, frame: Frame) -> dict[str, dict[str, float]]:
    """PSNR in dB and SSIM of sRGB-encoded pictures by zone.

    Each block of 128 pixels is compared at its best shift, as `quality.registered_zone_psnr` does and
    for its reasons. SSIM is the mean of its map (Gaussian window of sigma 1.5) over the same pixels.

    Parameters
    ----------
    image, reference : Planes, shape (3, H, W)
        Linear light, white-balanced.
    frame : Frame
        (H, W).

    Returns
    -------
    dict
        `psnr` and `ssim`, each by zone; zones of which no block was looked at are left out.
    """
    wanted, found = quality.to_srgb(reference), quality.to_srgb(image)
    radius = frame.radius_map()

    def compared(corner: tuple[int, int]) -> dict[Zone, _Sum]:
        rows, cols = (slice(start, start + BLOCK) for start in corner)
        return _compared(found[:, rows, cols], wanted[:, rows, cols], radius[rows, cols])

    sums = dict.fromkeys(ZONES, _Sum())
    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        # in the order of the blocks: the same sum for any number of threads
        for part in pool.map(compared, blocks(frame)):
            sums = {zone: total.plus(part[zone]) for zone, total in sums.items()}
    seen = {zone: s for zone, s in sums.items() if s.count}
    return {
        "psnr": {z: float(-10.0 * np.log10(max(s.error / s.count, 1e-30))) for z, s in seen.items()},
        "ssim": {z: s.likeness / s.count for z, s in seen.items()},
    }


def linear_psnr(image: Planes, reference: Planes, frame: Frame) -> dict[Zone, float]:
    """PSNR in dB of linear light by zone, over the blocks of `fidelity`, each at its best shift.

    Parameters
    ----------
    image, reference : Planes, shape (3, H, W)
        Linear light.
    frame : Frame
        (H, W).
    """
    radius = frame.radius_map()
    errors, counts = dict.fromkeys(ZONES, 0.0), dict.fromkeys(ZONES, 0)

    def compared(corner: tuple[int, int]) -> dict[Zone, tuple[float, int]]:
        rows, cols = (slice(start, start + BLOCK) for start in corner)
        moved = _registered(*(p[:, rows, cols].astype(np.float64) for p in (image, reference)))
        error = np.square(moved - reference[:, rows, cols]).mean(axis=0)[_CORE]
        masks = _zones(radius[rows, cols][_CORE])
        return {zone: (float(error[mask].sum()), int(mask.sum())) for zone, mask in masks.items()}

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        for part in pool.map(compared, blocks(frame)):
            for zone, (error, count) in part.items():
                errors[zone] += error
                counts[zone] += count
    return {z: float(-10.0 * np.log10(max(errors[z] / counts[z], 1e-30))) for z in ZONES if counts[z]}


def blocks(frame: Frame) -> list[tuple[int, int]]:
    """Top left pixels of the blocks that are looked at."""
    rows, cols = _starts(frame.height), _starts(frame.width)
    every = [(i + j, row, col) for i, row in enumerate(rows) for j, col in enumerate(cols)]
    thin = len(every) > EVERY
    return [(row, col) for number, row, col in every if not (thin and number % 2)]


def _starts(length: int) -> list[int]:
    return [*range(0, length - BLOCK, BLOCK - 2 * BORDER), length - BLOCK]


def _compared(
    found: NDArray[np.float64], wanted: NDArray[np.float64], radius: NDArray[np.floating]
) -> dict[Zone, _Sum]:
    """Compare one block at its best shift."""
    moved = _registered(found, wanted)
    error = np.square(moved - wanted).mean(axis=0)[_CORE]
    maps = [
        structural_similarity(  # type: ignore[no-untyped-call]  # scikit-image ships no types
            a, b, data_range=1.0, gaussian_weights=True, use_sample_covariance=False, full=True
        )[1]
        for a, b in zip(moved, wanted, strict=True)
    ]
    likeness = np.mean(maps, axis=0)[_CORE]
    return {
        zone: _Sum(float(error[mask].sum()), float(likeness[mask].sum()), int(mask.sum()))
        for zone, mask in _zones(radius[_CORE]).items()
    }


def _registered(found: NDArray[np.float64], wanted: NDArray[np.float64]) -> NDArray[np.float64]:
    """Shift one block to where it lies best."""
    shift = quality.best_shift(found, wanted)
    if max(map(abs, shift)) > _LARGEST_SHIFT:
        shift = (0.0, 0.0)  # nothing in the block says where it lies
    return quality.shifted(found, *shift)


def _zones(r: NDArray[np.floating]) -> dict[Zone, NDArray[np.bool_]]:
    """Pixels of each zone."""
    masks: dict[Zone, NDArray[np.bool_]] = {"center": r < CENTER_ZONE_R, "corner": r > CORNER_ZONE_R}
    masks["mid"] = ~(masks["center"] | masks["corner"])
    return masks
