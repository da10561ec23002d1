"""Solving for the PSF of one window of a photo, wherever the latent picture comes from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import centred
from lensmodel.core.types import CHANNELS, Channel, Kernel
from lensmodel.estimation.measure.solve import Solved, solve
from lensmodel.estimation.measure.varying import solve_varying
from lensmodel.photo import LinearPhoto

Latent = Callable[[tuple[float, float], int], NDArray[np.floating]]
"""`latent(shift, margin)`: the sharp picture of a window, moved down and right by `shift` pixels."""

SMALL: Final = 15
"""Side of the kernel by which the middle is found: its wings hardly move it."""

NEAR_CLIP: Final = 0.97
"""Share of the clipping level above which a pixel is not believed: the sensor bends before it clips."""

_MOST_SHIFT: Final = 3.0  # pixels; beyond, the small kernel is cut off


def photo_noise(photo: LinearPhoto, channel: Channel) -> tuple[float, float]:
    """Shot and read noise of the pixels that were measured."""
    noise = (photo.sensor_noise or photo.noise)[CHANNELS.index(channel)]
    return noise.shot, noise.read


def measured_pixels(
    photo: LinearPhoto, channel: Channel, row: int, col: int, shape: tuple[int, int]
) -> NDArray[np.bool_]:
    """Which pixels of a window the sensor measured in a channel, unclipped."""
    index = CHANNELS.index(channel)
    window = photo.planes[index, row : row + shape[0], col : col + shape[1]]
    good = np.asarray(window < NEAR_CLIP * photo.clip[index])
    if photo.cfa is not None:
        rows = (row + np.arange(shape[0])) % 2
        cols = (col + np.arange(shape[1])) % 2
        good &= np.asarray(photo.cfa)[rows[:, None], cols[None, :]] == index
    return good


def window_psf(
    photo: LinearPhoto,
    channel: Channel,
    corner: tuple[int, int],
    shape: tuple[int, int],
    latent: Latent,
    size: int,
    *,
    measured: NDArray[np.bool_] | None = None,
    latent_noise: NDArray[np.floating] | None = None,
) -> tuple[Kernel, Solved, tuple[float, float]]:
    """Measure the PSF of one window.

    First a small kernel, whose centre of mass says how far the photo lies beyond the latent picture; that
    is moved, and solved again, so that the kernel comes out nearly centred and needs no interpolation, which
    would soften a peak as narrow as a pixel.

    Returns
    -------
    kernel : Kernel, shape (size, size)
        Its centre of mass lies within parts of a pixel of the middle.
    solved : Solved
        As it was found.
    shift : tuple of float
        How far the latent picture was moved, (row, col) pixels.

    Raises
    ------
    NotEnoughEvidenceError
        If too few pixels count, or the latent picture does not match.
    """
    row, col = corner
    height, width = shape
    index = CHANNELS.index(channel)
    observed = np.asarray(photo.planes[index, row : row + height, col : col + width], dtype=np.float64)
    if measured is None:
        measured = measured_pixels(photo, channel, row, col, shape)
    variance = even_variance(photo, channel, observed, measured)
    _, shift = roughly(observed, measured, variance, latent, min(SMALL, size))
    sharp = latent(shift, size // 2)
    if latent_noise is None:
        solved = solve_varying(observed, sharp, measured, variance, size)
        return solved.kernel, solved, shift
    # less its noise a latent picture says too little of how the kernel changes, and of the best grid
    solved = solve(observed, sharp, measured, variance, size, latent_noise)
    return centred(solved.kernel), solved, shift


def roughly(
    observed: NDArray[np.float64],
    measured: NDArray[np.bool_],
    variance: NDArray[np.float64],
    latent: Latent,
    size: int = SMALL,
) -> tuple[Solved, tuple[float, float]]:
    """Find a small kernel of a window.

    Parameters
    ----------
    observed, measured, variance : ndarray, shape (H, W)
        As in `solve`.
    latent : Latent
    size : int
        Side of the kernel.

    Returns
    -------
    solved : Solved
    shift : tuple of float
        How far to move the latent picture, (row, col) pixels, so that the kernel is centred.

    Raises
    ------
    NotEnoughEvidenceError
        If too few pixels count, or the latent picture does not match.
    """
    shift = (0.0, 0.0)
    for _ in range(2):
        first = solve(observed, latent(shift, size // 2), measured, variance, size)
        shift = shift[0] + first.shift[0], shift[1] + first.shift[1]
        if max(map(abs, shift)) > _MOST_SHIFT:
            raise NotEnoughEvidenceError("the window lies elsewhere than the rest of the reference says")
        if max(map(abs, first.shift)) < 0.02:
            break
    return first, shift


def even_variance(
    photo: LinearPhoto, channel: Channel, observed: NDArray[np.float64], measured: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Return the variance of a window's noise, its mean for each pixel, in the photo's units squared.

    By its own level a pixel that is dark by chance would count more than others.
    """
    shot, read = photo_noise(photo, channel)
    variance = shot * np.maximum(observed, 0.0) + read
    return np.full(observed.shape, float(variance[measured].mean()) if measured.any() else 1.0)


def window_corners(
    shape: tuple[int, int], side: int, across: int, down: int, margin: int
) -> list[tuple[int, int]]:
    """Top left corners of windows spread evenly over a frame, `margin` pixels away from its rim."""
    last = shape[0] - side - margin, shape[1] - side - margin
    if min(last) < margin:
        return []
    rows = np.unique(np.rint(np.linspace(margin, last[0], down)).astype(int))
    cols = np.unique(np.rint(np.linspace(margin, last[1], across)).astype(int))
    return [(int(row), int(col)) for row in rows for col in cols]
