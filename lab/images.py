"""Pictures as an eye sees them, how close one is to another by zone and block, and how sharp charts are."""

from __future__ import annotations

import logging
import math
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError
from lensmodel.core.types import (
    CENTER_ZONE_R,
    CORNER_ZONE_R,
    ZONES,
    Direction,
    FieldPosition,
    Frame,
    Planes,
    Zone,
    zone_of,
)
from lensmodel.quality import Box, EdgeResponse, slanted_edge

logger = logging.getLogger(__name__)

Encoded: TypeAlias = NDArray[np.floating] | NDArray[np.uint16]

_SHIFT_STEPS: Final = 6  # of Newton: it begins within a pixel, and each step gains digits (chosen)
_SHIFT_PAD: Final = 8  # pixels: more than any shift that is looked for
_LARGEST_SHIFT: Final = 3.0  # pixels (chosen): beyond, nothing in the block says where it lies
_SHIFT_WINDOW: Final = 1024  # pixels: the middle says as much as the whole
_CROP_EDGE: Final = 4  # pixels of the border that demosaicing leaves unsure (chosen)

BLOCK: Final = 128  # pixels of a side (chosen)
BORDER: Final = 8  # pixels of a block that do not count: more than it is shifted
CORE: Final = (..., slice(BORDER, -BORDER), slice(BORDER, -BORDER))

Picture = NDArray[np.uint8]  # `(row, col, 3)` sRGB, as shown


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """Linear light, clipped to 0..1, with the sRGB curve (IEC 61966-2-1): what an eye compares."""
    v = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1.0 / 2.4) - 0.055)


def as_shown(planes: NDArray[np.floating], gain: tuple[float, float, float] = (1.0, 1.0, 1.0)) -> Picture:
    """Encode linear planes `(3, row, col)` to 8-bit sRGB `(row, col, 3)`, each channel times its gain."""
    shown = to_srgb(planes * np.asarray(gain, dtype=np.float32)[:, None, None])
    return np.ascontiguousarray(np.moveaxis(np.rint(shown * 255), 0, -1).astype(np.uint8))


def middle(picture: NDArray[Any], height: int, width: int) -> NDArray[Any]:
    """Cut the middle of planes, at most so large."""
    top, left = (max(n - want, 0) // 2 for n, want in zip(picture.shape[-2:], (height, width), strict=True))
    return np.ascontiguousarray(picture[..., top : top + height, left : left + width])


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


def side_by_side(crops: Sequence[Picture], gap: int = 6) -> Picture:
    """Put pictures of one size beside each other, on white."""
    between = np.full((crops[0].shape[0], gap, 3), 255, dtype=np.uint8)
    return np.concatenate([part for crop in crops for part in (crop, between)][:-1], axis=1)


def strip(picture: Picture, side: int) -> Picture:
    """Put the five crops of `crop_boxes` side by side."""
    side = min(side, picture.shape[0] // 2, picture.shape[1] // 2)
    boxes = crop_boxes(picture.shape[0], picture.shape[1], side).values()
    return side_by_side([picture[row : row + side, col : col + side] for row, col in boxes])


def _same_shape(image: NDArray[np.floating], reference: NDArray[np.floating]) -> None:
    if image.shape != reference.shape or image.ndim < 2:
        raise InvalidInputError(f"pictures must have the same shape, got {image.shape} and {reference.shape}")


def blocks(frame: Frame, most: int | None = None) -> list[tuple[int, int]]:
    """Top left pixels of blocks that cover the frame with their borders; of more than `most` every second."""
    rows, cols = ([*range(0, n - BLOCK, BLOCK - 2 * BORDER), n - BLOCK] for n in (frame.height, frame.width))
    every = [(i + j, row, col) for i, row in enumerate(rows) for j, col in enumerate(cols)]
    thin = most is not None and len(every) > most
    return [(row, col) for number, row, col in every if not (thin and number % 2)]


def psnr_of(error: float) -> float:
    """PSNR in dB of a mean squared error, for a peak of 1."""
    return -10.0 * math.log10(max(error, 1e-30))


def zone_masks(r: NDArray[np.floating]) -> dict[Zone, NDArray[np.bool_]]:
    """Which pixels lie in each zone, by their radii."""
    masks: dict[Zone, NDArray[np.bool_]] = {"center": r < CENTER_ZONE_R, "corner": r > CORNER_ZONE_R}
    return masks | {"mid": ~(masks["center"] | masks["corner"])}


def best_shift(image: NDArray[np.floating], reference: NDArray[np.floating]) -> tuple[float, float]:
    """Shift (row, col) in pixels, up to 3, that brings `image` closest to `reference`, by Gauss-Newton."""
    _same_shape(image, reference)
    window = (_SHIFT_WINDOW, _SHIFT_WINDOW)
    a, b = (middle(np.asarray(picture, dtype=np.float64), *window) for picture in (image, reference))
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


EVERY: Final = 120  # up to so many blocks all are compared, of more every second one, as on a chessboard
LOSS_DB: Final = 0.5  # a block that loses more than this counts
_LEAST_ERROR: Final = 1e-8  # mean square, full scale is 1 (chosen): 80 dB, so that ratios stay finite


def _errors(
    pictures: Sequence[NDArray[np.floating]],
    truth: NDArray[np.floating],
    frame: Frame,
    corners: Sequence[tuple[int, int]],
    *,
    clipped: bool = False,
) -> NDArray[np.float64]:
    """Squared errors of planes, mean over channels, and pixels: `(block, picture, zone, 2)` sums.

    A PSF's centre of mass may lie beside its core: so the truth of each block is moved to where it lies best.
    """
    radius = frame.polar(np.arange(1.0 * frame.height)[:, None], np.arange(1.0 * frame.width)[None, :])[0]

    def sums(corner: tuple[int, int]) -> list[list[tuple[float, int]]]:
        window = tuple(slice(start, start + BLOCK) for start in corner)
        zones, found = zone_masks(radius[window][CORE]), []
        for picture in (whole[:, *window] for whole in pictures):
            sharp = np.asarray(truth[:, *window])
            shift = best_shift(sharp, picture)
            sharp = shifted(sharp, *(shift if max(map(abs, shift)) <= _LARGEST_SHIFT else (0.0, 0.0)))
            if clipped:
                sharp = np.clip(sharp, 0.0, 1.0)
            error = np.square(picture - sharp).mean(axis=0)[CORE]
            found.append([(float(error[zones[zone]].sum()), int(zones[zone].sum())) for zone in ZONES])
        return found

    with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
        # in the order of the blocks: the same sum for any number of threads
        return np.array(list(pool.map(sums, corners)))


def fidelity(
    image: Planes,
    reference: Planes,
    frame: Frame,
    *,
    srgb: bool = True,
    corners: Sequence[tuple[int, int]] | None = None,
) -> dict[Zone, float]:
    """PSNR in dB by zone, each block of 128 pixels at its best shift, as shown or of linear light."""
    _same_shape(image, reference)
    if image.shape[-2:] != (frame.height, frame.width) or min(frame.height, frame.width) < BLOCK:
        raise InvalidInputError(f"{frame} is not that of pictures {image.shape}, or smaller than {BLOCK}")
    pair = (to_srgb(image), to_srgb(reference)) if srgb else (image, reference)
    found, wanted = (picture.reshape(-1, *picture.shape[-2:]) for picture in pair)
    every = blocks(frame, EVERY) if corners is None else corners
    sums = _errors([found], wanted, frame, every)[:, 0].sum(axis=0)
    return {zone: psnr_of(error / count) for zone, (error, count) in zip(ZONES, sums, strict=True) if count}


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
    every = blocks(frame)
    scale = 65535.0 if truth.dtype == np.uint16 else 1.0
    old, new, sharp = (
        np.moveaxis(np.asarray(p, dtype=np.float64), -1, 0) / scale for p in (before, after, truth)
    )
    errors = _errors([old, new], sharp, frame, every, clipped=True)[..., 0]
    of_blocks = [_gain(*pair) for pair in errors.sum(axis=2) / (BLOCK - 2 * BORDER) ** 2]
    worst = int(np.argmin(of_blocks))
    of_zones = zip(ZONES, errors.sum(axis=0).T, strict=True)
    return Gains(
        {zone: _gain(*pair) for zone, pair in of_zones if pair[0] > 0.0},
        of_blocks[worst],
        every[worst],
        float(np.mean([gain < -LOSS_DB for gain in of_blocks])),
        len(every),
    )


def _gain(old: float, new: float) -> float:
    return 10.0 * math.log10(max(old, _LEAST_ERROR) / max(new, _LEAST_ERROR))


class EdgeMeasurement(NamedTuple):
    """One measured edge of a chart."""

    zone: Zone
    direction: Direction  # see `direction_of`
    response: EdgeResponse


@dataclass(frozen=True, slots=True)
class ZoneSharpness:
    """Medians over the edges of one zone."""

    edges: int  # how many were measured
    mtf50: float  # cycles/pixel; NaN where the zone has no edge of that direction
    tangential_mtf50: float
    sagittal_mtf50: float
    mtf_max: float  # largest of the zone: above 1 means oversharpened
    overshoot: float  # largest of the zone, percent of the step


def measure_edges(plane: NDArray[np.floating], boxes: Sequence[Box]) -> tuple[EdgeMeasurement, ...]:
    """Measure the slanted edges of a photo."""
    frame = Frame(*plane.shape)
    measured = []
    for box in boxes:
        row, col, height, width = box
        if row < 0 or col < 0 or row + height > frame.height or col + width > frame.width:
            raise InvalidInputError(f"box {box} leaves the frame of {frame.height} x {frame.width} pixels")
        try:
            response = slanted_edge(plane[row : row + height, col : col + width])
        except NotEnoughEvidenceError as error:
            logger.warning("no edge measured in box %s: %s", box, error)
            continue
        position = frame.position(row + (height - 1) / 2.0, col + (width - 1) / 2.0)
        direction = direction_of(response.normal, position)
        measured.append(EdgeMeasurement(zone_of(position.r), direction, response))
    if not measured:
        raise NotEnoughEvidenceError(f"none of the {len(boxes)} boxes holds a measurable edge")
    return tuple(measured)


def direction_of(normal: float, place: FieldPosition) -> Direction:
    """Say which contrast an edge shows; only within 10 degrees of u or v it is tangential or sagittal."""
    least = math.cos(math.radians(10.0))  # (chosen)
    if abs(math.cos(normal - place.phi)) >= least:
        return "tangential"
    return "sagittal" if abs(math.sin(normal - place.phi)) >= least else "oblique"


def by_zone(measurements: Sequence[EdgeMeasurement]) -> dict[Zone, ZoneSharpness]:
    """Gather measured edges by zone; zones without an edge are missing."""
    table: dict[Zone, ZoneSharpness] = {}
    for zone in ZONES:
        here = [m for m in measurements if m.zone == zone]
        if not here:
            continue
        every, along, across = (
            [m.response.mtf50 for m in here if direction in ("", m.direction)]
            for direction in ("", "tangential", "sagittal")
        )
        mtf50, t, s = (float(np.median(found)) if found else math.nan for found in (every, along, across))
        highest = max(float(m.response.mtf[m.response.frequencies <= 0.5].max()) for m in here)
        table[zone] = ZoneSharpness(len(here), mtf50, t, s, highest, max(m.response.overshoot for m in here))
    return table
