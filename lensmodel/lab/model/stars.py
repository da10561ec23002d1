"""PSFs from a photo of the night sky: each isolated star is a point that the lens has blurred."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import tifffile
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.geometry import Frame
from lensmodel.core.psf import PsfSample, centred, distance
from lensmodel.core.types import Kernel

SIZE = 11  # pixels of the window of a star (chosen)
MOST = 160  # stars at most, the brightest (chosen)
_GROUPS = 5  # to hold out in turn (chosen)
_SIGMAS = 15.0  # of the sky's noise, that the peak of a usable star has
_SATURATED = 0.9  # of the brightest value: peaks above may be cut (chosen)
_NEIGHBOUR = 0.25  # of its peak, that another source beside a star may have
_FEWEST = 20  # stars: four a group (chosen)
_REDRAWN = 8  # draws of the noise of a star (chosen)
_HOT = 0.06  # of its peak: a pixel whose neighbours hold less in the mean is hot, no lens is so sharp


def stars_of(path: Path) -> list[PsfSample]:
    """Find isolated, unsaturated stars in a TIFF and return them as samples, in five groups to hold out.

    Raises
    ------
    InvalidInputError
        If the file is no picture, or shows too few stars.
    """
    try:
        picture = np.asarray(tifffile.imread(path), dtype=np.float64)
    except (OSError, ValueError, tifffile.TiffFileError) as error:
        raise InvalidInputError(f"{path.name} is no TIFF picture of stars") from error
    plane = picture[..., :3].mean(axis=-1) if picture.ndim == 3 and picture.shape[-1] in {3, 4} else picture
    if plane.ndim != 2 or min(plane.shape) < 4 * SIZE:
        raise InvalidInputError(f"{path.name} has shape {picture.shape}; give one picture of a star field")
    samples = stars_in(plane)
    if len(samples) < _FEWEST:
        raise InvalidInputError(f"{path.name} shows {len(samples)} usable stars; {_FEWEST} are needed")
    return samples


def stars_in(plane: NDArray[np.float64]) -> list[PsfSample]:
    """Find isolated, unsaturated stars in a picture, brightest first, in five groups to hold out.

    `error` of each sample is what the noise of the sky makes of it: as much again changes it by that.
    """
    plane = (
        plane
        - ndimage.median_filter(plane[::4, ::4], 15)
        .repeat(4, 0)
        .repeat(4, 1)[: plane.shape[0], : plane.shape[1]]
    )
    noise = 1.4826 * float(np.median(np.abs(plane - np.median(plane)))) + 1e-12
    found = _isolated(plane, noise)
    frame, half, samples = Frame(*plane.shape), SIZE // 2, []
    rng = np.random.default_rng(0)
    for number, (row, col) in enumerate(found):
        window = plane[row - half : row + half + 1, col - half : col + half + 1]
        kernel = _kernel(window, noise)
        again = [_kernel(window + rng.normal(0.0, noise, window.shape), noise) for _ in range(_REDRAWN)]
        samples.append(
            PsfSample(
                kernel,
                frame.position(row, col),
                photo=f"group{number % _GROUPS}",
                error=float(np.mean([distance(other, kernel).rel_l2 for other in again])),
            )
        )
    return samples


def _kernel(window: NDArray[np.float64], noise: float) -> Kernel:
    return centred(np.maximum(window - 1.5 * noise, 0.0) * _round(SIZE))


def _isolated(plane: NDArray[np.float64], noise: float) -> list[tuple[int, int]]:
    """Peaks that are bright, not clipped and alone, brightest first."""
    half = SIZE // 2
    smooth = ndimage.gaussian_filter(plane, 1.0)
    peaks = (smooth == ndimage.maximum_filter(smooth, SIZE)) & (plane > _SIGMAS * noise)
    peaks &= plane < _SATURATED * plane.max()
    rows, cols = np.nonzero(peaks)
    order = np.argsort(-plane[rows, cols], kind="stable")
    found: list[tuple[int, int]] = []
    ring = ~_round(SIZE, math.inf, 0.5)
    for row, col in zip(rows[order].tolist(), cols[order].tolist(), strict=True):
        inside = half <= row < plane.shape[0] - half and half <= col < plane.shape[1] - half
        if not inside or len(found) == MOST:
            continue
        around = (plane[row - 1 : row + 2, col - 1 : col + 2].sum() - plane[row, col]) / 8.0
        if around < _HOT * plane[row, col]:
            continue
        window = smooth[row - half : row + half + 1, col - half : col + half + 1]
        if window[ring].max() < _NEIGHBOUR * window.max():
            found.append((row, col))
    return found


def _round(size: int, outer: float = 1.0, inner: float = 1.0) -> NDArray[np.bool_]:
    """Pixels within a part of the half side from the middle."""
    t = np.arange(size) - size // 2
    reach = size / 2.0 * min(outer, inner)
    return np.asarray(t[:, None] ** 2 + t[None, :] ** 2 <= reach**2)
