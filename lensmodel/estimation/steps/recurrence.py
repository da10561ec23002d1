"""Pieces of internal patch recurrence: pyramids, matching across scales, the image step.

In a sharp picture small patches recur unchanged in a smaller copy of it; blur breaks that, and the
smaller copy is sharper in its own pixels. Its patches are examples of what the sharp picture looks
like. Source: T. Michaeli and M. Irani, "Blind deblurring using internal patch recurrence",
ECCV 2014, section 3.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.core.psf import otf

ALPHA = 4.0 / 3.0
"""Ratio between levels: smaller and copies are hardly sharper, larger and patches do not recur."""

SIDE = 5  # pixels: Michaeli and Irani 2014, sec. 5
_COMPONENTS = 10
"""Principal ones by which neighbours are found: they hold nearly all of a patch's power, more slow the search
(chosen)."""
_NEIGHBOURS = 5  # per patch: one alone may be chance, further ones are less alike (chosen)

Image = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Search:
    """How thoroughly to look for matches.

    Parameters
    ----------
    stride : int
        From patch to patch, pixels; up to `SIDE` every pixel is in some patch.
    examples : int
        About so many patches of the smaller copy are looked at, evenly spread.
    tolerance : float
        By what share a match may be farther than the nearest one.
    """

    stride: int = 2
    examples: int = 1 << 30
    tolerance: float = 0.5


THOROUGH = Search()
QUICK = Search(stride=3, examples=10_000, tolerance=2.0)
"""Four times as fast; kernels differ by about a seventh of their norm and are about as right."""


def resized_image(image: Image, shape: tuple[int, int]) -> Image:
    """Resize by cubic splines, anti-aliased when it shrinks (Gaussian of sigma (ratio - 1) / 2)."""
    if image.shape == shape:
        return image
    ratios = [have / want for have, want in zip(image.shape, shape, strict=True)]
    sigma = [max(ratio - 1.0, 0.0) / 2.0 for ratio in ratios]
    smooth = ndimage.gaussian_filter(image, sigma, mode="mirror") if max(sigma) > 0 else image
    places = [(np.arange(want) + 0.5) * ratio - 0.5 for want, ratio in zip(shape, ratios, strict=True)]
    coefficients = ndimage.spline_filter(smooth, order=3, mode="mirror")
    grid = np.meshgrid(*places, indexing="ij")
    return ndimage.map_coordinates(coefficients, grid, order=3, mode="mirror", prefilter=False)


def level_shape(shape: tuple[int, int], level: int) -> tuple[int, int]:
    """Shape of a pyramid level; 0 is the finest."""
    factor = ALPHA**-level
    return max(round(shape[0] * factor), 24), max(round(shape[1] * factor), 24)


@lru_cache(maxsize=256)
def noise_gain(shape: tuple[int, int], target: tuple[int, int]) -> float:
    """Standard deviation that white noise of unit variance keeps when resampled."""
    white = np.random.default_rng(0).standard_normal(shape)
    return float(resized_image(white, target)[4:-4, 4:-4].std())


def recur(x: Image, noise: float, bandwidth: float, search: Search = THOROUGH) -> Image:
    """Replace every patch by the mean of its best matches in the smaller copy of the picture.

    z = (1/M²) sum_j Q_j' sum_i w_ij R_i x^a,  w_ij ~ exp(-|Q_j x - R_i x^a|² / (2 h²))

    Patches are compared without their mean, which is kept. Flat ones become their mean.

    Parameters
    ----------
    x : ndarray, shape (H, W)
    noise : float
        Standard deviation of the noise of x.
    bandwidth : float
        h, per pixel in the units of x.
    search : Search
    """
    stride = search.stride
    smaller = resized_image(x, (round(x.shape[0] / ALPHA), round(x.shape[1] / ALPHA)))
    examples = sliding_window_view(smaller, (SIDE, SIDE)).reshape(-1, SIDE * SIDE)
    examples = (examples - examples.mean(axis=1, keepdims=True)).astype(np.float32)
    flat = max(2.0 * noise * noise, 1e-5)
    examples = examples[(examples**2).mean(axis=1) > 0.5 * flat]

    windows = sliding_window_view(x, (SIDE, SIDE))[::stride, ::stride]
    rows, cols = windows.shape[:2]
    wanted = windows.reshape(-1, SIDE * SIDE)
    mean = wanted.mean(axis=1, keepdims=True)
    wanted = (wanted - mean).astype(np.float32)
    textured = (wanted**2).mean(axis=1) > flat
    matches = np.zeros_like(wanted)
    if examples.shape[0] > 4 * _NEIGHBOURS and textured.any():
        matches[textured] = _matches(wanted[textured], examples, bandwidth, search)
    matches += mean

    total, count = np.zeros_like(x), np.zeros_like(x)
    patches = matches.reshape(rows, cols, SIDE, SIDE)
    for i in range(SIDE):
        for j in range(SIDE):
            place = (slice(i, i + stride * rows, stride), slice(j, j + stride * cols, stride))
            total[place][:rows, :cols] += patches[:, :, i, j]
            count[place][:rows, :cols] += 1.0
    return np.where(count > 0, total / np.maximum(count, 1.0), x)


def _matches(
    wanted: NDArray[np.float32], examples: NDArray[np.float32], bandwidth: float, search: Search
) -> NDArray[np.float32]:
    examples = examples[:: -(-len(examples) // search.examples)]
    _, basis = np.linalg.eigh(examples.T @ examples)
    basis = basis[:, -_COMPONENTS:]
    tree = scipy.spatial.cKDTree(examples @ basis, leafsize=32, balanced_tree=False, compact_nodes=False)
    index = tree.query(wanted @ basis, k=_NEIGHBOURS, eps=search.tolerance)[1]
    near = examples[index]
    gap = ((near - wanted[:, None, :]) ** 2).sum(axis=2)
    weight = np.exp(-(gap - gap.min(axis=1, keepdims=True)) / (2.0 * bandwidth**2))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkp->np", weight, near)


def blend(y: Image, kernel: NDArray[np.float64], z: Image, beta: float) -> tuple[Image, Image]:
    """Image step: x = argmin |y - k * x|² + beta |x - z|², by Fourier on a mirrored frame.

    X = (conj(K) Y + beta Z) / (|K|² + beta)

    Returns
    -------
    x : ndarray, shape (H, W)
    filter : ndarray, shape (n, n)
        Impulse response of conj(K) / (|K|² + beta), by which the noise of y enters x; origin at [0, 0].
    """
    pad = kernel.shape[0]
    rows, cols = (int(fft.next_fast_len(n + 2 * pad, real=True)) for n in y.shape)
    shape = (rows, cols)
    after = [(pad, n - m - pad) for n, m in zip(shape, y.shape, strict=True)]
    transfer = otf(kernel, shape)
    power = np.abs(transfer) ** 2 + beta
    spectrum = np.conj(transfer) * fft.rfft2(np.pad(y, after, mode="symmetric"))
    spectrum += beta * fft.rfft2(np.pad(z, after, mode="symmetric"))
    x = fft.irfft2(spectrum / power, s=shape)[pad : pad + y.shape[0], pad : pad + y.shape[1]]
    side = int(fft.next_fast_len(4 * kernel.shape[0], real=True))
    small = otf(kernel, (side, side))
    return x, fft.irfft2(np.conj(small) / (np.abs(small) ** 2 + beta), s=(side, side))
