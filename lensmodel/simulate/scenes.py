"""Scenes for the simulated camera: photographs, dead leaves, point lights, two depths.

Every scene is `Planes` in white-balanced linear light. Charts are in `charts`.
"""

from __future__ import annotations

from importlib import resources
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError
from scipy import fft

from lensmodel.core.errors import InvalidInputError, NotAnImageError
from lensmodel.core.types import Planes

DEMO_SCENES: Final = ("city", "colosseum", "lake", "spices", "tea-gardens")
"""Names of the photographs that come with the library, see lensmodel/demo_data/README.md."""


def srgb_to_linear(values: NDArray[np.floating]) -> NDArray[np.float32]:
    """Undo the sRGB curve (IEC 61966-2-1) on values in 0..1."""
    v = np.asarray(values, dtype=np.float32)
    high = ((np.maximum(v, 0.04045) + np.float32(0.055)) / np.float32(1.055)) ** np.float32(2.4)
    return np.where(v <= 0.04045, v / np.float32(12.92), high).astype(np.float32)


def load_scene(path: str | Path) -> Planes:
    """Load an sRGB photograph (PNG, JPEG, TIFF of 8 bits) as linear light.

    Returns
    -------
    Planes, shape (3, H, W), values 0..1

    Raises
    ------
    NotAnImageError
        If the file is no such image.
    """
    try:
        with Image.open(path) as image:
            coded = np.asarray(image.convert("RGB"), dtype=np.uint8)
    except UnidentifiedImageError as error:
        raise NotAnImageError(f"{Path(path).name} is no image that can serve as a scene") from error
    table = srgb_to_linear(np.arange(256) / 255.0)
    return np.ascontiguousarray(table[coded].transpose(2, 0, 1))


def demo_data_path(name: str) -> Path:
    """Path of a file of `lensmodel/demo_data`; see its README for origin and licences.

    Raises
    ------
    InvalidInputError
        If there is no such file; the text lists those that exist. Packages that are installed from a wheel
        have none of them: they come with the source tree.
    """
    folder = resources.files("lensmodel") / "demo_data"
    known = sorted(entry.name for entry in folder.iterdir()) if folder.is_dir() else []
    if not set(known) - {"README.md"}:
        raise InvalidInputError(
            f"the demo photograph {name!r} is not part of an installed package; get the source tree and run "
            "`make demo` there"
        )
    if name not in known:
        raise InvalidInputError(f"no demo file {name!r}; known: {', '.join(known)}")
    return Path(str(folder / name))


def demo_scene(name: str) -> Planes:
    """Photograph of `DEMO_SCENES` as linear light, `(3, H, W)`.

    Raises
    ------
    InvalidInputError
        If there is no photograph of that name.
    """
    if name not in DEMO_SCENES:
        raise InvalidInputError(f"no demo scene {name!r}; known: {', '.join(DEMO_SCENES)}")
    return load_scene(demo_data_path(f"{name}.jpg"))


def constant(height: int, width: int, level: float = 0.5) -> Planes:
    """Flat grey scene."""
    return np.full((3, height, width), level, dtype=np.float32)


def point_lights(
    height: int, width: int, spacing: int, level: float = 1.0
) -> tuple[Planes, NDArray[np.intp]]:
    """Single bright pixels on a square grid over a black scene.

    Returns
    -------
    scene : Planes, shape (3, height, width)
    places : ndarray, shape (n, 2)
        Row and column of every light.
    """
    if spacing < 1:
        raise InvalidInputError(f"spacing must be at least one pixel, got {spacing}")
    rows = np.arange(spacing // 2, height, spacing)
    cols = np.arange(spacing // 2, width, spacing)
    places = np.stack(np.meshgrid(rows, cols, indexing="ij"), axis=-1).reshape(-1, 2)
    scene = np.zeros((3, height, width), dtype=np.float32)
    scene[:, places[:, 0], places[:, 1]] = level
    return scene, places


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
