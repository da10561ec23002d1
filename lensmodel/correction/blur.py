"""The blur of a photo, and the periodic canvas on which Fourier methods undo it.

Also what compiled loops share: types, constants, transforms on given buffers, and small filters.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, Final, TypeAlias

import numpy as np
import rocket_fft
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.psf import as_kernel, support_radius
from lensmodel.core.types import Kernel, Plane, Planes

Mask = NDArray[np.bool_]
Real = NDArray[np.float32]
Complex = NDArray[np.complex64]
Window = tuple[slice, slice]  # rows and columns
Number: TypeAlias = Any
"""A number of single precision, which is no `float` to a type checker."""

# In single precision, so that no sum is made in double.
ONE: Final = np.float32(1.0)
ZERO: Final = np.float32(0.0)
FORWARD: Final = True
BACK: Final = False


@jit
def to_spectrum(plane: Real, spectrum: Complex) -> None:
    """Real transform of a plane, rows first: one call for both axes allocates memory on the way back."""
    rocket_fft.r2c(plane, spectrum, np.array([1]), FORWARD, 1.0, 1)
    rocket_fft.c2c(spectrum, spectrum, np.array([0]), FORWARD, 1.0, 1)


@jit
def to_plane(spectrum: Complex, plane: Real) -> None:
    """Inverse real transform, divided by the number of pixels; `spectrum` is overwritten."""
    rocket_fft.c2c(spectrum, spectrum, np.array([0]), BACK, 1.0, 1)
    rocket_fft.c2r(spectrum, plane, np.array([1]), BACK, 1.0 / plane.size, 1)


@jit
def through(
    work: Real, P: Complex, K: Complex, forward: bool, first: int, last: int, begin: int, end: int
) -> None:
    """Blur a plane on its canvas, or what is adjoint to that, in place.

    Light is in rows `first` to `last` only, and only rows `begin` to `end` are computed; the others hold
    anything. Rows that are empty or not needed are left out of the transforms along rows.
    """
    height, half = K.shape
    down, across = np.array([0]), np.array([1])
    norm = ONE / np.float32(height * work.shape[1])
    P[:first] = 0
    P[last:] = 0
    rocket_fft.r2c(work[first:last], P[first:last], across, FORWARD, 1.0, 1)
    rocket_fft.c2c(P, P, down, FORWARD, 1.0, 1)
    if forward:
        for i in range(height):
            for j in range(half):
                P[i, j] = P[i, j] * (K[i, j] * norm)
    else:
        for i in range(height):
            for j in range(half):
                P[i, j] = P[i, j] * (np.conj(K[i, j]) * norm)
    rocket_fft.c2c(P, P, down, BACK, 1.0, 1)
    rocket_fft.c2r(P[begin:end], work[begin:end], across, BACK, 1.0, 1)


@jit
def transfer(taps: Real, out: Complex, width: int) -> None:
    """Spectrum of a small kernel around the first pixel: only its own rows go through the row transform."""
    side = taps.shape[0]
    height, half = out.shape
    lines = np.zeros((side, width), np.float32)
    spectra = np.empty((side, half), np.complex64)
    for i in range(side):
        for j in range(side):
            lines[i, (j - side // 2) % width] = taps[i, j]
    rocket_fft.r2c(lines, spectra, np.array([1]), FORWARD, 1.0, 1)
    out[:] = 0
    for i in range(side):
        out[(i - side // 2) % height] = spectra[i]
    rocket_fft.c2c(out, out, np.array([0]), FORWARD, 1.0, 1)


@jit
def smooth(plane: Real, weights: Real, wrapped: bool = False) -> Real:
    """Filter a plane with odd `weights` along rows and columns; it continues periodically, or with zeros."""
    rows, cols = plane.shape
    half = weights.size // 2
    out = np.zeros((rows, cols), np.float32)
    line = np.empty(cols + 2 * half, np.float32)
    middle = line[half : half + cols]
    for i in range(rows):
        line[:] = ZERO
        for k in range(-half, half + 1):
            row = (i + k) % rows if wrapped else i + k
            if 0 <= row < rows:
                weight = weights[k + half]
                for j in range(cols):
                    middle[j] += weight * plane[row, j]
        if wrapped:
            for j in range(half):
                line[j] = line[(j - half) % cols + half]
                line[half + cols + j] = line[j % cols + half]
        for k in range(2 * half + 1):
            weight = weights[k]
            for j in range(cols):
                out[i, j] += weight * line[j + k]
    return out


@dataclass(frozen=True, slots=True, eq=False)
class Drift:
    """Linear change of a kernel over a tile, h(. ; q) = k + (q_row - row) k_down + (q_col - col) k_across.

    A point at q of the sharp plane is spread by h(. ; q), so that k_down and k_across act on the
    latent plane times its distance from the origin.
    """

    # two blurs before and after, and the pixels between the places they were taken at
    down: tuple[UniformBlur, UniformBlur, float]
    across: tuple[UniformBlur, UniformBlur, float]
    origin: tuple[float, float]  # pixel of the tile where the kernel is k


@dataclass(frozen=True, eq=False)
class UniformBlur:
    """Blur by one kernel, y = k * x, no wrapping.

    The latent plane is larger than the frame by the kernel's half side on each side.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
        The impulse response.
    offset : tuple of float
        Shift `(row, col)` in pixels of the image of a point, on top of the kernel: lateral colour.
    drift : Drift or None
        How the kernel changes around its place: the operator is uniform, a method may model the rest.
    """

    kernel: Kernel
    offset: tuple[float, float] = (0.0, 0.0)
    drift: Drift | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "kernel", as_kernel(self.kernel))

    @cached_property
    def taps(self) -> Real:
        """The kernel at its offset, `(2 reach + 1, 2 reach + 1)`."""
        if self.offset == (0.0, 0.0):
            return self.kernel.astype(np.float32)
        rows, cols = (_moved(self.kernel.shape[0], shift, self.reach) for shift in self.offset)
        return np.asarray(rows @ self.kernel @ cols.T, dtype=np.float32)

    @cached_property
    def _spectra(self) -> dict[tuple[int, int], Complex]:
        return {}

    @cached_property
    def reach(self) -> int:
        """Pixels by which the latent plane is wider than the frame on each side."""
        beyond = max(abs(self.offset[0]), abs(self.offset[1]))
        return int(self.kernel.shape[0] // 2) + math.ceil(beyond) + (beyond != math.floor(beyond))

    @property
    def spread(self) -> int:
        """Radius in pixels that holds 98 percent of the kernel's light and its shift, and a pixel more."""
        return max(support_radius(self.kernel, 0.98), 1) + math.ceil(max(map(abs, self.offset))) + 1

    def spectrum(self, shape: tuple[int, int]) -> Complex:
        """Transfer function on the `rfft2` grid of `shape`, which is no smaller than the kernel; cached."""
        if shape not in self._spectra:
            K = np.empty((shape[0], shape[1] // 2 + 1), dtype=np.complex64)
            transfer(self.taps, K, shape[1])
            self._spectra[shape] = K
        return self._spectra[shape]

    def forward(self, latent: Plane) -> Plane:
        """K * x where every pixel of the kernel meets data: `(h + 2 reach, ...)` to `(h, ...)`, float32."""
        cut, (height, width) = self.reach, latent.shape
        if min(latent.shape) <= 2 * cut:
            raise InvalidInputError(
                f"a latent plane of {latent.shape} leaves no frame inside a kernel that reaches {cut}"
            )
        return self._applied(latent, (height, width), FORWARD, 0, cut)

    def adjoint(self, blurred: Plane) -> Plane:
        """Correlation of y with k on the latent plane: `(h, ...)` to `(h + 2 reach, ...)`, float32."""
        cut, (height, width) = self.reach, blurred.shape
        return self._applied(blurred, (height + 2 * cut, width + 2 * cut), BACK, cut, 0)

    def _applied(self, plane: Plane, shape: tuple[int, int], forward: bool, margin: int, cut: int) -> Plane:
        """Blur a plane within a latent one of this shape, or do what is adjoint to that; cut the rim off."""
        K, (height, width) = self.spectrum(fast_shape(shape)), shape
        work = np.zeros(fast_shape(shape), dtype=np.float32)
        work[margin : height - margin, margin : width - margin] = plane
        through(work, np.empty_like(K), K, forward, margin, height - margin, cut, height - cut)
        return np.ascontiguousarray(work[cut : height - cut, cut : width - cut])

    def frame(self, latent: Plane) -> Plane:
        """Return the part of the latent plane that the photo shows."""
        cut = self.reach
        return latent[cut : latent.shape[0] - cut, cut : latent.shape[1] - cut]


def _moved(side: int, shift: float, reach: int) -> NDArray[np.float64]:
    """Matrix that moves samples by `shift`, onto 2 reach + 1 of the same middle, by Keys' cubic convolution.

    R. G. Keys, IEEE Trans. ASSP 29, 1981. A phase alone would be a sinc, whose tails cross the picture: where
    the kernel is next to a point, undoing them drew nets of dots around every edge.
    """
    distance = np.arange(-reach, reach + 1)[:, None] - shift - (np.arange(side) - side // 2)
    x = np.abs(distance)
    near, far = (1.5 * x - 2.5) * x * x + 1.0, ((2.5 - 0.5 * x) * x - 4.0) * x + 2.0
    return np.where(x < 1.0, near, np.where(x < 2.0, far, 0.0))


def fast_shape(shape: tuple[int, ...]) -> tuple[int, int]:
    """Return the smallest size not below `shape` that transforms quickly."""
    return int(fft.next_fast_len(shape[0], real=True)), int(fft.next_fast_len(shape[1], real=True))


def transfers(blurs: Sequence[UniformBlur], shape: tuple[int, int], reach: float) -> tuple[Complex, Complex]:
    """Return K, `(channel, rows, cols)`, and its change per pixel, `(channel, 2, rows, cols)`, or none.

    A solver inverts K alone and takes the change as data. That converges only where the change is smaller
    than K, so it is limited to half of K at `reach` pixels from the middle.
    """
    K = np.stack([blur.spectrum(shape) for blur in blurs])
    drifts = [blur.drift for blur in blurs if blur.drift is not None]
    rates = np.empty((len(drifts), 2, *K.shape[1:]), dtype=np.complex64)
    for spectrum, rate, drift in zip(K, rates, drifts, strict=bool(drifts)):
        for out, (before, after, pixels) in zip(rate, (drift.down, drift.across), strict=True):
            wide = max(before.reach, after.reach)
            taps = np.zeros((2 * wide + 1, 2 * wide + 1), dtype=np.float32)
            for blur, factor in ((before, -1.0), (after, 1.0)):
                inside = slice(wide - blur.reach, wide + blur.reach + 1)
                taps[inside, inside] += np.float32(factor / max(pixels, 1.0)) * blur.taps
            transfer(taps, out, shape[1])
        change = np.float32(reach) * np.abs(rate).sum(axis=0)
        most = np.float32(0.5) * np.abs(spectrum)
        np.multiply(rate, np.minimum(most / np.maximum(change, np.float32(1e-9)), ONE), out=rate)
    return K, rates


BLOCK: Final = 4  # pixels of a coarse plane's block: coarser than detail, finer than objects (chosen)

_JOINT: Final = 4
"""Pixels over which the ends of a tile whose rim is cut off fade into each other (chosen: 0 would ring)."""


@dataclass(frozen=True, slots=True, eq=False)
class Canvas:
    """A periodic grid that holds `rows` x `cols` data, and before them `margin` pixels without.

    After the data there are at least as many.
    """

    rows: int
    cols: int
    margin: int

    @classmethod
    def around(cls, tile: Planes, blurs: Sequence[UniformBlur], *, surrounded: bool) -> Canvas:
        """Canvas for a tile, with a margin in which light that wraps around meets no data of the other end.

        Where all sides will be cut off, as it is `surrounded`, it need only join the ends without a step.
        """
        wide = max(blur.reach for blur in blurs)
        margin = min(_JOINT, wide) if surrounded else wide
        return cls(tile.shape[1], tile.shape[2], margin)

    @property
    def shape(self) -> tuple[int, int]:
        """Size of the grid, quick to transform."""
        return fast_shape((self.rows + 2 * self.margin, self.cols + 2 * self.margin))

    @property
    def data(self) -> tuple[slice, slice]:
        """Where the data lie on the grid."""
        return slice(self.margin, self.margin + self.rows), slice(self.margin, self.margin + self.cols)

    def filled(self, planes: Planes, light: Real, beyond: int = 0) -> Planes:
        """Place planes, divided by the `light` of each, that reach `beyond` the data on all sides.

        The rest of the margin fades from one end to the other.
        """
        y = np.empty((len(planes), *self.shape), dtype=np.float32)
        high, wide = planes.shape[1:]
        np.divide(planes, light[:, None, None], out=y[:, :high, :wide])
        first, second, fade = _seam(high, self.shape[0])
        t = fade[:, None]
        y[:, high:, :wide] = y[:, first, :wide] * (ONE - t) + y[:, second, :wide] * t
        first, second, fade = _seam(wide, self.shape[1])
        y[:, :, wide:] = y[:, :, first] * (ONE - fade) + y[:, :, second] * fade
        return np.roll(y, (self.margin - beyond,) * 2, axis=(1, 2))


@lru_cache(maxsize=64)
def _seam(rows: int, length: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Real]:
    """Rows to fade from and to beyond `rows`, up to `length`, and the share of the latter."""
    t = np.arange(length - rows)
    fade = ((t + 0.5) / max(length - rows, 1)).astype(np.float32)
    return np.maximum(rows - 1 - t, 0), np.minimum(length - rows - 1 - t, rows - 1), fade


def fitted_halo(cell: tuple[int, int], least: int) -> int:
    """Widest halo of a cell for which its canvas is no larger than for the least one."""
    needed = tuple(extent + 2 * (least + _JOINT) for extent in cell)
    return least + min(np.subtract(fast_shape(needed), needed)) // 2


@jit
def block_sums(plane: Real, side: int, rim: int = 0) -> Real:
    """Sums over square blocks of a plane with `rim` pixels of zeros around; the last ones may be smaller."""
    rows, cols = plane.shape
    sums = np.zeros((-(-(rows + 2 * rim) // side), -(-(cols + 2 * rim) // side)), np.float32)
    for block in range(sums.shape[0]):
        line, first = np.zeros(cols, np.float32), side * block - rim
        for i in range(max(first, 0), min(first + side, rows)):
            for j in range(cols):
                line[j] += plane[i, j]
        for j in range(cols):
            sums[block, (j + rim) // side] += line[j]
    return sums


def interpolated(blocks: Real, side: int, rows: int, cols: int) -> Real:
    """Interpolate values of square blocks linearly between their middles, constant beyond these."""
    for extent in (rows, cols):
        low, high, share = _between(extent, side)
        blocks = (blocks[low] + share * (blocks[high] - blocks[low])).T
    return np.ascontiguousarray(blocks)


@lru_cache(maxsize=64)
def _between(extent: int, side: int) -> tuple[NDArray[np.intp], NDArray[np.intp], Real]:
    """The blocks before and after each pixel, and the share of the latter, `(extent, 1)`."""
    starts = np.arange(0, extent, side)
    middles = (starts + np.minimum(starts + side, extent) - 1) / 2.0
    at = np.interp(np.arange(extent), middles, np.arange(len(starts)))
    low = at.astype(np.intp)
    return low, np.minimum(low + 1, len(starts) - 1), (at - low).astype(np.float32)[:, None]
