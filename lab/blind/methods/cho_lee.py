"""Fast motion deblurring by predicted edges, `cho-lee`.

Source: S. Cho and S. Lee, "Fast motion deblurring", ACM Trans. Graph. 28(5), SIGGRAPH Asia 2009. Made for
motion blur of many pixels: edges are restored by a shock filter, kept where they are strong, and the
kernel is what takes them to the observed derivatives. A mildly blurred edge is already as steep as
the shock filter makes any edge, so that there is little to learn from lens blur.

Departure: predicted edges within half a kernel of the border are left out, as the paper's wrap leaks into k.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.blind.steps.gradients import (
    DerivativePair,
    KernelEquations,
    PeriodicPlane,
    across,
    bilateral,
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

_ORDER_WEIGHTS = (50.0, 25.0, 12.5)  # of values, first and second derivatives: as in the paper
_ALPHA = 0.1  # as in the paper
_BETA = 5.0  # as in the paper


@dataclass(frozen=True, slots=True)
class ChoLee:
    """Kernel by prediction of strong edges, conjugate gradients and fast deconvolution."""

    iterations: int = 7  # rounds on each level
    edges: float = 2.0  # r: pixels kept in each of four orientations, in sides of the kernel
    steps: int = 5  # conjugate gradient steps of each kernel update
    threshold: float = 0.05  # kernel values below this share of the peak are dropped

    name = "cho-lee"
    version = 1

    def estimate(
        self, patches: Sequence[Plane], noise: Sequence[NoiseModel], *, size: int = 31
    ) -> PsfEstimate:
        """Estimate the kernel of a patch; see `BlindMethod`."""
        return unsure(coarse_to_fine(View.of_one(patches, noise, size), self._rounds, size), size)

    def _rounds(self, level: Level, kernel: Kernel, latent: Image) -> tuple[Kernel, Image]:
        """Prediction, kernel, deconvolution."""
        y, side = level.view.y, level.side
        image = _Quick.of(y, side)
        if level.number == level.count - 1:
            latent = image.deconvolved(kernel)
        uniform = np.full((side, side), 1.0 / side**2)
        for i in range(self.iterations):
            fade = 0.9**i
            edge = _predicted(latent, fade)
            if i == 0:
                allowed = inside(y.shape, side // 2 + 1)
                threshold = oriented_threshold(*edge, round(self.edges * side), allowed)
            equations = KernelEquations.of(_pairs(edge, y, fade * threshold), side)
            solved = equations.conjugate_gradients(_BETA, uniform, steps=self.steps)
            kernel = pruned(solved, self.threshold)
            latent = image.deconvolved(kernel)
        return kernel, latent


def _predicted(latent: Image, fade: float) -> tuple[Image, Image]:
    """Gradients of the latent image, its noise and ringing smoothed away, its edges made steps."""
    smooth = bilateral(latent, reach=2, sigma_space=2.0, sigma_range=0.5 * fade)
    sharp = shock_filtered(smooth, fade)
    return down(sharp), across(sharp)


def _pairs(edge: tuple[Image, Image], y: Image, threshold: float) -> list[DerivativePair]:
    """Derivatives of first and second order, predicted and observed; eq. (8) and (9)."""
    strong = np.hypot(*edge) >= threshold
    row, col = np.where(strong, edge[0], 0.0), np.where(strong, edge[1], 0.0)
    y_row, y_col = down(y), across(y)
    _, first, second = _ORDER_WEIGHTS
    return [
        DerivativePair(row, y_row, first),
        DerivativePair(col, y_col, first),
        DerivativePair(down(row), down(y_row), second),
        DerivativePair(across(col), across(y_col), second),
        DerivativePair(0.5 * (across(row) + down(col)), across(y_row), second),
    ]


@dataclass(frozen=True, slots=True, eq=False)
class _Quick:
    """Deconvolution with Gaussian priors on derivatives, one division of spectra; eq. (4) to (6)."""

    canvas: PeriodicPlane
    spectrum: NDArray[np.complex128]
    weights: Image
    slopes: Image

    @classmethod
    def of(cls, y: Image, side: int) -> _Quick:
        canvas = PeriodicPlane.around(y, side)
        row, col = canvas.gradient_power()
        zeroth, first, second = _ORDER_WEIGHTS
        weights = zeroth + first * (row + col) + second * (row**2 + col**2 + row * col)
        return cls(canvas, canvas.spectrum(y), weights, row + col)

    def deconvolved(self, kernel: Kernel) -> Image:
        """Return the latent image."""
        k = self.canvas.otf(kernel)
        x = np.conj(k) * self.spectrum * self.weights
        x /= np.square(np.abs(k)) * self.weights + _ALPHA * self.slopes
        return self.canvas.cut(fft.irfft2(x, self.canvas.shape))
