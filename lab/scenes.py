"""Made scenes: dead leaves, and two depths of which one is out of focus."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Planes


def dead_leaves(
    height: int,
    width: int,
    rng: np.random.Generator,
    *,
    smallest: float = 1.5,
    largest: float = 150.0,
    oversampling: int = 3,
) -> Planes:
    """Discs that cover one another, radii with density ~ r^-3: natural statistics, sharp edges.

    Area-sampled: drawn `oversampling` times larger, then averaged over the pixels.

    Parameters
    ----------
    height, width : int
        Size in pixels.
    rng : numpy.random.Generator
        Places, sizes and colours.
    smallest, largest : float
        Radii in pixels.
    oversampling : int
        Samples a pixel and axis.

    Returns
    -------
    Planes, shape (3, height, width), values 0.02..0.95

    References
    ----------
    .. [1] A. B. Lee, D. Mumford, J. Huang, "Occlusion models for natural images", International
       Journal of Computer Vision 41, 2001.
    """
    if not 0.0 < smallest < largest or oversampling < 1:
        raise InvalidInputError(f"radii must satisfy 0 < smallest < largest, got {smallest}, {largest}")
    size = (height * oversampling, width * oversampling)
    canvas = np.zeros((*size, 3), dtype=np.float32)
    empty = np.ones(size, dtype=bool)
    # painted from the front: a leaf shows where nothing lies yet
    for _ in range(200_000):
        if not empty.any():
            break
        radius = _leaf_radius(rng, smallest, largest) * oversampling
        row, col = rng.uniform(-radius, size[0] + radius), rng.uniform(-radius, size[1] + radius)
        colour = _leaf_colour(rng)
        top, left = max(int(row - radius), 0), max(int(col - radius), 0)
        bottom, right = min(int(row + radius) + 2, size[0]), min(int(col + radius) + 2, size[1])
        if bottom <= top or right <= left:
            continue
        free = empty[top:bottom, left:right]
        if not free.any():
            continue
        dr, dc = np.arange(top, bottom)[:, None] - row, np.arange(left, right)[None, :] - col
        leaf = free & (dr * dr + dc * dc <= radius * radius)
        canvas[top:bottom, left:right][leaf] = colour
        free[leaf] = False
    canvas[empty] = _leaf_colour(rng)
    cells = canvas.reshape(height, oversampling, width, oversampling, 3)
    return np.ascontiguousarray(cells.mean(axis=(1, 3)).transpose(2, 0, 1))


def _leaf_radius(rng: np.random.Generator, smallest: float, largest: float) -> float:
    """Draw from a density ~ r^-3 between the limits, by inversion of its distribution."""
    u = rng.random()
    return float((smallest**-2 - u * (smallest**-2 - largest**-2)) ** -0.5)


def _leaf_colour(rng: np.random.Generator) -> NDArray[np.float32]:
    grey = rng.uniform(0.05, 0.9)
    return np.clip(grey * rng.uniform(0.75, 1.25, 3), 0.02, 0.95).astype(np.float32)


def disc_kernel(radius: float) -> NDArray[np.float64]:
    """Disc of sum 1, area-sampled 9 times a pixel and axis: blur of a point out of focus."""
    if not 0.0 < radius <= 100.0:
        raise InvalidInputError(f"disc radius must lie in 0..100 px, got {radius}")
    half, fine = int(np.ceil(radius + 0.5)), 9
    t = (np.arange((2 * half + 1) * fine) + 0.5) / fine - half - 0.5
    inside = (t[:, None] ** 2 + t[None, :] ** 2 <= radius**2).astype(np.float64)
    side = 2 * half + 1
    disc = inside.reshape(side, fine, side, fine).sum(axis=(1, 3))
    return disc / disc.sum()


def out_of_focus(scene: Planes, radius: float, near: NDArray[np.bool_]) -> Planes:
    """Two depths: the part `near` of a scene blurred by a disc, composed over the sharp rest.

    Parameters
    ----------
    scene : Planes, shape (3, H, W)
    radius : float
        Radius of the disc in pixels.
    near : ndarray of bool, shape (H, W)
        Where the defocused object is. It lies in front, so its blurred outline covers the rest.

    Returns
    -------
    Planes, shape (3, H, W)
    """
    if near.shape != scene.shape[1:]:
        raise InvalidInputError(f"the mask {near.shape} must have the scene's size {scene.shape[1:]}")
    disc = disc_kernel(radius)
    matte = _blurred(near.astype(np.float32), disc)
    planes = [(1.0 - matte) * plane + _blurred(plane * near, disc) for plane in scene]
    return np.ascontiguousarray(np.stack(planes), dtype=np.float32)


def _blurred(plane: NDArray[np.float32], kernel: NDArray[np.float64]) -> NDArray[np.float32]:
    half = kernel.shape[0] // 2
    padded = np.pad(plane, half, mode="symmetric")
    grid = [int(fft.next_fast_len(n + 2 * half, real=True)) for n in padded.shape]
    product = fft.rfft2(padded, s=grid) * fft.rfft2(kernel.astype(np.float32), s=grid)
    full = fft.irfft2(product, s=grid)
    valid = full[2 * half : 2 * half + plane.shape[0], 2 * half : 2 * half + plane.shape[1]]
    return np.clip(valid, 0.0, None).astype(np.float32)
