"""Blind deblurring by patch priors on edges, `sun`.

The latent image is drawn towards sharp edge patterns where there are edges, and is smooth elsewhere;
the kernel comes from its gradients on the edges. Source: L. Sun, S. Cho, J. Wang and J. Hays,
"Edge-based blur kernel estimation using patch priors", ICCP 2013, with the synthetic prior.

On mild blur the prior's own sharpness decides the width of the kernel: it is as sharp as a pixel
allows, which few photographs are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lab.blind.steps.edge_patches import SIDE, EdgePatchPrior, default_prior, edge_mask, target
from lab.blind.steps.kernel_step import Grid, Term, cleaned, least_squares_kernel, unsure
from lab.blind.steps.pyramid import Image, Latents, Level, View, coarse_to_fine
from lensmodel.blind.estimator import PsfEstimate, usable
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.psf import centred, otf
from lensmodel.core.types import Kernel, NoiseModel, Plane

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
        """Estimate the kernel that all patches share; see `BlindMethod`."""
        views = [View.of(patch, model) for patch, model in usable(patches, noise, size)]
        found = coarse_to_fine(views, _Alternation(self, default_prior()), size)
        return unsure(cleaned(found, self.threshold, self.least_mass), size)


@dataclass(slots=True)
class _Alternation:
    """The alternation on one level."""

    method: Sun
    prior: EdgePatchPrior

    def __call__(self, level: Level, kernel: Kernel, latents: Latents) -> tuple[Kernel, Latents]:
        kernel, now = centred(kernel), list(latents)
        for _ in range(self.method.iterations):
            terms: list[Term] = []
            for i, view in enumerate(level.views):
                for beta in self.method.betas:
                    mask = edge_mask(now[i])
                    q, count = target(now[i], mask, self.prior)
                    now[i] = image_step(view.y, kernel, q, count, beta, self.method.smoothness)
                terms.extend(edge_terms(now[i], view, level.side, self.method.ridge))
            if sum(np.count_nonzero(term.x) for term in terms) < _LEAST_EDGE_PX:
                raise NotEnoughEvidenceError("the patches hold no edge; choose parts with edges")
            kernel = centred(cleaned(least_squares_kernel(terms, kernel), 0.0))
        return kernel, tuple(now)


def edge_terms(x: Image, view: View, side: int, ridge: float) -> tuple[Term, Term]:
    """Terms of the kernel step: differences of x on its edges against those of y.

    Only where the kernel stays inside the patch: the latent image is not known beyond it.
    """
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
    """Minimise sum_d w_d |D_d (k * x - y)|² + β sum_p count(p) (x - q)² + α |grad x|² over x.

    By conjugate gradients on a mirrored frame, preconditioned by the Fourier-diagonal part.
    """
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

    x = wanted
    residual = right - applied(x)
    ready = fft.irfft2(inverse * fft.rfft2(residual), shape)
    direction, power = ready, float(np.vdot(residual, ready))
    for _ in range(steps):
        if power <= 1e-12:
            break
        image = applied(direction)
        length = np.float32(power / max(float(np.vdot(direction, image)), 1e-30))
        x = x + length * direction
        residual = residual - length * image
        ready = fft.irfft2(inverse * fft.rfft2(residual), shape)
        later = float(np.vdot(residual, ready))
        direction, power = ready + np.float32(later / power) * direction, later
    return x[inside].astype(np.float64)


def _laplacian(shape: tuple[int, int]) -> NDArray[np.float64]:
    """Squared modulus of both differences on the `rfft2` grid."""
    down = 4.0 * np.sin(math.pi * fft.fftfreq(shape[0])) ** 2
    across = 4.0 * np.sin(math.pi * fft.rfftfreq(shape[1])) ** 2
    return np.asarray(down[:, None] + across[None, :])
