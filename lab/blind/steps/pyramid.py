"""Coarse to fine: the driver that the classic blind methods share.

A wide kernel is a small one on a small copy of the patch, where few pixels decide. A method brings its
alternation on one level. Everything here commutes with turns by 90 degrees and mirroring.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, TypeAlias

import numpy as np
from numpy.typing import NDArray

from lensmodel.blind.estimator import usable
from lensmodel.core.psf import as_kernel, delta, resized
from lensmodel.core.types import Kernel, NoiseModel, Plane

Image: TypeAlias = NDArray[np.float64]

RATIO: Final = math.sqrt(0.5)  # size of a level over that of the next finer one, as in public codes
_COARSEST: Final = 5  # pixels: kernels of the coarsest level are not smaller than this (chosen)
_SMALLEST_IMAGE: Final = 24  # shorter side of the coarsest level in pixels (chosen)
_REACH: Final = 2  # of the cubic, in pixels of the coarser grid


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One patch on one level."""

    y: Image  # (H, W), observed, zero mean, its 1 to 99 percent range scaled to 1
    noise: float  # standard deviation of the noise of y, same units

    @classmethod
    def of(cls, patch: Plane, model: NoiseModel) -> View:
        """Scale a patch; an affine change of its values changes nothing."""
        values = patch.astype(np.float64)
        low, high = np.quantile(values, (0.01, 0.99))
        span = max(float(high - low), 1e-9)
        mean = float(values.mean())
        return cls((values - mean) / span, model.sigma_at(mean) / span)

    @classmethod
    def of_one(cls, patches: Sequence[Plane], noise: Sequence[NoiseModel], size: int) -> View:
        """Check and scale the one patch that these methods take."""
        ((patch, model),) = usable(patches, noise, size)
        return cls.of(patch, model)

    def at(self, shape: tuple[int, ...]) -> View:
        """Return the same patch on another grid; averaging makes its noise smaller."""
        if shape == self.y.shape:
            return self
        return View(resample(self.y, shape), self.noise * noise_gain(self.y.shape, shape))


@dataclass(frozen=True, slots=True, eq=False)
class Level:
    """One level of the pyramid."""

    number: int  # 0 is the finest
    count: int  # how many levels there are
    side: int  # odd side of the kernel on this level
    view: View


# what a method does on one level, from the kernel `(side, side)` and the latent image of the coarser one
LevelSolver: TypeAlias = Callable[[Level, Kernel, Image], tuple[Kernel, Image]]


def kernel_sides(side: int, image_side: int) -> tuple[int, ...]:
    """Kernel sides by level, finest first; no level's image gets smaller than 24 px."""
    found = [side]
    while True:
        factor = RATIO ** len(found)
        smaller = odd(side * factor)
        if smaller < min(side, _COARSEST) or image_side * factor < max(_SMALLEST_IMAGE, 3 * smaller):
            return tuple(found)
        found.append(smaller)


def coarse_to_fine(view: View, solve: LevelSolver, side: int, *, start: Kernel | None = None) -> Kernel:
    """Run a method on every level, coarsest first, up to a kernel of odd `side`; from a point by default."""
    sides = kernel_sides(side, min(view.y.shape))
    last = len(sides) - 1
    for number in reversed(range(len(sides))):
        small = view.at(level_shape(view.y.shape, RATIO**number))
        if number == last:
            latent = small.y
            kernel = delta(sides[-1]) if start is None else rescaled(start, RATIO**last, sides[-1])
        else:
            latent = resample(latent, small.y.shape)
            kernel = rescaled(kernel, 1.0 / RATIO, sides[number])
        kernel, latent = solve(Level(number, len(sides), sides[number], small), kernel, latent)
        kernel = resized(kernel, sides[number])
    return kernel


def odd(value: float) -> int:
    """Nearest odd integer, at least 1."""
    return max(2 * round((value - 1.0) / 2.0) + 1, 1)


def level_shape(shape: tuple[int, ...], factor: float) -> tuple[int, int]:
    """Shape of an image scaled by `factor`."""
    return max(round(shape[0] * factor), 1), max(round(shape[1] * factor), 1)


def resample(image: Image, shape: tuple[int, ...]) -> Image:
    """Resize by the cubic of R. Keys (IEEE TASSP 29, 1981), stretched when the image shrinks.

    The extent is kept: pixel i of n lies at (i + 1/2) / n. Beyond the border the image is mirrored.
    """
    if image.shape == shape:
        return image
    rows, cols = _weights(image.shape[0], shape[0]), _weights(image.shape[1], shape[1])
    return np.asarray(rows @ image @ cols.T)


def noise_gain(shape: tuple[int, ...], target: tuple[int, ...]) -> float:
    """Root mean square by which `resample` scales the standard deviation of white noise."""
    powers = [
        float(np.square(_weights(have, want)).sum(axis=1).mean())
        for have, want in zip(shape, target, strict=True)
    ]
    return math.sqrt(powers[0] * powers[1])


def rescaled(kernel: Kernel, factor: float, side: int) -> Kernel:
    """Kernel of the same blur on a grid finer by `factor`, cut or padded to the odd `side`."""
    if factor == 1.0:
        return resized(kernel, side)
    have = kernel.shape[0]
    step = 1.0 / factor
    places = (np.arange(side) - side // 2) * step + have // 2
    stretch = max(step, 1.0)
    weight = _cubic((places[:, None] - np.arange(have)[None, :]) / stretch)
    weight /= stretch * factor  # so that the sum is kept, up to what the cut takes
    scaled = np.maximum(weight @ kernel @ weight.T, 0.0)
    return as_kernel(scaled) if scaled.sum() > 0 else delta(side)


@lru_cache(maxsize=64)
def _weights(have: int, want: int) -> Image:
    """Matrix `(want, have)` of `resample` along one axis; rows sum to 1."""
    ratio = have / want
    stretch = max(ratio, 1.0)
    places = (np.arange(want) + 0.5) * ratio - 0.5
    reach = math.ceil(_REACH * stretch)
    columns = np.floor(places).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
    values = _cubic((places[:, None] - columns) / stretch)
    values /= values.sum(axis=1, keepdims=True)
    folded = np.mod(columns, 2 * have)
    folded = np.where(folded < have, folded, 2 * have - 1 - folded)
    weights = np.zeros((want, have))
    np.add.at(weights, (np.arange(want)[:, None], folded), values)
    weights.setflags(write=False)
    return weights


def _cubic(t: Image) -> Image:
    """Keys' cubic with a = -1/2, zero beyond 2."""
    t = np.abs(t)
    near = (1.5 * t - 2.5) * t * t + 1.0
    far = ((-0.5 * t + 2.5) * t - 4.0) * t + 2.0
    return np.where(t <= 1.0, near, np.where(t < 2.0, far, 0.0))
