"""The default estimator: a Whittle Gaussian, patch recurrence, a wavefront, and a judge among them."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from lensmodel.core.files import fitted
from lensmodel.core.psf import as_kernel, distance, rms_width
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook, ignore_step
from lensmodel.estimation.estimator import PsfEstimate, is_no_blur, usable
from lensmodel.estimation.methods.patch_recurrence import PatchRecurrence
from lensmodel.estimation.methods.whittle import Whittle
from lensmodel.estimation.spectra.kernel_choice import SpectralLikelihood
from lensmodel.estimation.spectra.local_wavefront import AberrationFit
from lensmodel.estimation.spectra.scene_spectra import SceneSpectra
from lensmodel.estimation.steps.finish import confidence_of, signal_share
from lensmodel.estimation.steps.recurrence import QUICK

_POOLED_SUPPORT, _POOLED_ITERATIONS, _POOLED_SIDE = 21, 3, 160
"""Side of the kernel, alternations, side of the patches, where many are pooled: only the phase is wanted of
them, so that the cheapest that tells it is enough; less does not hold a usual kernel (chosen)."""
_USUAL_SIZE = 31  # pixels: who asks for larger kernels knows of blur that reaches far (chosen)
# Half the side in widths of the Gaussian, which sees the core of wide blur alone, and the least side: first
# for usual kernels, then for larger ones (chosen: a disc of 19 pixels looks like a Gaussian of 2.1)
_REACH, _LEAST_SUPPORT = (3.0, 9.0), (15, 31)
_STARTS, _STARTS_OF_CHANNEL = 10, 6
"""Random wavefronts for few patches: each costs a descent; a colour begins at that of green too (chosen)."""
_PIXEL_SIGMA = 0.29  # pixels: standard deviation of a uniform pixel, 1/sqrt(12)
_LEAST_ERROR = 0.05  # relative: no blind kernel was nearer to the truth (chosen)
_PER_WIDTH = 40.0
"""Cost of a kernel e times as wide: with equal evidence the narrower one wins, which does less harm
(chosen)."""

_FITTED = fitted("estimation")
_POOLED_ERROR: Final = float(_FITTED["pooled_error"])
"""Relative error of a wavefront agreed on by n patches, times the root of n; see `data/README.md`."""

_ERROR: Final[Mapping[str, float]] = _FITTED["default_error"]
"""Constants of `predicted_error`; see `data/README.md`."""


@dataclass(frozen=True, slots=True)
class Cautious:
    """What a Whittle Gaussian, patch recurrence and the spectra of the patches agree on.

    A kernel that is too wide ruins a photo, one too narrow only helps less, and both of the first two
    methods take the softness of a scene for blur, each in its own way. With few patches there are four
    kernels: the Gaussian, that of patch recurrence, the mean of both, and a wavefront fitted to the
    spectra, whole and local, and, with the weight `trust`, to the result of patch recurrence (see
    `local_wavefront`). The likelihood of the spectra of whole patches and of small tiles (see
    `kernel_choice`) chooses among them. Where the Gaussian is narrower than `trusted_px`, most lenses are as
    sharp as it says: then the mean, or the Gaussian if patch recurrence ran more than `apart` times as
    wide, stays unless another is likelier by `sure`. A sharp core with wide wings is.

    From `pooled` patches on the slopes of the scenes average out, the wavefront is all but given by the
    spectra, and patch recurrence only has to tell the phase. How far the wavefront is from
    the kernel of patch recurrence is the best single predictor of the true error of few patches.
    """

    trusted_px: float = 0.95
    apart: float = 2.2
    sure: float = 60.0
    pooled: int = 6
    trust: float = 5.0

    name = "default"
    version = 11

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
            inner, models = [_middle(patch) for patch, _ in kept], [model for _, model in kept]
            support = min(_POOLED_SUPPORT, size)
            if size > _USUAL_SIZE:
                width = Whittle().estimate(inner, models, size=size).diagnostics["width"]
                support = max(support, _support(width, size))
            recurrence = PatchRecurrence(support=support, iterations=_POOLED_ITERATIONS)
            from_recurrence = recurrence.estimate(inner, models, size=size, on_step=_half(on_step, 0))
            return self._agreed(kept, from_recurrence, began, size, on_step)
        gaussian = Whittle().estimate(patches, noise, size=size)
        support = _support(gaussian.diagnostics["width"], size)
        recurrence = PatchRecurrence(support=support, search=QUICK)
        from_recurrence = recurrence.estimate(patches, noise, size=size, on_step=_half(on_step, 0))
        return self._chosen(kept, gaussian, from_recurrence, began, size, on_step, _STARTS)

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
        kept = usable(patches, noise, size)
        if len(kept) >= self.pooled:
            same_phase = replace(reference, reliability=signal_share(kept))
            return self._agreed(kept, same_phase, began, size, on_step)
        support = int(reference.diagnostics.get("support", 21.0))
        recurrence = PatchRecurrence(support=support, iterations=3, search=QUICK)
        from_recurrence = recurrence.estimate_channel(
            patches, noise, reference, reference_patches, size=size, on_step=_half(on_step, 0)
        )
        gaussian = Whittle().estimate(patches, noise, size=size)
        return self._chosen(kept, gaussian, from_recurrence, began, size, on_step, _STARTS_OF_CHANNEL)

    def _agreed(
        self,
        kept: Sequence[tuple[Plane, NoiseModel]],
        from_recurrence: PsfEstimate,
        began: float,
        size: int,
        on_step: StepHook,
    ) -> PsfEstimate:
        """Kernel of the wavefront that many patches agree on."""
        fitted = AberrationFit(size=size).fit(
            SceneSpectra.of(kept), from_recurrence.kernel, _half(on_step, 1)
        )
        kernel = fitted.kernel(size)
        error = min(max(_POOLED_ERROR / math.sqrt(len(kept)), _LEAST_ERROR), 1.0)
        more = {
            "width": rms_width(kernel),
            "disagreement": distance(from_recurrence.kernel, kernel).mtf_rmse,
            "cost": fitted.cost,
        }
        return _reported(from_recurrence, kernel, error, more, began)

    def _chosen(
        self,
        kept: Sequence[tuple[Plane, NoiseModel]],
        gaussian: PsfEstimate,
        from_recurrence: PsfEstimate,
        began: float,
        size: int,
        on_step: StepHook,
        starts: int,
    ) -> PsfEstimate:
        """Kernel of few patches, the likeliest by their spectra."""
        disagreement = distance(from_recurrence.kernel, gaussian.kernel).mtf_rmse
        likelihood = SpectralLikelihood.of(kept)
        fit = AberrationFit(
            weight=self.trust,
            temper=likelihood.temper,
            starts=starts,
            kept=max(starts // 5, 2),
            size=size,
        )
        fitted = fit.fit(likelihood.whole, from_recurrence.kernel, _half(on_step, 1), likelihood.local)
        options = {
            "gaussian": gaussian.kernel,
            "recurrence": from_recurrence.kernel,
            "mean": as_kernel(0.5 * (gaussian.kernel + from_recurrence.kernel)),
            "wavefront": fitted.kernel(size),
        }
        costs = {
            name: likelihood.cost(kernel) + _PER_WIDTH * math.log(max(rms_width(kernel), _PIXEL_SIGMA))
            for name, kernel in options.items()
        }
        costs["wavefront"] += fitted.unusual
        if rms_width(gaussian.kernel) <= self.trusted_px:
            ran = rms_width(from_recurrence.kernel) > self.apart * max(
                rms_width(gaussian.kernel), _PIXEL_SIGMA
            )
            costs["gaussian" if ran else "mean"] -= self.sure
        chosen = min(costs, key=lambda name: costs[name])
        kernel = options[chosen]
        on_step(1, 1)
        apart = distance(from_recurrence.kernel, options["wavefront"]).rel_l2
        more = {
            "gaussian_width": gaussian.diagnostics["width"],
            "slope": gaussian.diagnostics["slope"],
            "disagreement": disagreement,
            "apart": apart,
            "width": rms_width(kernel),
            **{f"chose_{name}": float(name == chosen) for name in options},
        }
        error = predicted_error(
            apart, disagreement, rms_width(gaussian.kernel), gaussian.diagnostics["slope"]
        )
        return _reported(from_recurrence, kernel, error, more, began)


def _reported(
    from_recurrence: PsfEstimate, kernel: Kernel, error: float, more: Mapping[str, float], began: float
) -> PsfEstimate:
    """Return the result of patch recurrence with another kernel, its expected error, and why."""
    return replace(
        from_recurrence,
        kernel=kernel,
        confidence=confidence_of(error),
        predicted_error=error,
        diagnostics={**from_recurrence.diagnostics, **more},
        seconds=time.process_time() - began,
        no_blur=is_no_blur(kernel),
    )


def _support(width: float, size: int) -> int:
    """Odd side of the kernel of patch recurrence, by the width of the Gaussian and the size asked for."""
    reach, least = _REACH[size > _USUAL_SIZE], _LEAST_SUPPORT[size > _USUAL_SIZE]
    return min(max(2 * round(reach * width + 3.0) + 1, least), size)


def _middle(patch: Plane) -> Plane:
    """Cut the middle out: many patches together need not be large."""
    top, left = (max(n - _POOLED_SIDE, 0) // 2 for n in patch.shape)
    return patch[top : top + _POOLED_SIDE, left : left + _POOLED_SIDE]


def _half(on_step: StepHook, which: int) -> StepHook:
    """Report progress as the first or the second half of the work."""
    return lambda done, total: on_step(done + which * total, 2 * total)


def predicted_error(apart: float, disagreement: float, width: float, slope: float) -> float:
    """Expected relative L2 error of the kernel.

    The geometric mean of two log-linear fits to the development half: one to the benchmark's PSFs, which
    sees the first argument only, one to whole fields of lenses, which sees the others.

    Parameters
    ----------
    apart : float
        Relative L2 distance of the kernel of patch recurrence from the fitted wavefront.
    disagreement : float
        Root mean square distance of the MTFs of the Gaussian and patch recurrence.
    width : float
        RMS width of the Gaussian in pixels.
    slope : float
        Slope of the scene's power spectrum that went with it; a steep one hides blur or is it.
    """
    by_kernels = _ERROR["by_distance"] * math.log(max(apart, 1e-3)) + _ERROR["by_disagreement"] * disagreement
    steeper = slope - _ERROR["usual_slope"]
    by_scene = _ERROR["by_width"] * math.log(max(width, 0.2)) + _ERROR["by_slope"] * steeper
    return min(max(math.exp(_ERROR["at_typical"] + by_kernels + by_scene), _LEAST_ERROR), 1.0)
