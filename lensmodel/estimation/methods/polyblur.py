"""Blur of a patch as a Gaussian, by its steepest slopes, `polyblur`.

Source: M. Delbracio, I. Garcia-Dorado, S. Choi, D. Kelly and P. Milanfar, "Polyblur: removing mild blur by
polynomial reblurring", IEEE Trans. Comput. Imaging 7, 2021, section 3. The steepest slope of a sharp
photo, scaled to 0..1, is about the same whatever it shows; a Gaussian blur of standard deviation s
across an edge makes it::

    m = c / sqrt(s² + b²)

The slope is taken in every direction: the direction of the least is that of the widest blur. A scene
without edges across some direction, or without any that are sharp, looks blurred there.

Departures from the paper:

1. `c` and `b` are our own, see `Polyblur`: they belong to the derivative and the noise.
2. Patches of one position give one slope, the median of theirs.
3. Noise makes steep slopes of its own. Derivatives are those of a narrow Gaussian, whose variance is
   part of b², and their maximum is the mean of the steepest few.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.files import fitted
from lensmodel.core.psf import centred, gaussian
from lensmodel.core.types import NoiseModel, Plane, StepHook, ignore_step
from lensmodel.estimation.estimator import PsfEstimate, usable
from lensmodel.estimation.steps.finish import finished

_ANGLES = 6  # directions, as in the paper
_FINE_ANGLES = 30  # to which the six are interpolated, as in the paper
_TAIL = 1e-4  # quantile that stands for black and white, as in the paper
_SATURATED = 0.97  # of white: clipped edges are steeper than the lens made them (chosen)
_STEEPEST = 5  # gradients whose mean stands for the largest: one alone is noise (chosen)
_PROBE_PX = 0.7
"""Pixels of the derivative of a Gaussian: less and noise is the steepest slope, more and sharp edges look
soft (chosen)."""
_VARIANCES = (0.09, 16.0)  # squared pixels, as in the paper (sigma 0.3 to 4)

_LAW: Final[Mapping[str, float]] = fitted("estimation")["polyblur"]

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Polyblur:
    """Anisotropic Gaussian of the widths that the steepest slopes tell.

    Parameters
    ----------
    c, b : float
        Of the law above, b in px; see `data/README.md`.
    """

    c: float = _LAW["c"]
    b: float = _LAW["b"]

    name = "polyblur"
    version = 1

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
        slopes = []
        for done, (patch, _) in enumerate(kept, start=1):
            slopes.append(directional_slopes(patch))
            on_step(done, len(kept))
        slope: Floats = np.median(slopes, axis=0)
        fine = _interpolated(slope)
        widest = int(fine.argmin())
        angle = math.pi * widest / _FINE_ANGLES
        across = fine[(widest + _FINE_ANGLES // 2) % _FINE_ANGLES]
        variances = [self.variance(float(fine[widest])), self.variance(float(across))]
        # Angles run from the rows' direction towards the columns'.
        along = np.array([math.cos(angle), math.sin(angle)])
        other = np.array([-along[1], along[0]])
        covariance = variances[0] * np.outer(along, along) + variances[1] * np.outer(other, other)
        spread = float(np.mean(np.std(np.log(slopes), axis=0))) if len(slopes) > 1 else 0.0
        # A slope near its ceiling says little: d log s / d log m grows as (s² + b²) / s².
        mean = 0.5 * (variances[0] + variances[1])
        gain = (mean + self.b**2) / mean
        return finished(
            centred(gaussian(max(size, 55), covariance)),
            kept,
            size=size,
            error=math.hypot(0.5, 0.1 * gain + spread),
            diagnostics={
                "sigma": math.sqrt(variances[0]),
                "rho": math.sqrt(variances[1]),
                "angle": angle,
                "gain": gain,
                "spread": spread,
            },
            began=began,
        )

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
        """Estimate another channel of the same patches; it is cheap enough to start anew."""
        return self.estimate(patches, noise, size=size, rng=rng, on_step=on_step)

    def variance(self, slope: float) -> float:
        """Variance in px² of the blur that leaves such a slope, within 0.3 to 4 px squared."""
        return float(np.clip((self.c / max(slope, 1e-9)) ** 2 - self.b**2, *_VARIANCES))


def directional_slopes(patch: Plane) -> Floats:
    """Steepest slope of a patch, scaled to 0..1, in six directions from the rows' to the columns'.

    Returns
    -------
    ndarray, shape (6,)
        Per pixel; direction i is at i * 30 degrees.
    """
    values = patch.astype(np.float64)
    low, high = np.quantile(values, (_TAIL, 1.0 - _TAIL))
    scaled = np.clip((values - low) / max(float(high - low), 1e-9), 0.0, 1.0)
    row, col = (ndimage.gaussian_filter(scaled, _PROBE_PX, order=order) for order in ((1, 0), (0, 1)))
    clipped = scaled > _SATURATED
    angles = np.pi * np.arange(_ANGLES) / _ANGLES
    slopes = []
    for angle in angles:
        slope = np.where(clipped, 0.0, np.abs(math.cos(angle) * row + math.sin(angle) * col))
        slopes.append(float(np.mean(np.partition(slope, -_STEEPEST, axis=None)[-_STEEPEST:])))
    return np.maximum(slopes, 1e-6)


def _interpolated(slopes: Floats) -> Floats:
    """Periodic cubic through the slopes at 30 angles; Keys, 1981."""
    step = _FINE_ANGLES // _ANGLES
    fine = np.empty(_FINE_ANGLES)
    for i in range(_FINE_ANGLES):
        at, t = divmod(i, step)
        x = t / step
        before, value, after, far = (slopes[(at + d) % _ANGLES] for d in (-1, 0, 1, 2))
        cubic = (
            -before + 3 * value - 3 * after + far,
            2 * before - 5 * value + 4 * after - far,
            after - before,
        )
        fine[i] = value + 0.5 * x * (cubic[2] + x * (cubic[1] + x * cubic[0]))
    return fine
