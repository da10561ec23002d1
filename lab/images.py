"""How close one picture is to another: as a whole, by zone, block by block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray
from skimage.metrics import structural_similarity

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import Frame
from lensmodel.core.types import ZONES, Planes, Zone
from lensmodel.quality.images import (
    BLOCK,
    CORE,
    block_error,
    block_means,
    blocks,
    moved,
    psnr_of,
    to_srgb,
    zone_masks,
)

Encoded: TypeAlias = NDArray[np.floating] | NDArray[np.uint16]


def psnr(
    image: NDArray[np.floating],
    reference: NDArray[np.floating],
    *,
    mask: NDArray[np.bool_] | None = None,
    srgb: bool = False,
) -> float:
    """Peak signal-to-noise ratio in dB for a peak of 1; infinite for equal pictures."""
    error = _squared_error(image, reference, srgb=srgb)
    if mask is not None:
        if mask.shape != error.shape[-2:] or not mask.any():
            raise InvalidInputError(
                f"the mask must have the picture's size {error.shape[-2:]} and mark a pixel, got {mask.shape}"
            )
        error = error[..., mask]
    mean = float(error.mean())
    return math.inf if mean == 0.0 else -10.0 * math.log10(mean)


def _ssim_map(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """SSIM around each pixel (Z. Wang et al., IEEE TIP 13, 2004; Gaussian of 1.5 px), mean over planes."""
    maps = [
        structural_similarity(  # type: ignore[no-untyped-call]  # scikit-image ships no types
            x, y, data_range=1.0, gaussian_weights=True, use_sample_covariance=False, full=True
        )[1]
        for x, y in zip(a, b, strict=True)
    ]
    return np.asarray(np.mean(maps, axis=0))


def _same_shape(image: NDArray[np.floating], reference: NDArray[np.floating]) -> None:
    if image.shape != reference.shape or image.ndim < 2:
        raise InvalidInputError(f"pictures must have the same shape, got {image.shape} and {reference.shape}")


def _squared_error(
    image: NDArray[np.floating], reference: NDArray[np.floating], *, srgb: bool
) -> NDArray[np.float64]:
    _same_shape(image, reference)
    a = to_srgb(image) if srgb else np.asarray(image, dtype=np.float64)
    b = to_srgb(reference) if srgb else np.asarray(reference, dtype=np.float64)
    return np.square(a - b)


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
) -> dict[str, dict[Zone, float]]:
    """PSNR in dB by zone, each block of 128 pixels at its best shift; of sRGB-encoded pictures SSIM too.

    A blind method leaves the place of the picture free, and the centre of mass of a PSF is not its core: the
    truth of each block, which has no noise, is moved to where it lies best. Blocks are those at `corners`, or
    all over the frame.

    Returns
    -------
    dict
        `psnr` and `ssim`, each by zone; zones of which no block was compared are left out.
    """
    found, wanted = (to_srgb(image), to_srgb(reference)) if srgb else (image, reference)
    means = block_means(
        found,
        wanted,
        frame,
        lambda a, b: [block_error(a, b), *([_ssim_map(a, b)[CORE]] if srgb else [])],
        blocks(frame, EVERY) if corners is None else corners,
    )
    psnrs = {zone: psnr_of(float(mean[0])) for zone, mean in means.items()}
    return {"psnr": psnrs, **({"ssim": {z: float(mean[1]) for z, mean in means.items()}} if srgb else {})}


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
    radius = frame.radius_map()
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
