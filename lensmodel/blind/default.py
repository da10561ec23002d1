"""The default estimator: a Whittle Gaussian and patch recurrence, and of both the milder blur.

From several patches of one position on, a wavefront is fitted to their spectra and to the result of patch
recurrence, which then only has to tell the phase.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lensmodel.blind.aberrations import AberrationFit
from lensmodel.blind.base import PsfEstimate, is_no_blur, usable
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.blind.radial import radial_mtf, with_radial_mtf
from lensmodel.blind.scene_spectra import SceneSpectra
from lensmodel.blind.whittle import Whittle
from lensmodel.psf import as_kernel, centred, distance, rms_width
from lensmodel.types import NoiseModel, Plane, StepHook, ignore_step

_PIXEL_SIGMA = 0.29
_POOLED_SUPPORT, _POOLED_ITERATIONS, _POOLED_SIDE = 21, 3, 160
_POOLED_ERROR = 0.7
"""Relative error of a wavefront agreed on by n patches, times the root of n."""

_AT_TYPICAL = -1.08
"""Logarithm of the error where both estimates agree on a Gaussian of 1 px and a usual scene."""


@dataclass(frozen=True, slots=True)
class Cautious:
    """What a Whittle Gaussian and patch recurrence agree on, and where they do not, the milder blur.

    A kernel that is too wide ruins a photo, one too narrow only helps less. Both methods take the
    softness of a scene for blur, each in its own way:

    * a Gaussian narrower than `trusted_px`: the mean of both, unless patch recurrence ran more than
      `apart` times as wide; then the Gaussian alone;
    * a wider one: the mean, its radial MTF raised to the higher one of the two.

    The root mean square distance of their MTFs is also the best predictor of the true error.

    `pooled` patches and more are different enough for the scenes' slopes to average out: see
    `aberrations`. The patches must be of different scenes.
    """

    trusted_px: float = 0.95
    apart: float = 2.2
    pooled: int = 6

    name = "default"
    version = 5

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate the kernel that all patches share; see `PsfEstimator`."""
        began = time.process_time()
        kept = usable(patches, noise, size)
        if len(kept) >= self.pooled:
            return self._agreed(kept, size, began, on_step)
        gaussian = Whittle().estimate(patches, noise, size=size)
        support = min(max(2 * round(3.0 * gaussian.diagnostics["width"] + 3.0) + 1, 15), 31, size)
        recurrence = PatchRecurrence(support=support)
        found = recurrence.estimate(patches, noise, size=size, on_step=on_step)
        return self._chosen(gaussian, found, began, size)

    def estimate_channel(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        reference: PsfEstimate,
        reference_patches: Sequence[Plane],
        *,
        size: int = 31,
        rng: np.random.Generator | None = None,
        on_step: StepHook = ignore_step,
    ) -> PsfEstimate:
        """Estimate another channel from the reference kernel on."""
        began = time.process_time()
        gaussian = Whittle().estimate(patches, noise, size=size)
        recurrence = PatchRecurrence(support=int(reference.diagnostics.get("support", 21.0)), iterations=3)
        found = recurrence.estimate_channel(
            patches, noise, reference, reference_patches, size=size, on_step=on_step
        )
        return self._chosen(gaussian, found, began, size)

    def _agreed(
        self, kept: Sequence[tuple[Plane, NoiseModel]], size: int, began: float, on_step: StepHook
    ) -> PsfEstimate:
        """Kernel of the wavefront that all patches agree on."""
        inner = [_middle(patch, _POOLED_SIDE) for patch, _ in kept]
        recurrence = PatchRecurrence(support=min(_POOLED_SUPPORT, size), iterations=_POOLED_ITERATIONS)
        steps = recurrence.levels * recurrence.iterations
        found = recurrence.estimate(
            inner, [model for _, model in kept], size=size, on_step=lambda done, _: on_step(done, 2 * steps)
        )
        fitted = AberrationFit().fit(
            SceneSpectra.of(kept),
            found.kernel,
            lambda done, total: on_step(steps + done * steps // total, 2 * steps),
        )
        kernel = fitted.kernel(size)
        error = min(max(_POOLED_ERROR / math.sqrt(len(kept)), 0.05), 1.0)
        diagnostics: Mapping[str, float] = {
            **found.diagnostics,
            "width": rms_width(kernel),
            "disagreement": distance(found.kernel, kernel).mtf_rmse,
            "cost": fitted.cost,
        }
        return replace(
            found,
            kernel=kernel,
            confidence=1.0 / (1.0 + (error / 0.4) ** 2),
            predicted_error=error,
            diagnostics=diagnostics,
            seconds=time.process_time() - began,
            no_blur=is_no_blur(kernel),
        )

    def _chosen(self, gaussian: PsfEstimate, found: PsfEstimate, began: float, size: int) -> PsfEstimate:
        disagreement = distance(found.kernel, gaussian.kernel).mtf_rmse
        narrow = rms_width(gaussian.kernel) <= self.trusted_px
        kernel = mean = as_kernel(0.5 * (gaussian.kernel + found.kernel))
        if narrow and rms_width(found.kernel) > self.apart * max(rms_width(gaussian.kernel), _PIXEL_SIGMA):
            kernel = gaussian.kernel
        elif not narrow:
            milder = np.maximum(radial_mtf(gaussian.kernel), radial_mtf(found.kernel))
            kernel = centred(with_radial_mtf(mean, milder))
        error = predicted_error(disagreement, rms_width(gaussian.kernel), gaussian.diagnostics["slope"])
        diagnostics: Mapping[str, float] = {
            **found.diagnostics,
            "gaussian_width": gaussian.diagnostics["width"],
            "slope": gaussian.diagnostics["slope"],
            "disagreement": disagreement,
            "narrow": float(narrow),
        }
        return replace(
            found,
            kernel=kernel,
            confidence=1.0 / (1.0 + (error / 0.4) ** 2),
            predicted_error=error,
            diagnostics=diagnostics,
            seconds=time.process_time() - began,
            no_blur=is_no_blur(kernel),
        )


def _middle(patch: Plane, side: int) -> Plane:
    """Cut the middle out: many patches together need not be large."""
    top, left = (max(n - side, 0) // 2 for n in patch.shape)
    return patch[top : top + side, left : left + side]


def predicted_error(disagreement: float, width: float, slope: float) -> float:
    """Expected relative L2 error of the kernel, a log-linear fit to simulated lenses.

    Parameters
    ----------
    disagreement : float
        Root mean square distance of the MTFs of the two estimates.
    width : float
        RMS width of the Gaussian in pixels.
    slope : float
        Slope of the scene's power spectrum that went with it; a steep one hides blur or is it.
    """
    logarithm = _AT_TYPICAL + 2.19 * disagreement + 0.66 * math.log(max(width, 0.2)) + 2.23 * (slope - 2.5)
    return min(max(math.exp(logarithm), 0.05), 1.0)
