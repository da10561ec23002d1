"""Re-blur: the result, blurred again, has to be the photo but for its noise."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import blocks
from lensmodel.audit.base import Evidence, sigma_of
from lensmodel.blur import UniformBlur
from lensmodel.types import Plane, Planes

_LIMIT: Final = 6.0


def misfit(original: Planes, corrected: Planes, evidence: Evidence) -> Plane:
    """Severity of what is left of the photo after the blurred result is taken off, in the noise's measure.

    Without PSFs nothing can be said: zero everywhere.
    """
    shape = (original.shape[1], original.shape[2])
    worst = np.zeros(shape, dtype=np.float32)
    if evidence.blurs is None:
        return worst
    for c, (x, y) in enumerate(zip(corrected, original, strict=True)):
        again = reblurred(x, evidence.blurs[c])
        variance = np.square(sigma_of(evidence.noise[c], y))
        error = evidence.psf_errors[c]
        if error > 0.0:
            variance = variance + np.float32(error * error) * np.square(again - x)
        counted = usable(y, evidence.blurs[c], evidence.clip[c], evidence.measured[c])
        power = np.where(counted, np.square(y - again) / variance, np.float32(0.0))
        total = blocks.around(blocks.sums(power))
        count = blocks.around(blocks.sums(counted))
        rms = np.sqrt(total / np.maximum(count, np.float32(1.0)))
        np.maximum(worst, blocks.to_pixels((rms / _LIMIT).astype(np.float32), shape), out=worst)
    return worst


def reblurred(plane: Plane, blur: UniformBlur) -> Plane:
    """Blur a plane of the frame, continued beyond its rim by the rim's own light."""
    return blur.forward(np.pad(plane, blur.reach, mode="edge"))


def usable(
    plane: Plane, blur: UniformBlur, clip: float, measured: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Pixels that were measured, are not clipped and lie inside the rim, which draws on the unknown."""
    rim = min(blur.reach, (min(plane.shape) - 1) // 2)
    counted = np.zeros(plane.shape, dtype=bool)
    counted[rim : plane.shape[0] - rim, rim : plane.shape[1] - rim] = True
    counted &= plane < 0.98 * clip
    return counted if measured is None else counted & measured
