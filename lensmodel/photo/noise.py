"""Noise of a photo, measured on the photo itself."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from lensmodel.core.types import NoiseModel, Plane, block_means

BLOCK: Final = 8  # side of the blocks in pixels: flat places of this size exist in almost any photo
GRAIN: Final = 4  # side of blocks whose means tell of coarse grain: fine grain averages out there (chosen)
_GRAIN_LEVELS: Final = (0.25, 0.5, 0.75)  # shares of the pixels that are darker (chosen)
_BINS: Final = 24  # levels at most, from dark to bright (chosen): a line of two terms needs no more
_FLAT_SHARE: Final = 0.15  # share of the blocks of one level, the least textured, that count (chosen)
_MIN_BLOCKS: Final = 24  # of a level (chosen): 1,536 pixels tell a standard deviation within some percent
_ENOUGH_PIXELS: Final = 3_000_000  # of a plane (chosen): more would not change the fit
_MAD_TO_SIGMA: Final = 1.4826  # of a normal distribution: 1 / its upper quartile
_CUT: Final = 1.5  # standard deviations beyond which a difference counts as no more than that: see `_scale`
_CUT_POWER: Final = 0.778465  # mean of min(z^2, _CUT^2) of a standard normal z

# The difference of two Laplacians: unit gain for white noise, blind to planes and to edges
# along the axes. J. Immerkaer, "Fast noise variance estimation", CVIU 64, 1996, eq. 2.
_HIGH_PASS: Final = np.outer([1.0, -2.0, 1.0], [1.0, -2.0, 1.0]).astype(np.float32) / np.float32(6.0)


def estimate_noise(
    plane: Plane, clip: float = 1.0, step: float = 0.0, codes: NDArray[np.floating] | None = None
) -> NoiseModel:
    """Fit var(y) = shot * y + read to the flat places of a plane of linear light whose noise is white.

    A variance is no less than what rounding makes: by the smallest `step` between the file's numbers near
    black, or by the light of each of its `codes` of 8 bits. A. Foi, M. Trimeche, V. Katkovnik, K. Egiazarian,
    "Practical Poissonian-Gaussian noise modeling and fitting for single-image raw-data", IEEE TIP 17, 2008.
    """
    levels, variances, counts = _levels(_sampled(np.asarray(plane, dtype=np.float32)), clip).T
    if codes is not None and len(levels):
        variances = np.maximum(variances, np.interp(levels, codes, np.gradient(codes) ** 2 / 12.0))
    if len(levels) < 2:
        return NoiseModel(0.0, max(float(variances.sum()), step * step / 12.0))
    slope, offset = _line(levels, variances, counts)
    return NoiseModel(slope, max(offset, step * step / 12.0))


def coding_noise(coarseness: float, curve: NDArray[np.floating]) -> NoiseModel | None:
    """Noise that a JPEG's rounding of cosine coefficients makes where detail is: step^2 / 12 in each."""
    if not coarseness:
        return None
    # the middle step speaks for all: the coarsest are those of frequencies of which a lens leaves little
    codes = curve[::257]
    levels, widths = codes[1:-1].astype(np.float64), np.gradient(codes)[1:-1]
    variances = np.maximum((coarseness * widths) ** 2 / 12.0, 1e-16)
    design = np.stack([levels, np.ones_like(levels)], axis=1) / variances[:, None]
    return NoiseModel(*map(float, optimize.nnls(design, np.ones_like(levels))[0]))


def graininess(plane: Plane, noise: NoiseModel, clip: float = 1.0) -> float:
    """Variance of means over 4 x 4 flat pixels, times 16, over that of the pixels: 1 for white noise.

    Demosaicing leaves 6 to 9, a camera's own denoising 40 and more.
    """
    fine = _sampled(np.asarray(plane, dtype=np.float32))
    levels = np.quantile(fine[::GRAIN, ::GRAIN], _GRAIN_LEVELS)
    single = noise.variance(levels)
    several = estimate_noise(block_means(fine, GRAIN), clip).variance(levels)
    usable = (single > 0.0) & (several > 0.0)
    return float(np.exp(np.log(GRAIN**2 * several[usable] / single[usable]).mean())) if usable.any() else 1.0


def _sampled(plane: Plane) -> Plane:
    """Evenly spaced bands of rows of a large plane: more pixels would not change the fit."""
    band = 8 * BLOCK
    every = plane.size // _ENOUGH_PIXELS + 1
    bands = [plane[row : row + band] for row in range(0, plane.shape[0] - band + 1, every * band)]
    return np.concatenate(bands) if every > 1 and bands else plane


def _levels(plane: Plane, clip: float) -> NDArray[np.float64]:
    """Mean, variance and number of pixels of each level that was seen flat, shape (n, 3).

    Texture is judged on the low-passed plane and noise on the high-passed one, so that the choice does not
    favour blocks whose noise happens to be small.
    """
    low = ndimage.gaussian_filter(plane, 2.0, mode="nearest", truncate=3.0)
    blocks, high = _blocks(plane), _blocks(ndimage.convolve(plane, _HIGH_PASS, mode="nearest"))
    mean, texture = blocks.mean(axis=1, dtype=np.float64), _blocks(low).std(axis=1, dtype=np.float64)
    usable = (blocks.max(axis=1) < 0.98 * clip) & ((blocks <= 0).mean(axis=1) < 0.02)
    # Areas without any change, painted or clipped by a program, tell nothing about the sensor.
    usable = np.flatnonzero(usable & (np.ptp(high, axis=1) > 0))
    order, rows = usable[np.argsort(mean[usable])], list[tuple[float, float, int]]()
    levels = max(1, min(_BINS, len(order) // (4 * _MIN_BLOCKS)))
    for part in np.array_split(order, levels) if len(order) >= _MIN_BLOCKS else []:
        keep = max(_MIN_BLOCKS, int(_FLAT_SHARE * len(part)))
        flat = part[np.argsort(texture[part])[:keep]]
        sigma = _scale(high[flat])
        if sigma > 0:  # else most differences are exactly 0: rounding or compression ate the noise
            rows.append((float(mean[flat].mean()), sigma * sigma, high[flat].size))
    return np.array(rows, dtype=np.float64).reshape(-1, 3)


def _scale(values: NDArray[np.float32]) -> float:
    """Robust standard deviation: the s for which the mean of min(v^2, (1.5 s)^2) is that of a normal v.

    P. J. Huber, "Robust estimation of a location parameter", Ann. Math. Stat. 35, 1964, proposal 2.
    """
    # a median of a camera's 8-bit differences jumps by a factor of 2 where the noise is half a step
    power = np.square(values, dtype=np.float32).ravel()
    sigma = _MAD_TO_SIGMA * float(np.sqrt(np.median(power)))
    for _ in range(20):
        before, clipped = sigma, np.minimum(power, np.float32((_CUT * sigma) ** 2))
        sigma = float(np.sqrt(clipped.mean(dtype=np.float64) / _CUT_POWER))
        if abs(sigma - before) <= 1e-3 * before:
            break
    return sigma


def _blocks(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    rows, cols = (side // BLOCK for side in plane.shape)
    cut = plane[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK)
    return np.ascontiguousarray(cut.swapaxes(1, 2)).reshape(rows * cols, BLOCK * BLOCK)


def _line(
    levels: NDArray[np.float64], variances: NDArray[np.float64], counts: NDArray[np.float64]
) -> tuple[float, float]:
    """Slope and offset of a line through the levels, robust against those where no place is flat."""
    # The error of a variance is proportional to the variance, so the weights are count / var^2; texture only
    # ever adds, so points above the line lose weight, those below do not. `chance` is three standard errors
    # of a variance from the median deviation of pixels, every second independent after the high-pass.
    chance = 3.0 * np.sqrt(2.7 * 2.0 * 2.0 / counts)
    robust, model = np.ones_like(levels), np.maximum(variances, 1e-16)
    slope = offset = 0.0
    for _ in range(12):
        weight = np.sqrt(counts * robust) / np.maximum(model, 1e-16)
        slope, offset = optimize.nnls(np.stack([levels * weight, weight], axis=1), variances * weight)[0]
        model = np.maximum(slope * levels + offset, 1e-16)
        robust = np.minimum(1.0, chance / np.maximum((variances - model) / model, chance)) ** 2
    return float(slope), float(offset)
