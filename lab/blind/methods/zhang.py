"""Blind deblurring by a coupled adaptive sparse prior, `zhang`.

Variational Bayes on image gradients: instead of picking edges by hand, the prior variance of every
gradient is learned, and so is the noise. What keeps the kernel from collapsing to a delta is the
posterior variance of the gradients, which enters the kernel step as a penalty on k². Source: H. Zhang,
D. Wipf and Y. Zhang, "Multi-image blind deblurring using a coupled adaptive sparse prior", CVPR 2013.

Departures from the paper:

1. The paper has several blurs of one scene; here several scenes share one blur. The kernel step
   pools them, and each keeps its own x, γ and λ.
2. The first kernel is a small Gaussian, not two pixels, so that results turn with the patch.
3. The floor of λ is the paper's plus the noise that is known of the camera. Alone, λ falls below the
   noise on linear light with its low contrast, x follows the noise, and the kernel becomes a delta.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lab.blind.methods.zhang_model import PatchPosterior, pooled_kernel
from lab.blind.steps.cleaning import cleaned, unsure
from lab.blind.steps.pyramid import Image, Level, LevelResult, Schedule, Tick, View, coarse_to_fine
from lensmodel.blind.estimator import PsfEstimate, usable
from lensmodel.core.psf import centred, gaussian
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook, ignore_step

_FIRST_SIGMA_PX = 0.7  # of the first kernel, in pixels of the coarsest level (chosen)


@dataclass(frozen=True, slots=True)
class Zhang:
    """Kernel of least free energy under the coupled adaptive sparse prior.

    Coarse to fine; each sweep updates the gradients and their variances, the kernel and the noise.
    """

    iterations: int = 20  # sweeps on each level
    steps: int = 8  # conjugate gradient steps of each image update
    floor: float = 1e-4  # d over the number of pixels: λ never falls below it, in squared ranges of the patch
    # kernel values below this share of the peak are dropped at the end: gradients see no low frequencies of a
    # kernel, which leaves a faint pedestal over the whole support
    threshold: float = 0.05

    name = "zhang"
    version = 1

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share; see `BlindMethod`."""
        views = [View.of(patch, model) for patch, model in usable(patches, noise, size)]
        schedule = Schedule(size, self.iterations)
        levels = len(schedule.sides(min(min(view.y.shape) for view in views)))
        coarse = _FIRST_SIGMA_PX / schedule.ratio ** (levels - 1)
        start = gaussian(size, coarse**2 * np.eye(2))
        sweeps = _Sweeps(self.steps, self.floor)
        found = coarse_to_fine(views, sweeps, schedule, start=start, on_step=on_step)
        return unsure(cleaned(found.kernel, self.threshold), size)


@dataclass(slots=True)
class _Sweeps:
    """The alternation on one level."""

    steps: int
    floor: float

    def __call__(self, level: Level, kernel: Kernel, latents: tuple[Image, ...], tick: Tick) -> LevelResult:
        kernel = centred(kernel)  # or it drifts, level by level, until the support cuts it
        # λ and γ start anew on each level: what was learned on the coarser one is too sure of itself.
        scenes = [
            PatchPosterior.of(view.y, level.side, kernel, self.floor + 2.0 * view.noise**2)
            for view in level.views
        ]
        for _ in range(level.iterations):
            scenes = [scene.improved(kernel, self.steps) for scene in scenes]
            raw = pooled_kernel([part for scene in scenes for part in scene.weighted()], kernel)
            kernel, total = cleaned(raw, 0.0), float(raw.sum())
            scenes = [scene.scaled(total).with_noise(kernel) for scene in scenes]
            tick()
        return LevelResult(kernel, latents)
