"""Blind deblurring by a coupled adaptive sparse prior, `zhang`.

Variational Bayes on image gradients: instead of picking edges by hand, the prior variance of every
gradient is learned, and so is the noise. What keeps the kernel from collapsing to a delta is the
posterior variance of the gradients, which enters the kernel step as a penalty on k². Source: H. Zhang,
D. Wipf and Y. Zhang, "Multi-image blind deblurring using a coupled adaptive sparse prior", CVPR 2013,
eq. (8) and algorithm 1.

Latent gradients x (m pixels, wider than the frame by a kernel), observed gradients y (n pixels), noise
variance λ, a prior variance γ_i for every latent pixel, and a Gaussian posterior with means x and
variances c. With w_i = sum_j k_j², over the kernel pixels by which i reaches the frame::

    F = (|y - k * x|² + sum_i c_i w_i + d) / λ + n log λ
        + sum_i [ (x_i² + c_i) / γ_i + log γ_i - log c_i ]

Minimised over c it is the cost of the paper, whose penalty couples x, k and λ: concave in |x_i| with a
curvature set by λ / |k|², nearly convex while the noise is thought large, like l0 once it is small::

    (|y - k * x|² + d) / λ + sum_i [ x_i² / γ_i + log(λ + γ_i w_i) ] + (n - m) log λ + m

Each update below minimises F over its own variable, so that F never rises. F does not change when
k is divided and x multiplied by the same number.

Departures from the paper:

1. The paper has several blurs of one scene; here the gradients down and across of a scene share one blur.
2. The first kernel is a small Gaussian, not two pixels, so that results turn with the patch.
3. The floor of λ is the paper's plus the noise that is known of the camera. Alone, λ falls below the
   noise on linear light with its low contrast, x follows the noise, and the kernel becomes a delta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lab.blind.steps.kernel_step import (
    Floats,
    Grid,
    Kernelish,
    Term,
    cleaned,
    conjugate_gradients,
    least_squares_kernel,
    unsure,
)
from lab.blind.steps.pyramid import RATIO, Image, Level, View, coarse_to_fine, kernel_sides
from lab.kernels import gaussian
from lensmodel.blind import PsfEstimate
from lensmodel.core.psf import centred
from lensmodel.core.types import Kernel, NoiseModel, Plane

_FIRST_SIGMA_PX = 0.7  # of the first kernel, in pixels of the coarsest level (chosen)
_TINY = 1e-12  # keeps divisions finite: far below any power of gradients
_FIRST_NOISE = 0.5  # share of the power of gradients that is thought noise at first (chosen): nearly convex


@dataclass(frozen=True, slots=True)
class Zhang:
    """Kernel of least free energy under the coupled adaptive sparse prior."""

    iterations: int = 20  # sweeps on each level
    steps: int = 8  # conjugate gradient steps of each image update
    floor: float = 1e-4  # d over the number of pixels: λ never falls below it, in squared ranges of the patch
    # kernel values below this share of the peak are dropped at the end: gradients see no low frequencies of a
    # kernel, which leaves a faint pedestal over the whole support
    threshold: float = 0.05

    name = "zhang"
    version = 1

    def estimate(
        self, patches: Sequence[Plane], noise: Sequence[NoiseModel], *, size: int = 31
    ) -> PsfEstimate:
        """Estimate the kernel of a patch; see `BlindMethod`."""
        view = View.of_one(patches, noise, size)
        coarse = _FIRST_SIGMA_PX / RATIO ** (len(kernel_sides(size, min(view.y.shape))) - 1)
        start = gaussian(size, coarse**2 * np.eye(2))
        return unsure(cleaned(coarse_to_fine(view, self._sweeps, size, start=start), self.threshold), size)

    def _sweeps(self, level: Level, kernel: Kernel, latent: Image) -> tuple[Kernel, Image]:
        """The alternation on one level."""
        kernel = centred(kernel)  # or it drifts, level by level, until the support cuts it
        # λ and γ start anew on each level: what was learned on the coarser one is too sure of itself.
        floor = self.floor + 2.0 * level.view.noise**2
        scene = PatchPosterior.of(level.view.y, level.side, kernel, floor)
        for _ in range(self.iterations):
            scene = scene.improved(kernel, self.steps)
            raw = scene.kernel_step(kernel)
            kernel = cleaned(raw, 0.0)
            scene = scene.scaled(float(raw.sum())).with_noise(kernel)
        return kernel, latent


@dataclass(frozen=True, slots=True, eq=False)
class GradientPosterior:
    """Posterior of one gradient image: x, γ, c."""

    grid: Grid
    y: Floats
    x: Floats  # posterior means, prior variances γ, posterior variances c
    gamma: Floats
    variance: Floats

    @classmethod
    def first(cls, y: NDArray[np.floating], side: int, kernel: Kernelish, noise: float) -> GradientPosterior:
        """Start with one γ for all, the mean square of y."""
        grid = Grid((y.shape[0], y.shape[1]), side)
        power = np.float32(max(float(np.mean(np.square(y))), _TINY))
        gamma = np.full(grid.latent, power, dtype=np.float32)
        half = side // 2
        x = np.pad(y.astype(np.float32), half)
        return cls(grid, y.astype(np.float32), x, gamma, gamma).spread(kernel, noise)

    def spread(self, kernel: Kernelish, noise: float) -> GradientPosterior:
        """Update c = 1 / (w / λ + 1 / γ)."""
        precision = self.grid.reach_of(kernel) / np.float32(noise) + 1.0 / self.gamma
        return replace(self, variance=(1.0 / precision).astype(np.float32))

    def sharpened(self, kernel: Kernelish, noise: float, steps: int) -> GradientPosterior:
        """Update x = argmin |y - k * x|² / λ + sum_i x_i² / γ_i by preconditioned conjugate gradients."""
        grid, lam = self.grid, np.float32(noise)
        spectrum = grid.spectrum(kernel)
        precision = 1.0 / self.gamma
        misfit = self.y - grid.valid(spectrum * grid.spectrum(self.x))

        def applied(x: Floats) -> Floats:
            return grid.back(spectrum, grid.valid(spectrum * grid.spectrum(x))) / lam + precision * x

        residual = grid.back(spectrum, misfit) / lam - precision * self.x
        x = conjugate_gradients(applied, residual, self.x, steps, inverse=lambda r: self.variance * r)
        return replace(self, x=x)

    def sparser(self) -> GradientPosterior:
        """Update γ_i = x_i² + c_i."""
        return replace(self, gamma=np.maximum(np.square(self.x) + self.variance, _TINY))

    def scaled(self, factor: float) -> GradientPosterior:
        """Multiply x by a factor, as k is divided by it; F stays."""
        s, s2 = np.float32(factor), np.float32(factor * factor)
        return replace(self, x=self.x * s, gamma=self.gamma * s2, variance=self.variance * s2)

    def misfit(self, kernel: Kernelish) -> float:
        """|y - k * x|² + sum_i c_i w_i."""
        residual = self.y - self.grid.blurred(kernel, self.x)
        spread = float(np.vdot(self.variance, self.grid.reach_of(kernel)))
        return float(np.vdot(residual, residual)) + spread


@dataclass(frozen=True, slots=True, eq=False)
class PatchPosterior:
    """Posteriors of the gradient images of one patch, down and across, with the noise variance λ of both."""

    parts: tuple[GradientPosterior, ...]
    noise: float  # λ; differences of white noise of variance σ² have 2 σ²
    floor: float  # d over the number of pixels

    @classmethod
    def of(cls, y: NDArray[np.float64], side: int, kernel: Kernelish, floor: float) -> PatchPosterior:
        """Start with half of the gradients' power as noise: nearly everything is still open."""
        slopes = [np.diff(y, axis=axis) for axis in (0, 1)]
        noise = _FIRST_NOISE * 0.5 * float(np.mean(slopes[0] ** 2) + np.mean(slopes[1] ** 2)) + floor
        return cls(tuple(GradientPosterior.first(s, side, kernel, noise) for s in slopes), noise, floor)

    def improved(self, kernel: Kernelish, steps: int) -> PatchPosterior:
        """Update x, c and γ of both gradients."""
        found = (part.sharpened(kernel, self.noise, steps) for part in self.parts)
        return replace(self, parts=tuple(part.spread(kernel, self.noise).sparser() for part in found))

    def scaled(self, factor: float) -> PatchPosterior:
        """Multiply both x by a factor, as k is divided by it."""
        return replace(self, parts=tuple(part.scaled(factor) for part in self.parts))

    def with_noise(self, kernel: Kernelish) -> PatchPosterior:
        """Update λ = (|y - k * x|² + sum_i c_i w_i + d) / n."""
        misfit = sum(part.misfit(kernel) for part in self.parts)
        return replace(self, noise=misfit / sum(part.y.size for part in self.parts) + self.floor)

    def kernel_step(self, kernel: Kernelish) -> Kernelish:
        """Update k >= 0 to the minimum of sum_l (|y_l - k * x_l|² + sum_j k_j² sum_i c_l,i) / λ."""
        terms = [Term(b.grid, b.y, b.x, 1.0 / self.noise, b.grid.sums_of(b.variance)) for b in self.parts]
        return least_squares_kernel(terms, kernel)
