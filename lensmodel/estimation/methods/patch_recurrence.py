"""Blind deblurring by internal patch recurrence, `michaeli-irani`: the paper's estimator.

Michaeli and Irani, ECCV 2014, with one addition without which it collapses on photos in linear
light: the noise of y is in the latent image too, so the normal equations of the kernel step get a
spike that pulls k to a delta (errors in variables). Its expectation is known and taken off.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.files import fitted
from lensmodel.core.least_squares import nonnegative_least_squares
from lensmodel.core.psf import as_kernel, centred, distance, resized, rms_width
from lensmodel.core.spectrum import binned_spectrum
from lensmodel.core.types import Kernel, NoiseModel, Plane, StepHook, ignore_step
from lensmodel.estimation.estimator import PsfEstimate, is_no_blur, usable
from lensmodel.estimation.steps.finish import confidence_of
from lensmodel.estimation.steps.gram import window_products
from lensmodel.estimation.steps.recurrence import (
    ALPHA,
    THOROUGH,
    Image,
    Search,
    blend,
    level_shape,
    noise_gain,
    recur,
    resized_image,
)

log = logging.getLogger(__name__)

_BORDER = 3
"""Pixels left out along the rim: fewer patches overlap there, so that the latent picture is worse
(chosen)."""
_ERROR: Final[Mapping[str, float]] = fitted("estimation")["recurrence_error"]
"""Expected relative L2 error by the disagreement of the halves of the patches: a line through 24 patches,
whose halves lie 0.14 apart and whose mean error is 0.61, see `data/README.md`. It ranks patches weakly (rank
correlation 0.28)."""


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

    min over x, k of |y - k * x|² + lambda1 rho(x, x^a) + lambda2 |k|²: alternating the match of
    patches, a Wiener-like image step and a least-squares kernel step, coarse to fine. All patches
    of a set share k: their normal equations are summed with weights 1/noise².

    Parameters
    ----------
    levels : int
        Levels of the pyramid, each 4/3 smaller.
    iterations : int
        Alternations on each level.
    beta : float
        Weight of the matched image in the image step; too large makes kernels too wide.
    bandwidth : float
        h of the match, in ranges of the patch; at least twice the noise.
    ridge : float
        lambda2 over the mean diagonal of the normal matrix.
    support : int or None
        Odd side of the estimated kernel; None takes it from `size`.
    search : Search
        How thoroughly matches are looked for.
    """

    levels: int = 6
    iterations: int = 4
    beta: float = 0.2
    bandwidth: float = 0.03
    ridge: float = 2.5e-2
    support: int | None = None
    search: Search = THOROUGH

    name = "michaeli-irani"
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
        return self._run(patches, noise, size, None, self.levels, on_step)

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
        """Estimate another channel: the finest level alone, from the reference kernel on."""
        return self._run(patches, noise, size, reference.kernel, 1, on_step)

    def _run(
        self,
        patches: Sequence[Plane],
        noise: Sequence[NoiseModel],
        size: int,
        start: Kernel | None,
        levels: int,
        on_step: StepHook,
    ) -> PsfEstimate:
        began = time.process_time()
        kept = usable(patches, noise, size)
        scaled = [_Scaled.of(patch, model) for patch, model in kept]
        widest = self.support or size
        while levels > 1 and min(level_shape(scaled[0].y.shape, levels - 1)) < 40:
            levels -= 1
        kernel, latent = start, [view.y for view in (s.at(levels - 1) for s in scaled)]
        total, done = levels * self.iterations, 0
        state: _Equations | None = None
        for level in reversed(range(levels)):
            side = max(5, _odd(widest / ALPHA**level))
            views = [s.at(level) for s in scaled]
            kernel = _start(kernel, side) if level == levels - 1 else _upscaled(kernel, side)
            latent = [resized_image(x, v.y.shape) for x, v in zip(latent, views, strict=True)]
            for _ in range(self.iterations):
                state = self._step(views, latent, kernel, side)
                kernel = state.kernel
                done += 1
                on_step(done, total)
        if state is None:
            raise NotEnoughEvidenceError("the patches determine no kernel; choose parts with more detail")
        final = resized(centred(state.kernel), size)
        apart = self._disagreement(state, views, latent)
        error = min(_ERROR["at_agreement"] + _ERROR["by_disagreement"] * apart, 1.0)
        of_scale = {"width": rms_width(final), "support": float(widest), "levels": float(levels)}
        return PsfEstimate(
            kernel=final,
            confidence=confidence_of(error),
            reliability=reliability(kept),
            predicted_error=error,
            diagnostics={**of_scale, "disagreement": apart},
            seconds=time.process_time() - began,
            no_blur=is_no_blur(final),
        )

    def _step(self, views: Sequence[_Scaled], latent: list[Image], kernel: Kernel, side: int) -> _Equations:
        parts, responses = [], []
        for i, view in enumerate(views):
            z = recur(latent[i], view.noise, max(self.bandwidth, 2.0 * view.noise), self.search)
            latent[i], response = blend(view.y, kernel, z, self.beta)
            parts.append(normal_equations(latent[i], view.y, side, view.noise, response))
            responses.append(response)
        return _Equations(self._solved(parts, views, np.asarray(resized(kernel, side))), responses)

    def _solved(self, parts: Sequence[Part], views: Sequence[_Scaled], begin: NDArray[np.float64]) -> Kernel:
        """Kernel of the normal equations of all patches together."""
        votes = [1.0 / max(view.noise**2, 1e-6) for view in views]
        a = np.asarray(sum(vote * part[0] for vote, part in zip(votes, parts, strict=True)))
        b = np.asarray(sum(vote * part[1] for vote, part in zip(votes, parts, strict=True)))
        ridge = self.ridge * np.trace(a) / a.shape[0]
        a[np.diag_indices_from(a)] += ridge
        taken = sum(vote * part[2] for vote, part in zip(votes, parts, strict=True))
        solved = nonnegative_least_squares(a, b, begin.ravel(), smallest=ridge - taken)
        solved[solved < 0.01 * solved.max()] = 0.0
        if not solved.max() > 0:
            raise NotEnoughEvidenceError("the kernel vanished; the patches hold no detail beyond the noise")
        return as_kernel(solved.reshape(begin.shape))

    def _disagreement(self, state: _Equations, views: Sequence[_Scaled], latent: Sequence[Image]) -> float:
        """Relative L2 distance of the kernels that the left and the right halves of the patches give alone.

        1 where the halves are too narrow for a kernel.
        """
        begin, halves = np.asarray(state.kernel), []
        if latent[0].shape[1] // 2 < 2 * (_BORDER + begin.shape[0] // 2) + begin.shape[0]:
            return 1.0
        middle = latent[0].shape[1] // 2
        for half in (slice(None, middle), slice(middle, None)):
            parts = [
                normal_equations(x[:, half], view.y[:, half], begin.shape[0], view.noise, response)
                for x, view, response in zip(latent, views, state.responses, strict=True)
            ]
            try:
                halves.append(centred(self._solved(parts, views, begin)))
            except NotEnoughEvidenceError:
                return 1.0
        return min(distance(*halves).rel_l2, 1.0)


Part: TypeAlias = tuple[NDArray[np.float64], NDArray[np.float64], float]
"""Normal equations of one patch: A, b, and the most by which an eigenvalue of A can be below zero."""


@dataclass(frozen=True, slots=True, eq=False)
class _Equations:
    kernel: Kernel
    responses: list[NDArray[np.float64]]


def normal_equations(x: Image, y: Image, side: int, noise: float, response: NDArray[np.float64]) -> Part:
    """Normal equations of y = k * x over the interior, the noise that x took from y taken off.

    With h the filter by which y entered x, s the noise of y and N interior pixels::

        A(u, v) = sum_p x(p - u) x(p - v) - N s² sum_i h(i) h(i + u - v)
        b(u)    = sum_p y(p) x(p - u)     - N s² h(-u)

    Parameters
    ----------
    x, y : ndarray, shape (H, W)
        Latent and observed, zero mean.
    side : int
        Odd side of the kernel.
    noise : float
        s.
    response : ndarray, shape (n, n)
        h, origin at [0, 0], n at least 2 side.

    Returns
    -------
    A : ndarray, shape (side², side²)
    b : ndarray, shape (side²,)
    taken : float
        The largest eigenvalue of what was taken off A is no larger: N s² max |H|², as of a circulant matrix.
    """
    half = side // 2
    margin = _BORDER
    inner = x[margin : x.shape[0] - margin, margin : x.shape[1] - margin]
    reach = margin + half
    target = y[reach : y.shape[0] - reach, reach : y.shape[1] - reach]
    n = target.size
    gram, cross = window_products(inner, target, side)
    a, b = gram[::-1, ::-1].copy(), cross[::-1].copy()
    power = np.abs(fft.rfft2(response)) ** 2
    acf = n * noise**2 * fft.irfft2(power, s=response.shape)
    lags = np.arange(1 - side, side)
    # [i, j, k, l] is acf(i - k, j - l): windows of all lags, the second offset counted backwards
    apart = sliding_window_view(acf[np.ix_(lags, lags)], (side, side))[:, :, ::-1, ::-1]
    a.reshape((side,) * 4)[...] -= apart
    offsets = half - np.arange(side)
    b -= n * noise**2 * response[np.ix_(offsets, offsets)].ravel()
    return a, b, n * noise**2 * float(power.max())


def reliability(kept: Sequence[tuple[Plane, NoiseModel]]) -> NDArray[np.float64]:
    """Share of signal in the power of each ring of frequency, pooled over patches, shape (rings,)."""
    spectra = [binned_spectrum(patch, model) for patch, model in kept]
    power = np.mean([spectrum.mean(axis=1) for spectrum, _ in spectra], axis=0)
    floor = float(np.mean([noise for _, noise in spectra]))
    return np.clip(1.0 - floor / np.maximum(power, 1e-30), 0.0, 1.0)


def _odd(value: float) -> int:
    return 2 * round((value - 1) / 2) + 1


def _start(kernel: Kernel | None, side: int) -> Kernel:
    if kernel is None:
        delta = np.zeros((side, side))
        delta[side // 2, side // 2] = 1.0
        return as_kernel(delta)
    return resized(kernel, side)


def _upscaled(kernel: Kernel | None, side: int) -> Kernel:
    """Stretch a kernel to the next finer level."""
    if kernel is None:
        return _start(None, side)
    grown = round(kernel.shape[0] * ALPHA)
    fine = np.maximum(resized_image(np.asarray(kernel), (grown + 1 - grown % 2,) * 2), 0.0)
    return resized(as_kernel(fine), side)
