"""Two-phase kernel estimation, `xu-jia`.

Source: L. Xu and J. Jia, "Two-phase kernel estimation for robust motion deblurring", ECCV 2010. Phase one
finds a coarse kernel from edges that are long enough to tell of the blur: fine texture, narrower than
the kernel, misleads. Phase two refines it by iterative support detection: values that stand out
keep their size, only those outside the support are drawn to zero. Made for wide motion blur.

Departures: selected edges within half a kernel of the border are left out, as the paper's wrap leaks into k;
so is the final TV-l1 deconvolution, as the kernel is what is asked for.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lab.blind.steps.gradients import (
    DerivativePair,
    KernelEquations,
    Mask,
    PeriodicPlane,
    across,
    down,
    inside,
    oriented_threshold,
    pruned,
    shock_filtered,
)
from lab.blind.steps.kernel_step import unsure
from lab.blind.steps.pyramid import Image, Level, View, coarse_to_fine
from lensmodel.blind import PsfEstimate
from lensmodel.core.types import Kernel, NoiseModel, Plane

_WINDOW = 5  # pixels: h of the paper
_OFFSET = 0.5  # as in the paper: keeps flat regions from standing out
_GAMMA = 10.0  # of |k|² in phase one (chosen)
_LAMBDA = 2e-3  # of the selected gradients in the coarse image (chosen)
_FADE = 1.1  # by which thresholds fall each round, as in the paper
_SHOCKS, _SHOCK_STEP = 5, 0.5  # steps of the shock filter, and their size (chosen)
_SMOOTHING_PX = 1.0  # before the shock filter: noise would be steepened (chosen)
_REWEIGHTINGS = 3  # solutions weighted by the last sizes of |k| (chosen)
_LEAST_VALUE = 1e-4  # keeps the weight of an empty pixel finite (chosen)


@dataclass(frozen=True, slots=True)
class XuJia:
    """Coarse kernel from useful edges, refined by iterative support detection."""

    iterations: int = 5  # rounds of phase one on each level
    detections: int = 4  # supports that phase two detects at most, on the finest level
    sparsity: float = 1.0  # weight of |k| outside the support, phase two
    threshold: float = 0.05  # kernel values below this share of the peak are dropped

    name = "xu-jia"
    version = 1

    def estimate(
        self, patches: Sequence[Plane], noise: Sequence[NoiseModel], *, size: int = 31
    ) -> PsfEstimate:
        """Estimate the kernel of a patch; see `BlindMethod`."""
        return unsure(coarse_to_fine(View.of_one(patches, noise, size), self._phases, size), size)

    def _phases(self, level: Level, kernel: Kernel, latent: Image) -> tuple[Kernel, Image]:
        """Phase one on every level, phase two at the end of the finest."""
        patch = _PatchLevel.of(level.view, level.side)
        if level.number == level.count - 1:
            latent = patch.deconvolved(kernel, (down(latent), across(latent)))
        for i in range(self.iterations):
            edge = patch.selected(latent, _FADE**-i)
            equations = KernelEquations.of(patch.pairs(edge), level.side)
            kernel = pruned(equations.divided(_GAMMA), self.threshold)
            if level.number == 0 and i == self.iterations - 1:
                kernel = self._refined(equations, kernel)
            latent = patch.deconvolved(kernel, edge)
        return kernel, latent

    def _refined(self, equations: KernelEquations, coarse: Kernel) -> Kernel:
        """Phase two: detect the support, solve with |k| outside it penalised, repeat until it rests."""
        kernel: NDArray[np.float64] = np.array(coarse)
        for i in range(1, self.detections + 1):
            outside = ~support(kernel, i)
            before = kernel
            for _ in range(_REWEIGHTINGS):
                gamma = outside * self.sparsity / np.maximum(np.abs(kernel), _LEAST_VALUE)
                kernel = equations.conjugate_gradients(gamma, kernel, steps=30)
            kernel = np.maximum(kernel, 0.0)
            if np.linalg.norm(kernel - before) < 1e-3 * np.linalg.norm(before):
                break
        return pruned(kernel, self.threshold)


def support(kernel: NDArray[np.float64], turn: int) -> Mask:
    """Pixels above the first large jump of the sorted values, larger than max / (2 side turn); eq. (9)."""
    values = np.sort(kernel, axis=None)
    jumps = np.flatnonzero(np.diff(values) > kernel.max() / (2.0 * kernel.shape[0] * turn))
    return kernel > (values[jumps[0]] if jumps.size else 0.0)


def usefulness(y: Image) -> Image:
    """Length of the mean gradient over the mean length, by windows: low where edges cancel; eq. (2)."""
    row, col = down(y), across(y)
    sums = [ndimage.uniform_filter(f, _WINDOW) * _WINDOW**2 for f in (row, col, np.hypot(row, col))]
    return np.asarray(np.hypot(sums[0], sums[1]) / (sums[2] + _OFFSET))


@dataclass(frozen=True, slots=True, eq=False)
class _PatchLevel:
    """What stays of one patch on one level: its spectra, useful pixels and first threshold."""

    canvas: PeriodicPlane
    y_row: Image
    y_col: Image
    spectrum: NDArray[np.complex128]
    useful: Image
    first_useful: float
    side: int

    @classmethod
    def of(cls, view: View, side: int) -> _PatchLevel:
        y = view.y
        canvas = PeriodicPlane.around(y, side)
        useful = usefulness(y)
        row, col = down(y), across(y)
        mask = inside(y.shape, side // 2 + 1)
        # At least half of sqrt(pixels of the image times pixels of the kernel) in each orientation.
        least = round(0.5 * math.sqrt(y.size * side**2))
        first = oriented_threshold(row, col, least, mask, ranked=useful)
        return cls(canvas, row, col, canvas.spectrum(y), useful, first, side)

    def selected(self, latent: Image, fade: float) -> tuple[Image, Image]:
        """Gradients of the shock-filtered image where the edge is useful and strong; eq. (3)."""
        sharp = shock_filtered(ndimage.gaussian_filter(latent, _SMOOTHING_PX), _SHOCK_STEP, _SHOCKS)
        row, col = down(sharp), across(sharp)
        mask = inside(latent.shape, self.side // 2 + 1)
        useful = self.useful >= fade * self.first_useful
        # At least twice the kernel's side in each orientation.
        strong = oriented_threshold(row, col, 2 * self.side, mask & useful)
        kept = useful & (np.hypot(row, col) >= fade * strong)
        return np.where(kept, row, 0.0), np.where(kept, col, 0.0)

    def pairs(self, edge: tuple[Image, Image]) -> tuple[DerivativePair, DerivativePair]:
        """Derivatives, selected and observed."""
        return DerivativePair(edge[0], self.y_row, 1.0), DerivativePair(edge[1], self.y_col, 1.0)

    def deconvolved(self, kernel: Kernel, edge: tuple[Image, Image]) -> Image:
        """Coarse image with the selected gradients as its prior, one division of spectra; eq. (7)."""
        k = self.canvas.otf(kernel)
        row, col = self.canvas.gradient_power()
        prior = fft.rfft2(self.canvas.divergence(*edge))
        x = (np.conj(k) * self.spectrum + _LAMBDA * prior) / (np.square(np.abs(k)) + _LAMBDA * (row + col))
        return self.canvas.cut(fft.irfft2(x, self.canvas.shape))
