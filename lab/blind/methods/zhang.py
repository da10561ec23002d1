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

from lab.blind.methods.zhang_model import GradientBeliefs, pooled_kernel
from lab.blind.steps.cleaning import cleaned
from lab.blind.steps.pyramid import Image, Level, LevelResult, Schedule, Tick, View, coarse_to_fine
from lab.blind.steps.starting_from import StartingFrom
from lensmodel.blind.estimator import PsfEstimate, finished, usable
from lensmodel.core.psf import centred, distance, gaussian
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook

_FIRST_SIGMA_PX = 0.7  # of the first kernel, in pixels of the coarsest level (chosen)
_ERROR_FLOOR, _ERROR_SLOPE = 0.15, 0.5  # by disagreement (chosen): nothing is kept that fitted them


@dataclass(frozen=True, slots=True)
class Zhang(StartingFrom):
    """Kernel of least free energy under the coupled adaptive sparse prior.

    Coarse to fine; each sweep updates the gradients and their variances, the kernel and the noise.

    Parameters
    ----------
    iterations : int
        Sweeps on each level.
    steps : int
        Conjugate gradient steps of each image update.
    floor : float
        d over the number of pixels: λ never falls below it, in squared ranges of the patch.
    threshold : float
        Kernel values below this share of the peak are dropped at the end: gradients see no low
        frequencies of a kernel, which leaves a faint pedestal over the whole support.
    support : int or None
        Odd side of the estimated kernel; None takes it from `size`.
    """

    iterations: int = 20
    steps: int = 8
    floor: float = 1e-4
    threshold: float = 0.05
    support: int | None = None

    name = "zhang"
    version = 1

    def _run(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        size: int,
        start: Kernel | None,
        on_step: StepHook,
    ) -> PsfEstimate:
        kept = usable(patches, noise, size)
        views = [View.of(patch, model) for patch, model in kept]
        side = self.support or size
        schedule = Schedule(side, self.iterations, coarsest=5 if start is None else side)
        if start is None:
            levels = len(schedule.sides(min(min(view.y.shape) for view in views)))
            coarse = _FIRST_SIGMA_PX / schedule.ratio ** (levels - 1)
            start = gaussian(side, coarse**2 * np.eye(2))
        solver = _Sweeps(self.steps, self.floor)
        found = coarse_to_fine(views, solver, schedule, start=start, on_step=on_step)
        disagreement = _disagreement(solver.scenes, found.kernel)
        learned = np.sqrt([scene.noise / 2.0 for scene in solver.scenes])
        return finished(
            cleaned(found.kernel, self.threshold),
            size=size,
            error=_ERROR_FLOOR + _ERROR_SLOPE * disagreement,
            diagnostics={
                "support": float(side),
                "disagreement": disagreement,
                "learned_noise": float(np.mean(learned)),
                "noise_ratio": float(np.mean(learned / [max(view.noise, 1e-9) for view in views])),
                "free_energy": sum(scene.free_energy(found.kernel) for scene in solver.scenes),
            },
        )


@dataclass(slots=True)
class _Sweeps:
    """The alternation on one level; what it last believed stays for the verdict."""

    steps: int
    floor: float
    scenes: tuple[GradientBeliefs, ...] = ()

    def __call__(self, level: Level, kernel: Kernel, latents: tuple[Image, ...], tick: Tick) -> LevelResult:
        kernel = centred(kernel)  # or it drifts, level by level, until the support cuts it
        # λ and γ start anew on each level: what was learned on the coarser one is too sure of itself.
        scenes = [
            GradientBeliefs.of(view.y, level.side, kernel, self.floor + 2.0 * view.noise**2)
            for view in level.views
        ]
        for _ in range(level.iterations):
            scenes = [scene.improved(kernel, self.steps) for scene in scenes]
            raw = pooled_kernel([part for scene in scenes for part in scene.weighted()], kernel)
            kernel, total = cleaned(raw, 0.0), float(raw.sum())
            scenes = [scene.scaled(total).with_noise(kernel) for scene in scenes]
            tick()
        self.scenes = tuple(scenes)
        return LevelResult(kernel, latents)


def _disagreement(scenes: Sequence[GradientBeliefs], kernel: Kernel) -> float:
    """Relative L2 distance of the kernels that the two gradient directions give alone."""
    ways = [[scene.weighted()[i] for scene in scenes] for i in (0, 1)]
    down, across = (pooled_kernel(way, kernel) for way in ways)
    if not min(down.sum(), across.sum()) > 0:
        return 1.0
    return distance(down, across).rel_l2
