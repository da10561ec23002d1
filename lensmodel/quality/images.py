"""How close one picture is to another: PSNR by zone, after the best shift of each block."""

from __future__ import annotations

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import CENTER_ZONE_R, CORNER_ZONE_R, Frame
from lensmodel.core.types import ZONES, Zone

_SHIFT_STEPS: Final = 6  # of Newton: it begins within a pixel, and each step gains digits (chosen)
_SHIFT_PAD: Final = 8  # pixels: more than any shift that is looked for
_LARGEST_SHIFT = 3.0  # pixels: larger ones are no shift but another picture (chosen)
_SHIFT_WINDOW: Final = 1024  # pixels: the middle says as much as the whole
_CROP_EDGE: Final = 4  # pixels of the border that demosaicing leaves unsure (chosen)

Picture = NDArray[np.uint8]
"""`(row, col, 3)` sRGB, as shown."""


def to_srgb(linear: NDArray[np.floating]) -> NDArray[np.float64]:
    """Linear light, clipped to 0..1, with the sRGB curve (IEC 61966-2-1): what an eye compares."""
    v = np.clip(np.asarray(linear, dtype=np.float64), 0.0, 1.0)
    return np.where(v <= 0.0031308, 12.92 * v, 1.055 * np.maximum(v, 0.0031308) ** (1.0 / 2.4) - 0.055)


def registered_zone_psnr(
    image: NDArray[np.floating],
    reference: NDArray[np.floating],
    frame: Frame,
    *,
    srgb: bool = False,
    border: int = 8,
    block: int = 128,
) -> dict[Zone, float]:
    """PSNR in dB of each zone after the best shift of every block of the picture is removed.

    A PSF is centred on its centre of mass, and where it has long faint wings on one side that lies
    a pixel or two beside its core. Neither a blind method nor an eye can tell: it is a smooth
    distortion of the picture, not blur. Block by block it is taken out.

    Parameters
    ----------
    image, reference : ndarray, shape (..., H, W)
        Linear light.
    frame : Frame
        (H, W), no side shorter than a block and two borders.
    srgb : bool
        Compare after `to_srgb`, the usual figure for pictures.
    border : int
        Pixels along the frame, and along each block, that do not count.
    block : int
        Side of a block; blocks overlap by two borders, so that all pixels inside count.

    Returns
    -------
    dict of str to float
        dB for a peak of 1, by zone; zones outside the picture are missing.

    Raises
    ------
    InvalidInputError
        If shapes differ, or the picture is too small for a block.
    """
    _same_shape(image, reference)
    if image.shape[-2:] != (frame.height, frame.width):
        raise InvalidInputError(f"the pictures {image.shape} do not have the size of {frame}")
    if min(frame.height, frame.width) < block or block <= 2 * border:
        raise InvalidInputError(f"{frame} is too small for blocks of {block} with a border of {border}")
    radius = frame.radius_map()
    wanted, tested = (to_srgb(reference), to_srgb(image)) if srgb else (reference, image)
    total = dict.fromkeys(ZONES, 0.0)
    count = dict.fromkeys(ZONES, 0)
    core = (..., slice(border, -border), slice(border, -border))
    step = block - 2 * border
    for row in _starts(frame.height, block, step):
        for col in _starts(frame.width, block, step):
            window = (..., slice(row, row + block), slice(col, col + block))
            shift = best_shift(tested[window], wanted[window])
            if max(map(abs, shift)) > _LARGEST_SHIFT:
                shift = (0.0, 0.0)  # nothing in the block says where it lies
            error = np.square(shifted(tested[window], *shift) - wanted[window])[core]
            zones = radius[window][core]
            for zone in ZONES:
                inside = np.broadcast_to(_in_zone(zones, zone), error.shape)
                total[zone] += float(error[inside].sum())
                count[zone] += int(inside.sum())
    return {zone: -10.0 * math.log10(max(total[zone] / count[zone], 1e-30)) for zone in ZONES if count[zone]}


def _starts(length: int, block: int, step: int) -> list[int]:
    return [*range(0, length - block, step), length - block]


def _in_zone(r: NDArray[np.floating], zone: Zone) -> NDArray[np.bool_]:
    if zone == "center":
        return r < CENTER_ZONE_R
    return r > CORNER_ZONE_R if zone == "corner" else (r >= CENTER_ZONE_R) & (r <= CORNER_ZONE_R)


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


def _same_shape(image: NDArray[np.floating], reference: NDArray[np.floating]) -> None:
    if image.shape != reference.shape or image.ndim < 2:
        raise InvalidInputError(f"pictures must have the same shape, got {image.shape} and {reference.shape}")


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
