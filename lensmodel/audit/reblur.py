"""Re-blur: the result, blurred again, has to be the photo but for its noise."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.audit import blocks
from lensmodel.audit.base import Pair, Severity
from lensmodel.audit.limits import LIMITS
from lensmodel.blur import UniformBlur
from lensmodel.blur.uniform import fast_shape
from lensmodel.types import Plane

_COARSE: Final = 0.5
"""Weight of what is left in the means over blocks: there are fewer of them, so that chance plays more."""
MODEL_ERROR: Final = 0.1
"""Share of what the blur changes that may be left on top of the noise: PSFs change within a tile, and
a prior gives way at edges."""
_CLIPPED: Final = 0.98
_GLOW: Final = 0.005
"""Share of its light that a clipped pixel sends to another from which on that tells nothing: the file holds
no more than white of a lamp, and a lamp is up to some hundred times brighter (chosen)."""


def misfit(pair: Pair) -> Severity:
    """Severity of what is left of the photo y after the blurred result is taken off.

    With k the PSF, whose relative error is e, and x the result::

        r = (y - k * x) / sqrt( sigma² + e² (x - k * x)² )

    where the photo was measured and did not clip. Two figures of it are judged around each place: the root
    mean square, and that of the means over blocks, which is as small only if r is white. Without PSFs
    nothing can be said: zero everywhere.
    """
    evidence = pair.evidence
    worst: NDArray[np.float32] = np.zeros((1, 1), dtype=np.float32)
    if evidence.blurs is None:
        return Severity.of_blocks(worst)
    for c, blur in enumerate(evidence.blurs):
        x, y = pair.corrected[c], pair.original[c]
        again = reblurred(x, blur)
        error = np.float32(max(evidence.psf_errors[c], MODEL_ERROR))
        left = (y - again) / np.sqrt(np.square(pair.sigma[c]) + np.square(error * (x - again)))
        counted = usable(y, blur, evidence.clip[c], evidence.measured[c])
        left = np.where(counted, left, np.float32(0.0))
        number = np.maximum(blocks.sums(counted), np.float32(1.0)).astype(np.float32)
        count = np.maximum(blocks.around(number), np.float32(1.0))
        fine = np.sqrt(blocks.windows(np.square(left)) / count)
        means = np.square(blocks.sums(left)) / number
        coarse = np.sqrt(blocks.around(means.astype(np.float32)) / blocks.around(np.ones_like(number)))
        figures = np.maximum(fine, np.float32(_COARSE) * coarse)
        worst = np.maximum(worst, figures)
    return Severity.of_blocks(worst / np.float32(LIMITS["re-blur"]))


def reblurred(plane: Plane, blur: UniformBlur) -> Plane:
    """Blur a plane as if it went on at its other side: right but for a rim as wide as the blur reaches."""
    shape = fast_shape(plane.shape)
    if blur.offset == (0.0, 0.0) and blur.kernel.shape[0] <= min(shape):
        kernel = np.zeros(shape, dtype=np.float32)
        side = blur.kernel.shape[0]
        kernel[:side, :side] = blur.kernel
        transfer = fft.rfft2(np.roll(kernel, (-(side // 2), -(side // 2)), axis=(0, 1)))
    else:
        transfer = blur.spectrum(shape)
    blurred = fft.irfft2(fft.rfft2(plane, shape) * transfer, shape)
    return np.asarray(blurred[: plane.shape[0], : plane.shape[1]], dtype=np.float32)


def usable(
    plane: Plane, blur: UniformBlur, clip: float, measured: NDArray[np.bool_] | None
) -> NDArray[np.bool_]:
    """Pixels that were measured, show no clipped light and lie inside the rim, which draws on the unknown."""
    rim = min(blur.reach, (min(plane.shape) - 1) // 2)
    counted = np.zeros(plane.shape, dtype=bool)
    counted[rim : plane.shape[0] - rim, rim : plane.shape[1] - rim] = True
    clipped = plane >= _CLIPPED * clip
    if clipped.any():
        counted &= reblurred(clipped.astype(np.float32), blur) < _GLOW
    return counted if measured is None else counted & measured
