"""Re-blur: the result, blurred again, must equal the photo except for its noise."""

from __future__ import annotations

from types import ModuleType
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Plane
from lensmodel.correction.audit import blocks
from lensmodel.correction.audit.check import Severity, TilePair
from lensmodel.correction.audit.tolerances import LIMITS
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.blur.uniform import fast_shape

_COARSE: Final = 0.5
"""Weight of the means of the residual over blocks: they are fewer, so chance plays a larger part (chosen)."""
MODEL_ERROR: Final = 0.1
"""Share of what the blur changes that may remain on top of the noise: PSFs change within a tile, and a prior
gives way at edges (chosen)."""
_CLIPPED: Final = 0.98
"""Share of the clipping level at and above which a pixel counts as clipped (chosen: noise and demosaicing
leave clipped light a little below the level; much lower, bright light that was measured would not be
checked)."""
_GLOW: Final = 0.005
"""Share of the light of a clipped pixel; a pixel that receives more of it does not count: of a lamp the file
holds no more than white, and a lamp is up to a hundred times brighter or so (chosen)."""


def misfit(pair: TilePair) -> Severity:
    """Severity of the residual of the photo y less the blurred result.

    With k the PSF, whose relative error is e, and x the result::

        r = (y - k * x) / sqrt( sigma² + e² (x - k * x)² )

    where the photo was measured and did not clip. Two figures of it are judged around each place: the root
    mean square, and that of the means over blocks, which is as small only if r is white. Without PSFs
    it is zero everywhere.
    """
    evidence = pair.evidence
    if evidence.blurs is None:
        return Severity.none()
    worst: NDArray[np.float32] = np.zeros((1, 1), dtype=np.float32)
    for c, blur in enumerate(evidence.blurs):
        square, total, number = _sums(pair, c, blur)
        number = np.maximum(number, np.float32(1.0))
        count = np.maximum(blocks.around(number), np.float32(1.0))
        fine = np.sqrt(blocks.around(square) / count)
        means = np.square(total) / number
        coarse = np.sqrt(blocks.around(means.astype(np.float32)) / blocks.around(np.ones_like(number)))
        figures = np.maximum(fine, np.float32(_COARSE) * coarse)
        worst = np.maximum(worst, figures)
    return Severity.of_blocks(worst / np.float32(LIMITS["re-blur"]))


def _sums(pair: TilePair, channel: int, blur: UniformBlur) -> NDArray[np.float32]:
    """Sums over blocks of r², r and the number of pixels that count."""
    evidence, sigma = pair.evidence, pair.sigma[channel]
    x, y = pair.corrected[channel], pair.original[channel]
    error = max(evidence.psf_errors[channel], MODEL_ERROR)
    counted = usable_pixels(y, blur, evidence.clip[channel], evidence.measured[channel])
    if pair.loops is not None:
        sums, shape = blocks.empty(3, pair.shape), _grid(pair.shape, blur)
        spectrum = _transfer(blur, shape, pair.loops)
        pair.loops.left_over(y, x, sigma, spectrum, shape[1], error, counted, blocks.SIDE, sums)
        return sums
    blurred = reblurred(x, blur)
    residual = (y - blurred) / np.sqrt(np.square(sigma) + np.square(np.float32(error) * (x - blurred)))
    residual = np.where(counted, residual, np.float32(0.0))
    return np.stack([blocks.sums(values) for values in (np.square(residual), residual, counted)])


def _grid(shape: tuple[int, ...], blur: UniformBlur) -> tuple[int, int]:
    """A size that transforms quickly and holds both the plane and the kernel."""
    side = blur.kernel.shape[0]
    return fast_shape(tuple(max(extent, side) for extent in shape))


def _transfer(blur: UniformBlur, shape: tuple[int, int], loops: ModuleType) -> NDArray[np.complex64]:
    if blur.offset != (0.0, 0.0):
        return blur.spectrum(shape)
    spectrum = np.empty((shape[0], shape[1] // 2 + 1), dtype=np.complex64)
    loops.transfer(blur.kernel.astype(np.float32), spectrum, shape[1])
    return spectrum


def reblurred(plane: Plane, blur: UniformBlur) -> Plane:
    """Blur a plane periodically: correct except for a rim as wide as the reach of the blur."""
    shape = _grid(plane.shape, blur)
    if blur.offset == (0.0, 0.0):
        kernel = np.zeros(shape, dtype=np.float32)
        side = blur.kernel.shape[0]
        kernel[:side, :side] = blur.kernel
        transfer = fft.rfft2(np.roll(kernel, (-(side // 2), -(side // 2)), axis=(0, 1)))
    else:
        transfer = blur.spectrum(shape)
    blurred = fft.irfft2(fft.rfft2(plane, shape) * transfer, shape)
    return np.asarray(blurred[: plane.shape[0], : plane.shape[1]], dtype=np.float32)


def usable_pixels(
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
