"""Blind deblurring by patch priors on edges, `sun`.

The latent image is drawn towards sharp edge patterns where there are edges, and is smooth elsewhere;
the kernel comes from its gradients on the edges. Source: L. Sun, S. Cho, J. Wang and J. Hays,
"Edge-based blur kernel estimation using patch priors", ICCP 2013, with the synthetic prior.

A window of 5 px on an edge is q = σ z + μ: its own mean μ, a pattern z of zero mean and unit norm, and a
contrast σ. The patterns are ideal steps, bars and corners; the contrasts follow the distribution that
edges of sharp scenes have. The paper matches σ itself, in display values; linear light has no such common
scale, so that here the steepness is matched, σ over the range of values within some pixels: blur lowers
σ but not the range of an isolated edge.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft, ndimage

from lab.blind.steps.kernel_step import Grid, Term, cleaned, conjugate_gradients, least_squares_kernel, unsure
from lab.blind.steps.pyramid import Image, Level, View, coarse_to_fine
from lab.cases import DATA
from lensmodel.blind import PsfEstimate
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import centred, otf
from lensmodel.core.types import Kernel, NoiseModel, Plane

SIDE = 5  # pixels of a window, as in the paper
EDGE_SHARE = 0.03  # so many of the pixels lie on the mask, the strongest first
_ORIENTATIONS = 8  # of the filters: 22.5 degrees apart (chosen)
_REACH = 4  # pixels of a filter: two standard deviations along the edge
_ALONG_PX, _ACROSS_PX = 2.0, 1.0  # standard deviations of a filter (chosen): longer than wide
_LEAST_LENGTH = 4  # pixels of an edge: shorter ones are noise (chosen)
_AROUND = 11  # pixels: window of the local range, two patterns wide (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class EdgePatchPrior:
    """Patterns of sharp edges and the distribution of their contrast."""

    patches: Image  # (n, 25), zero mean, unit norm; closed under turns by 90 degrees and change of sign
    steepness: Image  # (q,), quantiles at (i + 1/2) / q of σ over the local range

    @classmethod
    def load(cls, path: Path = DATA / "edge_patches.npz") -> EdgePatchPrior:
        """Read what `lab.training.blind_data` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            return cls(stored["patches"].astype(np.float64), stored["steepness"].astype(np.float64))

    def sharpened(self, windows: Image, ranges: Image) -> Image:
        """Replace windows `(n, 25)` by sharp ones: best pattern, own mean, contrast by rank, never less."""
        mean = windows.mean(axis=1, keepdims=True)
        flat = windows - mean
        contrast = np.linalg.norm(flat, axis=1)
        best = (flat @ self.patches.T).argmax(axis=1)
        steep = contrast / np.maximum(ranges, 1e-9)
        rank = (steep.argsort(kind="stable").argsort(kind="stable") + 0.5) / max(len(windows), 1)
        places = (np.arange(len(self.steepness)) + 0.5) / len(self.steepness)
        wanted = np.maximum(np.interp(rank, places, self.steepness) * ranges, contrast)
        return np.asarray(wanted[:, None] * self.patches[best] + mean)


default_prior = cache(EdgePatchPrior.load)


def edge_mask(x: Image) -> NDArray[np.bool_]:
    """Mark thin edges: strongest responses to elongated derivative filters, local maxima across."""
    responses = np.stack([np.abs(ndimage.correlate(x, f, mode="nearest")) for f in _bank()])
    strength, way = responses.max(axis=0), responses.argmax(axis=0)
    crest = np.zeros(x.shape, dtype=bool)
    padded = np.pad(strength, 1)
    for i in range(_ORIENTATIONS):
        angle = math.pi * i / _ORIENTATIONS
        down, across = round(-math.sin(angle)), round(math.cos(angle))
        ahead = padded[1 + down : padded.shape[0] - 1 + down, 1 + across : padded.shape[1] - 1 + across]
        behind = padded[1 - down : padded.shape[0] - 1 - down, 1 - across : padded.shape[1] - 1 - across]
        crest |= (way == i) & (strength >= ahead) & (strength >= behind)
    rim = SIDE // 2
    inside = np.zeros(x.shape, dtype=bool)
    inside[rim:-rim, rim:-rim] = True
    crest &= inside & (strength > 1e-9)
    count = max(int(EDGE_SHARE * x.size), 1)
    if int(crest.sum()) > count:
        crest &= strength >= np.partition(strength[crest], -count)[-count]
    label, _ = ndimage.label(crest, np.ones((3, 3), dtype=np.int_))
    long = np.bincount(label.ravel()) >= _LEAST_LENGTH
    long[0] = False
    return np.asarray(long[label])


def steepness_of(x: Image) -> Image:
    """σ of the window around each pixel over the local range, 0 where nothing varies."""
    mean = ndimage.uniform_filter(x, SIDE, mode="nearest")
    power = ndimage.uniform_filter(x * x, SIDE, mode="nearest") - mean * mean
    return np.sqrt(np.maximum(power, 0.0)) * SIDE / np.maximum(local_range(x), 1e-9)


def local_range(x: Image) -> Image:
    """Largest less smallest value within 5 px in each direction."""
    high, low = (f(x, _AROUND, mode="nearest") for f in (ndimage.maximum_filter, ndimage.minimum_filter))
    return np.asarray(high - low)


def target(x: Image, mask: NDArray[np.bool_], prior: EdgePatchPrior) -> tuple[Image, Image]:
    """Mean of the sharp windows over each pixel, and how many lie over it: q and count, both (H, W)."""
    rim = SIDE // 2
    rows, cols = np.nonzero(mask)
    windows = sliding_window_view(x, (SIDE, SIDE))[rows - rim, cols - rim].reshape(-1, SIDE * SIDE)
    sharp = prior.sharpened(windows, local_range(x)[rows, cols]).reshape(-1, SIDE, SIDE)
    total, count = np.zeros_like(x), np.zeros_like(x)
    for i in range(SIDE):
        for j in range(SIDE):
            place = (rows + i - rim, cols + j - rim)
            np.add.at(total, place, sharp[:, i, j])
            np.add.at(count, place, 1.0)
    return np.where(count > 0, total / np.maximum(count, 1.0), x), count


@cache
def _bank() -> tuple[Image, ...]:
    """Derivatives of Gaussians, long along the edge; each responds to its own direction."""
    t = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    filters = []
    for i in range(_ORIENTATIONS):
        angle = math.pi * i / _ORIENTATIONS
        u = math.cos(angle) * t[None, :] - math.sin(angle) * t[:, None]
        v = math.sin(angle) * t[None, :] + math.cos(angle) * t[:, None]
        one = u * np.exp(-0.5 * ((u / _ACROSS_PX) ** 2 + (v / _ALONG_PX) ** 2))
        filters.append(one / np.abs(one).sum())
    return tuple(filters)


_INTENSITY_WEIGHT = 0.1  # w of values, of differences it is 1 (chosen): noise in values reaches far
_LEAST_EDGE_PX = 30  # gradients on edges: of fewer a kernel is chance (chosen)


@dataclass(frozen=True, slots=True)
class Sun:
    """Kernel from the gradients of a latent image whose edges look like sharp patterns.

    Coarse to fine, alternating::

        x = argmin sum_d w_d |D_d (k * x - y)|² + β sum_i |P_i x - q_i|² + α |grad x|²
        k = argmin_{k >= 0} sum_d |k * (D_d x)_M - D_d y|² + γ |k|²

    d: values and both differences; i: pixels on the edge mask M; q_i: the sharp window nearest to
    P_i x; (.)_M: zero away from edges.
    """

    iterations: int = 5  # alternations on each level
    # β of the image steps of one alternation, growing; each matches the windows anew
    betas: tuple[float, ...] = (0.1, 0.2, 0.4)
    smoothness: float = 0.6  # α
    ridge: float = 0.02  # γ over the power of the gradients on edges
    # kernel values below this share of the peak, and islands of less than this mass, are dropped
    threshold: float = 0.05
    least_mass: float = 0.05

    name = "sun"
    version = 1

    def estimate(
        self, patches: Sequence[Plane], noise: Sequence[NoiseModel], *, size: int = 31
    ) -> PsfEstimate:
        """Estimate the kernel of a patch; see `BlindMethod`."""
        found = coarse_to_fine(View.of_one(patches, noise, size), self._alternation, size)
        return unsure(cleaned(found, self.threshold, self.least_mass), size)

    def _alternation(self, level: Level, kernel: Kernel, latent: Image) -> tuple[Kernel, Image]:
        """The alternation on one level."""
        kernel = centred(kernel)
        for _ in range(self.iterations):
            for beta in self.betas:
                q, count = target(latent, edge_mask(latent), default_prior())
                latent = image_step(level.view.y, kernel, q, count, beta, self.smoothness)
            terms = edge_terms(latent, level.view, level.side, self.ridge)
            if sum(np.count_nonzero(term.x) for term in terms) < _LEAST_EDGE_PX:
                raise NotEnoughEvidenceError("the patch holds no edge; choose a part with edges")
            kernel = centred(cleaned(least_squares_kernel(terms, kernel), 0.0))
        return kernel, latent


def edge_terms(x: Image, view: View, side: int, ridge: float) -> tuple[Term, Term]:
    """Terms of the kernel step: differences of x on its edges against those of y."""
    covered = ndimage.binary_dilation(edge_mask(x), np.ones((SIDE, SIDE), dtype=bool))
    half = side // 2
    weight = 1.0 / max(view.noise**2, 1e-6)
    terms = []
    for axis in (0, 1):
        gradient = np.diff(x, axis=axis)
        near = covered[1:, :] & covered[:-1, :] if axis == 0 else covered[:, 1:] & covered[:, :-1]
        edges = np.where(near, gradient, 0.0).astype(np.float32)
        seen = np.diff(view.y, axis=axis)
        inner = seen[half : seen.shape[0] - half, half : seen.shape[1] - half].astype(np.float32)
        grid = Grid((inner.shape[0], inner.shape[1]), side)
        terms.append(Term(grid, inner, edges, weight, ridge * float(np.vdot(edges, edges))))
    return terms[0], terms[1]


def image_step(
    y: Image, kernel: Kernel, q: Image, count: Image, beta: float, smoothness: float, steps: int = 8
) -> Image:
    """Minimise sum_d w_d |D_d (k * x - y)|² + β sum_p count(p) (x - q)² + α |grad x|² over x."""
    pad = kernel.shape[0]
    rows, cols = (int(fft.next_fast_len(n + 2 * pad, real=True)) for n in y.shape)
    shape = (rows, cols)
    after = [(pad, n - m - pad) for n, m in zip(shape, y.shape, strict=True)]
    inside = (slice(pad, pad + y.shape[0]), slice(pad, pad + y.shape[1]))
    transfer = otf(kernel, shape).astype(np.complex64)
    laplacian = _laplacian(shape)
    weight = (_INTENSITY_WEIGHT + laplacian).astype(np.float32)
    diagonal = (weight * np.abs(transfer) ** 2 + smoothness * laplacian).astype(np.float32)
    pull = np.zeros(shape, dtype=np.float32)
    pull[inside] = beta * count
    observed = np.pad(y, after, mode="symmetric").astype(np.float32)
    wanted = np.pad(q, after, mode="symmetric").astype(np.float32)
    right = fft.irfft2(weight * np.conj(transfer) * fft.rfft2(observed), shape) + pull * wanted
    inverse = 1.0 / (diagonal + max(float(pull[inside].mean()), 1e-3))

    def applied(x: NDArray[np.float32]) -> NDArray[np.float32]:
        return fft.irfft2(diagonal * fft.rfft2(x), shape) + pull * x

    def roughly(residual: NDArray[np.float32]) -> NDArray[np.float32]:
        return fft.irfft2(inverse * fft.rfft2(residual), shape)

    x = conjugate_gradients(applied, right - applied(wanted), wanted, steps, inverse=roughly)
    return x[inside].astype(np.float64)


def _laplacian(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Squared modulus of both differences on the `rfft2` grid."""
    down = 4.0 * np.sin(math.pi * fft.fftfreq(shape[0])) ** 2
    across = 4.0 * np.sin(math.pi * fft.rfftfreq(shape[1])) ** 2
    return np.asarray(down[:, None] + across[None, :])
