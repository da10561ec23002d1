"""Pictures as an eye sees them, and how close one is to another: as a whole, by zone, block by block."""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import CENTER_ZONE_R, CORNER_ZONE_R, Frame
from lensmodel.core.types import ZONES, Planes, Zone

Encoded: TypeAlias = NDArray[np.floating] | NDArray[np.uint16]

_SHIFT_STEPS: Final = 6  # of Newton: it begins within a pixel, and each step gains digits (chosen)
_SHIFT_PAD: Final = 8  # pixels: more than any shift that is looked for
_LARGEST_SHIFT: Final = 3.0  # pixels (chosen): beyond, nothing in the block says where it lies
_SHIFT_WINDOW: Final = 1024  # pixels: the middle says as much as the whole
_CROP_EDGE: Final = 4  # pixels of the border that demosaicing leaves unsure (chosen)

BLOCK: Final = 128  # pixels of a side (chosen)
BORDER: Final = 8  # pixels of a block that do not count: more than it is shifted
CORE: Final = (..., slice(BORDER, -BORDER), slice(BORDER, -BORDER))

Picture = NDArray[np.uint8]
"""`(row, col, 3)` sRGB, as shown."""


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """Linear light, clipped to 0..1, with the sRGB curve (IEC 61966-2-1): what an eye compares."""
    v = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1.0 / 2.4) - 0.055)


def as_shown(planes: NDArray[np.floating], gain: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Picture:
    """Encode linear planes `(3, row, col)` to 8-bit sRGB `(row, col, 3)`, each channel times its gain."""
    shown = to_srgb(planes * np.asarray(gain, dtype=np.float32)[:, None, None])
    return np.ascontiguousarray(np.moveaxis(np.rint(shown * 255), 0, -1).astype(np.uint8))


def crop_boxes(height: int, width: int, side: int) -> dict[str, tuple[int, int]]:
    """Top-left pixels of five crops: the centre and the four corners, clear of the border."""
    bottom, right = height - side - _CROP_EDGE, width - side - _CROP_EDGE
    return {
        "center": ((height - side) // 2, (width - side) // 2),
        "upper left": (_CROP_EDGE, _CROP_EDGE),
        "upper right": (_CROP_EDGE, right),
        "lower left": (bottom, _CROP_EDGE),
        "lower right": (bottom, right),
    }


def psnr(image: NDArray[np.floating], reference: NDArray[np.floating]) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite for equal pictures."""
    _same_shape(image, reference)
    error = float(np.square(np.subtract(image, reference, dtype=np.float64)).mean())
    return math.inf if error == 0.0 else psnr_of(error)


def _same_shape(image: NDArray[np.floating], reference: NDArray[np.floating]) -> None:
    if image.shape != reference.shape or image.ndim < 2:
        raise InvalidInputError(f"pictures must have the same shape, got {image.shape} and {reference.shape}")


def blocks(frame: Frame, most: int | None = None) -> list[tuple[int, int]]:
    """Top left pixels of blocks that cover the frame with their borders; of more than `most` every second."""
    rows, cols = ([*range(0, n - BLOCK, BLOCK - 2 * BORDER), n - BLOCK] for n in (frame.height, frame.width))
    every = [(i + j, row, col) for i, row in enumerate(rows) for j, col in enumerate(cols)]
    thin = most is not None and len(every) > most
    return [(row, col) for number, row, col in every if not (thin and number % 2)]


def moved(truth: NDArray[np.floating], picture: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return the truth where it lies best on the picture."""
    shift = best_shift(truth, picture)
    return shifted(truth, *(shift if max(map(abs, shift)) <= _LARGEST_SHIFT else (0.0, 0.0)))


def block_error(picture: NDArray[np.floating], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared error of the inner pixels of a block, mean over its channels."""
    return np.asarray(np.square(picture - truth).mean(axis=0)[CORE])


def psnr_of(error: float) -> float:
    """PSNR in dB of a mean squared error, for a peak of 1."""
    return -10.0 * math.log10(max(error, 1e-30))


def _radii(frame: Frame) -> NDArray[np.float64]:
    """R of every pixel."""
    return frame.polar(np.arange(1.0 * frame.height)[:, None], np.arange(1.0 * frame.width)[None, :])[0]


def zone_masks(r: NDArray[np.floating]) -> dict[Zone, NDArray[np.bool_]]:
    """Which pixels lie in each zone, by their radii."""
    masks: dict[Zone, NDArray[np.bool_]] = {"center": r < CENTER_ZONE_R, "corner": r > CORNER_ZONE_R}
    return masks | {"mid": ~(masks["center"] | masks["corner"])}


def best_shift(image: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[float, float]:
    """Shift (row, col) in pixels, up to 3, that brings `image` closest to `reference`.

    Gauss-Newton on the sum of squared differences, s <- s - (G'G)^-1 G'(image(s) - reference), with
    G the picture's gradient; sub-pixel shifts are Fourier shifts of mirrored pictures.
    """
    _same_shape(image, reference)
    rows, cols = (
        slice(max((n - _SHIFT_WINDOW) // 2, 0), max((n - _SHIFT_WINDOW) // 2, 0) + _SHIFT_WINDOW)
        for n in image.shape[-2:]
    )
    a, b = (np.asarray(picture, dtype=np.float64)[..., rows, cols] for picture in (image, reference))
    a, b = (picture.reshape(-1, *picture.shape[-2:]) for picture in (a, b))
    shift = np.zeros(2)
    core = (slice(None), slice(4, -4), slice(4, -4))
    for _ in range(_SHIFT_STEPS):
        moved = shifted(a, float(shift[0]), float(shift[1]))
        # moving a picture by +s takes its values from -s: d moved / ds = -gradient
        gradient = [-np.gradient(moved, axis=axis)[core].ravel() for axis in (-2, -1)]
        residual = (moved - b)[core].ravel()
        normal = np.array([[float(g @ h) for h in gradient] for g in gradient])
        right = np.array([float(g @ residual) for g in gradient])
        if np.linalg.det(normal) <= 1e-12 * max(float(np.trace(normal)), 1e-30) ** 2:
            return 0.0, 0.0
        step = np.clip(np.linalg.solve(normal, right), -1.0, 1.0)
        shift = np.clip(shift - step, -3.0, 3.0)
        if np.abs(step).max() < 1e-4:
            break
    return float(shift[0]), float(shift[1])


def shifted(image: NDArray[np.floating], row: float, col: float) -> NDArray[np.float64]:
    """Move a picture by a real-valued shift, mirrored at its borders; exact for what it resolves."""
    picture = np.asarray(image, dtype=np.float64)
    if row == 0.0 and col == 0.0:
        return picture
    height, width = picture.shape[-2:]
    # mirrored into an even periodic picture there is no jump for the Fourier shift to ring at
    grid = [int(fft.next_fast_len(n + 2 * _SHIFT_PAD, real=True)) for n in (height, width)]
    pads = [(_SHIFT_PAD, n - m - _SHIFT_PAD) for n, m in zip(grid, (height, width), strict=True)]
    inner = np.pad(picture, [(0, 0)] * (picture.ndim - 2) + pads, mode="symmetric")
    even = np.concatenate([inner, inner[..., ::-1, :]], axis=-2)
    even = np.concatenate([even, even[..., ::-1]], axis=-1)
    f_row, f_col = fft.fftfreq(even.shape[-2])[:, None], fft.rfftfreq(even.shape[-1])[None, :]
    phase = np.exp(-2j * np.pi * (f_row * row + f_col * col))
    moved = fft.irfft2(fft.rfft2(even) * phase, s=even.shape[-2:])
    return moved[..., _SHIFT_PAD : _SHIFT_PAD + height, _SHIFT_PAD : _SHIFT_PAD + width]


# --- by zone and by block -----------------------------------------------------------------------

EVERY: Final = 120
"""Up to so many blocks all are compared, of more every second one, as on a chessboard."""

LOSS_DB: Final = 0.5
"""A block that loses more than this counts."""

_LEAST_ERROR: Final = 1e-8  # mean square, full scale is 1 (chosen): 80 dB, so that ratios stay finite


def fidelity(
    image: Planes,
    reference: Planes,
    frame: Frame,
    *,
    srgb: bool = True,
    corners: Sequence[tuple[int, int]] | None = None,
) -> dict[Zone, float]:
    """PSNR in dB by zone, each block of 128 pixels at its best shift, as shown or of linear light.

    A PSF is centred on its centre of mass, and where it has long faint wings on one side that lies
    a pixel or two beside its core. Neither a blind method nor an eye can tell: it is a smooth
    distortion of the picture, not blur. So the truth of each block, which has no noise, is moved to where
    it lies best. Blocks are those at `corners`, or all over the frame; zones without one are left out.
    """
    _same_shape(image, reference)
    if image.shape[-2:] != (frame.height, frame.width) or min(frame.height, frame.width) < BLOCK:
        raise InvalidInputError(f"{frame} is not that of pictures {image.shape}, or smaller than {BLOCK}")
    pair = (to_srgb(image), to_srgb(reference)) if srgb else (image, reference)
    found, wanted = (picture.reshape(-1, *picture.shape[-2:]) for picture in pair)
    radius = _radii(frame)

    def compared(corner: tuple[int, int]) -> dict[Zone, NDArray[np.float64]]:
        window = tuple(slice(start, start + BLOCK) for start in corner)
        picture = found[:, *window]
        error = block_error(picture, moved(wanted[:, *window], picture))
        zones = zone_masks(radius[window][CORE])
        return {zone: np.array([error[mask].sum(), mask.sum()]) for zone, mask in zones.items()}

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        # in the order of the blocks: the same sum for any number of threads
        parts = list(pool.map(compared, blocks(frame, EVERY) if corners is None else corners))
    sums = {zone: np.sum([part[zone] for part in parts], axis=0) for zone in ZONES}
    return {zone: psnr_of(float(error / count)) for zone, (error, count) in sums.items() if count}


@dataclass(frozen=True, slots=True)
class Gains:
    """What a correction gained against the truth in dB of PSNR; positive is better."""

    zones: dict[Zone, float]
    worst_db: float  # gain of the worst block
    worst_at: tuple[int, int]  # its first row and column
    loss_share: float  # share of blocks that lose more than `LOSS_DB`
    blocks: int  # how many there are


def gains(before: Encoded, after: Encoded, truth: Encoded) -> Gains | None:
    """Compare original and corrected picture with the truth, block by block; None where no block fits."""
    frame = Frame(*truth.shape[:2])
    if min(frame.height, frame.width) < BLOCK:
        return None
    radius = _radii(frame)
    errors: dict[Zone, NDArray[np.float64]] = {zone: np.zeros(2) for zone in ZONES}
    found: list[tuple[float, tuple[int, int]]] = []
    for row, col in blocks(frame):
        window = slice(row, row + BLOCK), slice(col, col + BLOCK)
        old, new, sharp = (_unit(picture[window]) for picture in (before, after, truth))
        pair = [block_error(picture, np.clip(moved(sharp, picture), 0.0, 1.0)) for picture in (old, new)]
        for zone, mask in zone_masks(radius[window][CORE]).items():
            errors[zone] += [float(error[mask].sum()) for error in pair]
        found.append((_gain(*(float(error.mean()) for error in pair)), (row, col)))
    worst, at = min(found)
    return Gains(
        {zone: _gain(*map(float, pair)) for zone, pair in errors.items() if pair[0] > 0.0},
        worst,
        at,
        float(np.mean([gain < -LOSS_DB for gain, _ in found])),
        len(found),
    )


def _unit(part: Encoded) -> NDArray[np.float64]:
    scale = 65535.0 if part.dtype == np.uint16 else 1.0
    return np.ascontiguousarray(np.moveaxis(np.asarray(part, dtype=np.float64) / scale, -1, 0))


def _gain(old: float, new: float) -> float:
    return 10.0 * math.log10(max(old, _LEAST_ERROR) / max(new, _LEAST_ERROR))
