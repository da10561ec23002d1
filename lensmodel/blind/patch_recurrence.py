"""Blind deblurring by internal patch recurrence, `michaeli-irani`: the paper's estimator.

In a sharp picture small patches recur unchanged in a smaller copy of it; blur breaks that, and the patches of
the smaller copy are examples of what the sharp picture looks like. Source: T. Michaeli and M. Irani, "Blind
deblurring using internal patch recurrence", ECCV 2014, section 3.

One addition, without which the method collapses on photos in linear light: the noise of y is in the latent
image too (errors in variables), and its known expectation is taken off the normal equations of the kernel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
import scipy
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.blind.estimator import PsfEstimate, finished, usable
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.numerics import nonnegative_least_squares
from lensmodel.core.psf import as_kernel, delta, otf, resized
from lensmodel.core.types import Kernel, NoiseModel, Plane

_BORDER = 3  # pixels left out along the rim: fewer patches overlap there (chosen)
_ERROR: Final = 0.61  # expected relative L2: the mean on 24 patches of `lensmodel bench blind`
ALPHA = 4.0 / 3.0  # between levels: smaller and copies are hardly sharper, larger and patches do not recur
SIDE = 5  # pixels: Michaeli and Irani 2014, sec. 5
_COMPONENTS = 10  # by which neighbours are found: they hold nearly all of a patch's power (chosen)
_NEIGHBOURS = 5  # per patch: one alone may be chance, further ones are less alike (chosen)
_LEAST_SIDE = 5  # pixels of a kernel on the coarsest level (chosen)
_STRIDE = 2  # pixels from patch to patch: every pixel is in several (chosen)
_TOLERANCE = 0.5  # by what share a match may be farther than the nearest one: exact search is slower (chosen)

Image = NDArray[np.float64]


def resized_image(image: Image, shape: tuple[int, int]) -> Image:
    """Resize by cubic splines, anti-aliased when it shrinks (Gaussian of sigma (ratio - 1) / 2)."""
    if image.shape == shape:
        return image
    ratios = [have / want for have, want in zip(image.shape, shape, strict=True)]
    sigma = [max(ratio - 1.0, 0.0) / 2.0 for ratio in ratios]
    smooth = ndimage.gaussian_filter(image, sigma, mode="mirror") if max(sigma) > 0 else image
    return ndimage.zoom(smooth, [1.0 / ratio for ratio in ratios], mode="mirror", grid_mode=True)


def level_shape(shape: tuple[int, int], level: int) -> tuple[int, int]:
    """Shape of a pyramid level; 0 is the finest."""
    factor = ALPHA**-level
    return max(round(shape[0] * factor), 24), max(round(shape[1] * factor), 24)


@lru_cache(maxsize=256)
def noise_gain(shape: tuple[int, int], target: tuple[int, int]) -> float:
    """Standard deviation that white noise of unit variance keeps when resampled."""
    white = np.random.default_rng(0).standard_normal(shape)
    return float(resized_image(white, target)[4:-4, 4:-4].std())


def recur(x: Image, noise: float, bandwidth: float) -> Image:
    """Replace patches by the means of their best matches in the smaller copy of the picture.

    z = (1/M²) sum_j Q_j' sum_i w_ij R_i x^a,  w_ij ~ exp(-|Q_j x - R_i x^a|² / (2 h²))
    """
    smaller = resized_image(x, (round(x.shape[0] / ALPHA), round(x.shape[1] / ALPHA)))
    examples = sliding_window_view(smaller, (SIDE, SIDE)).reshape(-1, SIDE * SIDE)
    examples = (examples - examples.mean(axis=1, keepdims=True)).astype(np.float32)
    flat = max(2.0 * noise * noise, 1e-5)
    examples = examples[(examples**2).mean(axis=1) > 0.5 * flat]

    windows = sliding_window_view(x, (SIDE, SIDE))[::_STRIDE, ::_STRIDE]
    rows, cols = windows.shape[:2]
    wanted = windows.reshape(-1, SIDE * SIDE)
    mean = wanted.mean(axis=1, keepdims=True)
    wanted = (wanted - mean).astype(np.float32)
    textured = (wanted**2).mean(axis=1) > flat
    matches = np.zeros_like(wanted)
    if examples.shape[0] > 4 * _NEIGHBOURS and textured.any():
        matches[textured] = _matches(wanted[textured], examples, bandwidth)
    matches += mean

    total, count = np.zeros_like(x), np.zeros_like(x)
    patches = matches.reshape(rows, cols, SIDE, SIDE)
    for i in range(SIDE):
        for j in range(SIDE):
            place = (slice(i, i + _STRIDE * rows, _STRIDE), slice(j, j + _STRIDE * cols, _STRIDE))
            total[place][:rows, :cols] += patches[:, :, i, j]
            count[place][:rows, :cols] += 1.0
    return np.where(count > 0, total / np.maximum(count, 1.0), x)


def _matches(
    wanted: NDArray[np.float32], examples: NDArray[np.float32], bandwidth: float
) -> NDArray[np.float32]:
    _, basis = np.linalg.eigh(examples.T @ examples)
    basis = basis[:, -_COMPONENTS:]
    tree = scipy.spatial.cKDTree(examples @ basis, leafsize=32, balanced_tree=False, compact_nodes=False)
    index = tree.query(wanted @ basis, k=_NEIGHBOURS, eps=_TOLERANCE)[1]
    near = examples[index]
    gap = ((near - wanted[:, None, :]) ** 2).sum(axis=2)
    weight = np.exp(-(gap - gap.min(axis=1, keepdims=True)) / (2.0 * bandwidth**2))
    weight /= weight.sum(axis=1, keepdims=True)
    return np.einsum("nk,nkp->np", weight, near)


def blend(y: Image, kernel: NDArray[np.float64], z: Image, beta: float) -> tuple[Image, Image]:
    """Image step: x = argmin |y - k * x|² + beta |x - z|², by Fourier on a mirrored frame.

    X = (conj(K) Y + beta Z) / (|K|² + beta); also the impulse response of conj(K) / (|K|² + beta), by which
    the noise of y enters x, origin at [0, 0].
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


def window_products(
    x: NDArray[np.float64], y: NDArray[np.float64], side: int
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Sums of products of windows of x with one another and with y, means taken off.

    With offsets a and b in reading order; x should be about zero mean, sums are of single precision::

        gram(a, b) = sum_p (x(p + a) - mean)(x(p + b) - mean)
        cross(a)   = sum_p (x(p + a) - mean)(y(p) - mean)
    """
    n, m = y.shape
    values = x.astype(np.float32)
    windows = np.ascontiguousarray(sliding_window_view(values, side, axis=1))  # (n + side - 1, m, side)
    gram = np.empty((side, side, side, side))
    for lag in range(side):
        for row, products in enumerate(_of_rows(windows, lag, n)):
            gram[row, :, row + lag, :] = products
            gram[row + lag, :, row, :] = products.T
    target = (y - y.mean()).astype(np.float32).ravel()
    cross = np.stack([target @ windows[row : row + n].reshape(-1, side) for row in range(side)])
    by_column = np.add.accumulate(windows.sum(axis=1, dtype=np.float64), axis=0)
    means = by_column[n - 1 :].copy()
    means[1:] -= by_column[: side - 1]
    flat = means.ravel() / (n * m)
    return gram.reshape(side * side, -1) - n * m * np.outer(flat, flat), cross.astype(np.float64).ravel()


def _of_rows(windows: NDArray[np.float32], lag: int, n: int) -> NDArray[np.float64]:
    """Sums over the n rows from t on of windows[t]' windows[t + lag], shape (side - lag, side, side)."""
    side = windows.shape[2]
    more = side - lag - 1  # sums after the first, each of which a row leaves and a row enters
    first = windows[:n].reshape(-1, side).T @ windows[lag : n + lag].reshape(-1, side)
    leaving, entering = (
        np.matmul(windows[t : t + more].transpose(0, 2, 1), windows[t + lag : t + lag + more]) for t in (0, n)
    )
    changes = entering.astype(np.float64) - leaving
    return np.add.accumulate(np.concatenate([first[None].astype(np.float64), changes]), axis=0)


@dataclass(frozen=True, slots=True, eq=False)
class _Scaled:
    """A patch with its mean taken off and its 1 to 99 percent range scaled to 1."""

    y: Image
    noise: float

    @classmethod
    def of(cls, patch: Plane, model: NoiseModel) -> _Scaled:
        values = patch.astype(np.float64)
        low, high = np.quantile(values, (0.01, 0.99))
        span = max(float(high - low), 1e-9)
        return cls((values - values.mean()) / span, model.sigma_at(float(values.mean())) / span)

    def at(self, level: int) -> _Scaled:
        shape = level_shape(self.y.shape, level)
        if shape == self.y.shape:
            return self
        return _Scaled(resized_image(self.y, shape), self.noise * noise_gain(self.y.shape, shape))


@dataclass(frozen=True, slots=True)
class PatchRecurrence:
    """Kernel for which undoing the blur makes patches recur across scales.

    min over x, k of |y - k * x|² + lambda1 rho(x, x^a) + lambda2 |k|²: alternating the match of patches, a
    Wiener-like image step and a least-squares kernel step, coarse to fine. Patches share k.
    """

    levels: int = 6  # levels of the pyramid, each 4/3 smaller
    iterations: int = 4  # alternations on each level
    beta: float = 0.2  # weight of the matched image in the image step; too large makes kernels too wide
    bandwidth: float = 0.03  # h of the match, in ranges of the patch; at least twice the noise
    ridge: float = 2.5e-2  # lambda2 over the mean diagonal of the normal matrix

    name = "michaeli-irani"
    version = 1

    def estimate(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        *,
        size: int = 31,
        green: PsfEstimate | None = None,
    ) -> PsfEstimate:
        """Estimate the kernel that patches share: after green, the finest level alone, from its kernel on."""
        levels = self.levels if green is None else 1
        kept = usable(patches, noise, size)
        scaled = [_Scaled.of(patch, model) for patch, model in kept]
        while levels > 1 and min(level_shape(scaled[0].y.shape, levels - 1)) < 40:
            levels -= 1
        kernel = delta(_LEAST_SIDE) if green is None else green.kernel
        latent = [s.at(levels - 1).y for s in scaled]
        for level in reversed(range(levels)):
            side = max(_LEAST_SIDE, 2 * round((size / ALPHA**level - 1) / 2) + 1)
            views = [s.at(level) for s in scaled]
            kernel = resized(kernel, side) if level == levels - 1 else _upscaled(kernel, side)
            latent = [resized_image(x, v.y.shape) for x, v in zip(latent, views, strict=True)]
            for _ in range(self.iterations):
                kernel = self._step(views, latent, kernel, side)
        return finished(kernel, size=size, error=_ERROR)

    def _step(self, views: Sequence[_Scaled], latent: list[Image], kernel: Kernel, side: int) -> Kernel:
        """Match and sharpen each latent image, in place, and solve for the kernel that they share."""
        a, b = np.zeros((side**2, side**2)), np.zeros(side**2)
        for i, view in enumerate(views):
            z = recur(latent[i], view.noise, max(self.bandwidth, 2.0 * view.noise))
            latent[i], response = blend(view.y, kernel, z, self.beta)
            own_a, own_b = normal_equations(latent[i], view.y, side, view.noise, response)
            weight = 1.0 / max(view.noise**2, 1e-6)
            a, b = a + weight * own_a, b + weight * own_b
        a[np.diag_indices_from(a)] += self.ridge * np.trace(a) / a.shape[0]
        begin = np.asarray(resized(kernel, side)).ravel()
        solved = nonnegative_least_squares(a, b, begin)
        solved[solved < 0.01 * solved.max()] = 0.0
        if not solved.max() > 0:
            raise NotEnoughEvidenceError("the kernel vanished; the patches hold no detail beyond the noise")
        return as_kernel(solved.reshape(side, side))


def normal_equations(
    x: Image, y: Image, side: int, noise: float, response: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Normal equations of y = k * x over the interior, the noise that x took from y taken off.

    With h the filter by which y entered x (origin at [0, 0]), s the noise of y and N interior pixels::

        A(u, v) = sum_p x(p - u) x(p - v) - N s² sum_i h(i) h(i + u - v)
        b(u)    = sum_p y(p) x(p - u)     - N s² h(-u)
    """
    half = side // 2
    reach = _BORDER + half
    target = y[reach:-reach, reach:-reach]
    n = target.size
    gram, cross = window_products(x[_BORDER:-_BORDER, _BORDER:-_BORDER], target, side)
    a, b = gram[::-1, ::-1].copy(), cross[::-1].copy()
    acf = n * noise**2 * fft.irfft2(np.abs(fft.rfft2(response)) ** 2, s=response.shape)
    lags = np.arange(1 - side, side)
    # [i, j, k, l] is acf(i - k, j - l): windows of all lags, the second offset counted backwards
    apart = sliding_window_view(acf[np.ix_(lags, lags)], (side, side))[:, :, ::-1, ::-1]
    a.reshape((side,) * 4)[...] -= apart
    offsets = half - np.arange(side)
    b -= n * noise**2 * response[np.ix_(offsets, offsets)].ravel()
    return a, b


def _upscaled(kernel: Kernel, side: int) -> Kernel:
    """Stretch a kernel to the next finer level."""
    grown = round(kernel.shape[0] * ALPHA)
    fine = np.maximum(resized_image(np.asarray(kernel), (grown + 1 - grown % 2,) * 2), 0.0)
    return resized(as_kernel(fine), side)
