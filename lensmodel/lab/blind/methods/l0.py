"""Blind deblurring with few image gradients, `l0`.

Source: L. Xu, S. Zheng and J. Jia, "Unnatural L0 sparse representation for natural image deblurring", CVPR
2013; schedule and constants as in J. Pan et al., "Deblurring text images via L0-regularized intensity and
gradient prior", CVPR 2014, its gradient prior alone. The latent image has as few gradients as explain
the data: flat regions between perfect steps, whose blur is the kernel. On texture the steps are wrong, and
on mild lens blur they are narrower than the blur leaves to see: kernels come out too wide or too narrow.

Departures from the papers:

1. Patches of one position share the kernel step; the papers have one image.
2. Steps within half a kernel of the border are left out of the kernel step.
3. Threshold and sparsity start anew on every level. Falling through all levels, the sparsity ends too
   low for 1 percent noise, and the latent image follows texture and noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.psf import centred
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook
from lensmodel.estimation import PsfEstimate
from lensmodel.lab.blind.steps.gradients import (
    DerivativePair,
    KernelEquations,
    PeriodicPlane,
    across,
    disagreement,
    down,
    estimate_by_edges,
    inside,
    oriented_threshold,
    pruned,
)
from lensmodel.lab.blind.steps.pyramid import Image, Level, LevelResult, Tick, View
from lensmodel.lab.blind.steps.starting_from import StartingFrom

# As in Pan et al.: the last weight of the splitting and its growth, the least sparsity and how it and the
# thresholds fall from one iteration to the next, the weight of |k|^2 in the kernel step; all up to `_ISLAND`.
_LAST_BETA = 1e5
_GROWTH = 2.0
_LEAST_SPARSITY = 1e-4
_FADE = 1.1
_GAMMA = 2.0
_ISLAND = 0.1  # of the mass of the kernel: smaller islands are dropped
_ERROR = (0.1, 1.2)  # offset and slope by disagreement, on simulated lenses


@dataclass(frozen=True, slots=True)
class L0(StartingFrom):
    """Kernel for which the fewest gradients explain the patch.

    min over x, k of |y - k * x|² + sparsity |grad x|_0 + 2 |k|², by half-quadratic splitting in x and
    conjugate gradients in k.

    Parameters
    ----------
    iterations : int
        Rounds on each level.
    sparsity : float
        Weight of the number of gradients in the first round, in squared ranges of the patch; it falls
        by 1.1 every round and starts anew on each level.
    edges : float
        Pixels kept in each of four orientations for the kernel step, in sides of the kernel.
    threshold : float
        Kernel values below this share of the peak are dropped.
    """

    iterations: int = 5
    sparsity: float = 4e-3
    edges: float = 20.0
    threshold: float = 0.05

    name = "l0"
    version = 1

    def _run(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        size: int,
        start: Kernel | None,
        on_step: StepHook,
    ) -> PsfEstimate:
        return estimate_by_edges(
            _Rounds(self),
            patches,
            noise,
            size=size,
            iterations=self.iterations,
            start=start,
            error=_ERROR,
            on_step=on_step,
        )


@dataclass(slots=True)
class _Rounds:
    """Image and kernel in turn, the sparsity falling from round to round."""

    settings: L0
    pairs: tuple[DerivativePair, ...] = ()
    side: int = 0

    def __call__(self, level: Level, kernel: Kernel, latents: tuple[Image, ...], tick: Tick) -> LevelResult:
        patches = [PatchLevel.of(view, level.side, self.settings.edges) for view in level.views]
        kernel = centred(kernel)
        for i in range(level.iterations):
            sparsity = max(self.settings.sparsity * _FADE**-i, _LEAST_SPARSITY)
            latents = tuple(patch.restored(kernel, sparsity) for patch in patches)
            pairs: list[DerivativePair] = []
            for patch, latent in zip(patches, latents, strict=True):
                pairs += patch.pairs(latent, _FADE**-i)
            self.pairs, self.side = tuple(pairs), level.side
            kernel = pruned(
                self._solved(KernelEquations.of(pairs, level.side)), self.settings.threshold, _ISLAND
            )
            tick()
        return LevelResult(kernel, latents)

    def _solved(self, equations: KernelEquations) -> NDArray[np.float64]:
        side = equations.side
        uniform = np.full((side, side), 1.0 / side**2)
        return equations.conjugate_gradients(_GAMMA, uniform, steps=20)

    def disagreement(self) -> float:
        """How far the kernels of the vertical and the horizontal derivatives lie apart."""
        ways = [[pair for pair in self.pairs if pair.way == way] for way in (0, 1)]
        return disagreement([KernelEquations.of(pairs, self.side) for pairs in ways], self._solved)


@dataclass(frozen=True, slots=True, eq=False)
class PatchLevel:
    """What stays of one patch on one level: its derivatives, spectra and first threshold."""

    canvas: PeriodicPlane
    y_row: Image
    y_col: Image
    spectrum: NDArray[np.complex64]
    slopes: NDArray[np.float32]
    first: float

    @classmethod
    def of(cls, view: View, side: int, edges: float) -> PatchLevel:
        """Prepare a patch for a kernel of `side`."""
        canvas = PeriodicPlane.around(view.y, side)
        row, col = down(view.y), across(view.y)
        first = oriented_threshold(row, col, round(edges * side), inside(view.y.shape, side // 2 + 1))
        power = canvas.gradient_power()
        spectrum = canvas.spectrum(view.y).astype(np.complex64)
        return cls(canvas, row, col, spectrum, (power[0] + power[1]).astype(np.float32), first)

    def restored(self, kernel: Kernel, sparsity: float) -> Image:
        """Minimise |y - k * x|² + sparsity |grad x|_0; eq. (8) to (13) of Pan et al.

        Gradients that are not worth their price are set to zero in an auxiliary field, to which the
        image is drawn ever harder. Single precision is enough for thresholds, and twice as fast.
        """
        k = self.canvas.otf(kernel).astype(np.complex64)
        data, power = np.conj(k) * self.spectrum, np.square(np.abs(k))
        x = fft.irfft2(self.spectrum, self.canvas.shape)
        beta = 2.0 * sparsity
        while beta < _LAST_BETA:
            row, col = np.roll(x, -1, 0) - x, np.roll(x, -1, 1) - x
            kept = np.square(row) + np.square(col) >= sparsity / beta
            row, col = row * kept, col * kept
            divergence = np.roll(row, 1, 0) - row + np.roll(col, 1, 1) - col
            weight = np.float32(beta)
            x = fft.irfft2(
                (data + weight * fft.rfft2(divergence)) / (power + weight * self.slopes), self.canvas.shape
            )
            beta *= _GROWTH
        return self.canvas.cut(x).astype(np.float64)

    def pairs(self, latent: Image, fade: float) -> tuple[DerivativePair, DerivativePair]:
        """Derivatives of the latent image where it is steep, and the observed ones."""
        row, col = down(latent), across(latent)
        steep = np.hypot(row, col) >= fade * self.first
        return (
            DerivativePair(np.where(steep, row, 0.0), self.y_row, 1.0, 0),
            DerivativePair(np.where(steep, col, 0.0), self.y_col, 1.0, 1),
        )
