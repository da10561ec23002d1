"""The default estimator: spectral start, patch recurrence, and a guard on its width."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from lensmodel.blind.base import PsfEstimate, is_no_blur
from lensmodel.blind.patch_recurrence import PatchRecurrence
from lensmodel.blind.whittle import Whittle
from lensmodel.psf import as_kernel, distance, rms_width
from lensmodel.types import NoiseModel, Plane, StepHook, ignore_step

_PIXEL_SIGMA = 0.29


@dataclass(frozen=True, slots=True)
class Guarded:
    """Patch recurrence, unless a Whittle Gaussian says that it ran too wide.

    A kernel that is too wide ruins a photo, one too narrow only helps less. A Whittle Gaussian
    follows the core of a lens PSF and has about half of its width; patch recurrence that is more than
    `width_limit` times as wide has taken the scene's own softness for blur, at least in part. Then
    the mean of both is given: their core and half of the skirt.

    Their disagreement, the root mean square distance of their MTFs, is also the best predictor of
    the true error.
    """

    width_limit: float = 2.7

    name = "default"
    version = 2

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

    def _chosen(self, gaussian: PsfEstimate, found: PsfEstimate, began: float, size: int) -> PsfEstimate:
        disagreement = distance(found.kernel, gaussian.kernel).mtf_rmse
        wide = rms_width(found.kernel) > self.width_limit * max(rms_width(gaussian.kernel), _PIXEL_SIGMA)
        error = predicted_error(disagreement, len(found.evidence), guarded=wide)
        kernel = as_kernel(0.5 * (gaussian.kernel + found.kernel)) if wide else found.kernel
        diagnostics: Mapping[str, float] = {
            **found.diagnostics,
            "gaussian_width": gaussian.diagnostics["width"],
            "disagreement": disagreement,
            "guarded": float(wide),
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


def predicted_error(disagreement: float, patches: int, *, guarded: bool) -> float:
    """Expected relative L2 error by the disagreement of the two estimates and the number of patches."""
    noise = 0.45 / math.sqrt(max(patches, 1))
    error = math.hypot(math.hypot(0.3, noise), 1.5 * disagreement)
    return min(1.3 * error if guarded else error, 1.0)
