"""Pieces that the methods by predicted edges share: prediction, selection, kernel step, borders.

Derivatives are forward differences. Borders are continued smoothly to a periodic canvas for image steps, and
no edge within half a kernel of the border counts in kernel steps.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lab.blind.steps.kernel_step import cleaned, conjugate_gradients
from lab.blind.steps.pyramid import Image
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import as_kernel, centroid, otf
from lensmodel.core.types import Kernel

_ORIENTATIONS = 4  # as in Cho and Lee
_TINY = 1e-12  # keeps divisions finite: far below any gradient
_TOLERANCE = 1e-5  # of the residual over the right side, where conjugate gradients end

Mask = NDArray[np.bool_]


def down(image: Image) -> Image:
    """Difference to the next row; zero in the last."""
    return np.diff(image, axis=0, append=image[-1:])


def across(image: Image) -> Image:
    """Difference to the next column; zero in the last."""
    return np.diff(image, axis=1, append=image[:, -1:])


def shock_filtered(image: Image, dt: float, steps: int = 1) -> Image:
    """Sharpen edges to steps, I <- I - sign(laplacian I) |grad I| dt; stable for dt <= .7.

    Source: S. Osher and L. I. Rudin, SIAM J. Numer. Anal. 27, 1990, eq. (2.19).
    """
    sharp = image
    for _ in range(steps):
        wide = np.pad(sharp, 1, mode="edge")
        before_row, after_row = sharp - wide[:-2, 1:-1], wide[2:, 1:-1] - sharp
        before_col, after_col = sharp - wide[1:-1, :-2], wide[1:-1, 2:] - sharp
        laplacian = after_row - before_row + after_col - before_col
        slope = np.hypot(_minmod(before_row, after_row), _minmod(before_col, after_col))
        sharp = sharp - np.sign(laplacian) * slope * dt
    return sharp


def _minmod(a: Image, b: Image) -> Image:
    return np.where(a * b > 0, np.sign(a) * np.minimum(np.abs(a), np.abs(b)), 0.0)


def bilateral(image: Image, *, reach: int, sigma_space: float, sigma_range: float) -> Image:
    """Average neighbours that are near in place and in value (C. Tomasi and R. Manduchi, ICCV 1998)."""
    wide = np.pad(image, reach, mode="symmetric")
    total, weights = np.zeros(image.shape), np.zeros(image.shape)
    for row in range(-reach, reach + 1):
        for col in range(-reach, reach + 1):
            near = math.exp(-0.5 * (row * row + col * col) / sigma_space**2)
            top, left = reach + row, reach + col
            other = wide[top : top + image.shape[0], left : left + image.shape[1]]
            weight = near * np.exp(-0.5 * np.square((other - image) / sigma_range))
            total += weight * other
            weights += weight
    return total / weights


def oriented_threshold(
    rows: Image, cols: Image, least: int, allowed: Mask, *, ranked: Image | None = None
) -> float:
    """Largest threshold at which each of four orientations keeps `least` allowed pixels, or all it has."""
    magnitude = np.hypot(rows, cols)
    rank = magnitude if ranked is None else ranked
    angle = np.mod(np.arctan2(rows, cols), np.pi)
    sector = np.minimum((angle * (_ORIENTATIONS / np.pi)).astype(np.intp), _ORIENTATIONS - 1)
    present = allowed & (magnitude > _TINY)
    found = []
    for i in range(_ORIENTATIONS):
        own = rank[present & (sector == i)]
        if own.size:
            found.append(float(np.partition(own, max(own.size - least, 0))[max(own.size - least, 0)]))
    return min(found, default=0.0)


def inside(shape: tuple[int, ...], margin: int) -> Mask:
    """Pixels at least `margin` from the border."""
    mask = np.zeros(shape, dtype=np.bool_)
    mask[margin : shape[0] - margin, margin : shape[1] - margin] = True
    return mask


@dataclass(frozen=True, slots=True, eq=False)
class PeriodicPlane:
    """A periodic plane that shows an image in its middle, for image steps by FFT."""

    frame: tuple[int, int]  # shape of the image
    pad: tuple[int, int]  # pixels added on either side of the rows and columns

    @classmethod
    def around(cls, image: Image, side: int) -> PeriodicPlane:
        """Room for a kernel of `side` between opposite borders, of a size that suits the FFT."""
        rows, cols = image.shape
        return cls((rows, cols), (_fast_pad(rows, side), _fast_pad(cols, side)))

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the plane."""
        return self.frame[0] + 2 * self.pad[0], self.frame[1] + 2 * self.pad[1]

    def filled(self, image: Image) -> Image:
        """Continue an image so that it closes on itself: mirrored ends, faded into each other."""
        rows, cols = _closing(self.frame[0], self.pad[0]), _closing(self.frame[1], self.pad[1])
        return np.asarray(rows @ image @ cols.T)

    def cut(self, plane: Image) -> Image:
        """Return the image in the middle."""
        (row, col), (rows, cols) = self.pad, self.frame
        return plane[row : row + rows, col : col + cols]

    def spectrum(self, image: Image) -> NDArray[np.complex128]:
        """Transform of an image, continued."""
        return fft.rfft2(self.filled(image))

    def gradient_power(self) -> tuple[Image, Image]:
        """Powers of both forward differences."""
        row = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.fftfreq(self.shape[0]))
        col = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.rfftfreq(self.shape[1]))
        width = (self.shape[0], col.size)
        return np.broadcast_to(row[:, None], width), np.broadcast_to(col[None, :], width)

    def divergence(self, rows: Image, cols: Image) -> Image:
        """Adjoint of the forward differences of a plane, of fields given on the image only."""
        fields = np.zeros((2, *self.shape))
        (row, col), (high, wide) = self.pad, self.frame
        fields[:, row : row + high, col : col + wide] = rows, cols
        down_field, across_field = fields
        return np.roll(down_field, 1, 0) - down_field + np.roll(across_field, 1, 1) - across_field

    def otf(self, kernel: Kernel) -> NDArray[np.complex128]:
        """Transfer function of a kernel on the plane."""
        return otf(kernel, self.shape)


def _fast_pad(length: int, least: int) -> int:
    pad = least
    while int(fft.next_fast_len(length + 2 * pad, real=True)) != length + 2 * pad:
        pad += 1
    return pad


@lru_cache(maxsize=64)
def _closing(length: int, pad: int) -> Image:
    """Matrix `(length + 2 pad, length)` of `PeriodicPlane.filled` along one axis."""
    matrix = np.eye(length + 2 * pad, length, -pad)
    beyond = np.arange(2 * pad)  # places from the end on, around to before the beginning
    fade = 0.5 - 0.5 * np.cos(np.pi * (beyond + 0.5) / (2 * pad))
    rows = (beyond + length + pad) % len(matrix)
    mirrored = np.pad(np.arange(length), 2 * pad, mode="symmetric")
    np.add.at(matrix, (rows, mirrored[beyond + length + 2 * pad]), 1.0 - fade)
    np.add.at(matrix, (rows, mirrored[beyond]), fade)
    matrix.setflags(write=False)
    return matrix


@dataclass(frozen=True, slots=True, eq=False)
class DerivativePair:
    """A predicted derivative of the sharp image, and the same derivative as observed."""

    sharp: Image  # (H, W)
    observed: Image
    weight: float


@dataclass(frozen=True, slots=True, eq=False)
class KernelEquations:
    """Normal equations of sum w |s * k - b|², pooled over derivatives and patches."""

    side: int  # odd side of the kernel
    power: Image  # sum w |S|² on a common grid, which no patch wraps on
    cross: NDArray[np.complex128]  # sum w conj(S) B
    grid: tuple[int, int]  # shape of the common grid

    @classmethod
    def of(cls, pairs: Sequence[DerivativePair], side: int) -> KernelEquations:
        """Sum over pairs; predictions near the border, whose blur reaches outside, are left out."""
        reach = [max(pair.sharp.shape[axis] for pair in pairs) + side for axis in (0, 1)]
        grid = (int(fft.next_fast_len(reach[0], real=True)), int(fft.next_fast_len(reach[1], real=True)))
        power = np.zeros((grid[0], grid[1] // 2 + 1))
        cross = np.zeros(power.shape, dtype=np.complex128)
        for pair in pairs:
            kept = np.where(inside(pair.sharp.shape, side // 2 + 1), pair.sharp, 0.0)
            sharp, observed = fft.rfft2(kept, grid), fft.rfft2(pair.observed, grid)
            power += pair.weight * np.square(np.abs(sharp))
            cross += pair.weight * np.conj(sharp) * observed
        if not power.max() > _TINY:
            raise NotEnoughEvidenceError("no edge stands out of the patches; choose parts with clear edges")
        return cls(side, power, cross, grid)

    def divided(self, gamma: float) -> NDArray[np.float64]:
        """Kernel by division of spectra, cross / (power + gamma), cut to its side."""
        return self._middle(fft.irfft2(self.cross / (self.power + gamma), self.grid))

    def conjugate_gradients(
        self, gamma: float | NDArray[np.float64], start: NDArray[np.float64], *, steps: int
    ) -> NDArray[np.float64]:
        """Minimise sum w |s * k - b|² + gamma |k|² over kernels of this side, unconstrained."""
        n = int(fft.next_fast_len(2 * self.side, real=True))
        lags = np.arange(-(self.side - 1), self.side)
        plane = fft.irfft2(self.power, self.grid)
        small = np.zeros((n, n))
        small[np.ix_(lags % n, lags % n)] = plane[np.ix_(lags % self.grid[0], lags % self.grid[1])]
        toeplitz = fft.rfft2(small)

        def applied(k: NDArray[np.float64]) -> NDArray[np.float64]:
            blurred = fft.irfft2(toeplitz * fft.rfft2(k, (n, n)), (n, n))[: self.side, : self.side]
            return np.asarray(blurred + gamma * k)

        target = self._middle(fft.irfft2(self.cross, self.grid))
        enough = _TOLERANCE**2 * float(np.vdot(target, target))
        return conjugate_gradients(applied, target - applied(start), start, steps, least=enough)

    def _middle(self, plane: Image) -> NDArray[np.float64]:
        lags = np.arange(self.side) - self.side // 2
        return plane[np.ix_(lags % self.grid[0], lags % self.grid[1])]


def pruned(kernel: NDArray[np.float64], threshold: float) -> Kernel:
    """Clean a kernel and roll it by whole pixels until its centre of mass is the middle."""
    kept = np.array(cleaned(kernel, threshold))
    row, col = (round(x) for x in centroid(kept))
    if (row, col) != (0, 0):
        kept = ndimage.shift(kept, (-row, -col), order=0, mode="constant")
    return as_kernel(kept)
