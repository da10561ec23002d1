"""Whittle-likelihood Gaussian: the spectrum of a patch as a power law times a Gaussian MTF.

P. Whittle's likelihood compares a smooth model M(f) of the power spectrum with the periodogram
S(f) as independent exponentials, -log L = mean(log M + S / M). Safe and fast; a Gaussian follows
the core of a lens PSF, so that its width is half to two thirds of the truth's.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.files import fitted
from lensmodel.core.psf import centred, gaussian, resized
from lensmodel.core.types import NoiseModel, Plane, StepHook, ignore_step
from lensmodel.estimation.estimator import PsfEstimate, is_no_blur, usable

_TILE = 64  # pixels: neighbouring bins are nearly independent, blur nearly the same (chosen)
_BAND = (0.05, 0.5)  # cycles/pixel: below, few bins and uneven light (chosen)
_SLOPE, _SLOPE_SD = 2.5, 0.25
"""Scenes fall off with 2.0 to 4.0: a prior that expects too little makes kernels too wide, a wider one leaves
the blur open (chosen)."""
_ORIENTATION_SD = 0.5
"""Of how much a scene prefers a direction: less takes every such scene for motion, more hides it (chosen)."""
_PRIOR_WEIGHT = 1.0 / 100.0
"""Of the priors against a patch's likelihood, whose bins are not independent: these are averaged, so that
with 1 the priors would decide alone; with 0 slope and blur could stand for each other (chosen)."""
_STARTS_PX = (0.7, 1.5, 3.0)  # widths to begin with, pixels: sharp, usual, soft (chosen)
_ERROR: Final = float(fitted("estimation")["whittle_error"])
"""Expected relative L2 error, see `data/README.md`; the likelihood does not rank its errors."""

_CONFIDENCE = 0.35  # about `confidence_of` that error, the same for all its answers (chosen)
_PER_PATCH = 4  # unknowns: amplitude, slope, two of direction

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class _Spectrum:
    """Mean periodogram of a patch in the band, and the power of its noise."""

    power: Floats
    floor: float


@dataclass(frozen=True, slots=True, eq=False)
class _Band:
    """Frequencies of the band: components, modulus and angle."""

    row: Floats
    col: Floats
    modulus: Floats
    angle: Floats
    inside: NDArray[np.bool_]

    @classmethod
    def of(cls, side: int) -> _Band:
        row, col = np.meshgrid(fft.fftfreq(side), fft.rfftfreq(side), indexing="ij")
        modulus = np.hypot(row, col)
        inside = (modulus > _BAND[0]) & (modulus <= _BAND[1])
        return cls(row[inside], col[inside], modulus[inside], np.arctan2(row, col)[inside], inside)


@dataclass(frozen=True, slots=True)
class Whittle:
    """Gaussian PSF of maximum Whittle likelihood, its scene's slope and orientation free.

    M = exp(A - b ln(f / 0.1) + e1 cos 2t + e2 sin 2t) exp(-4 pi² f'Cf) + N,  C = L L'

    A, b, e1 and e2 belong to each patch, C to all of them.
    """

    name = "whittle"
    version = 2

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
        band = _Band.of(_TILE)
        spectra = [_periodogram(patch, model, band) for patch, model in usable(patches, noise, size)]
        best: scipy.optimize.OptimizeResult | None = None
        for done, width in enumerate(_STARTS_PX, start=1):
            start = [width, 0.0, width]
            for s in spectra:
                start += [float(np.log(np.median(s.power) + 1e-12)), _SLOPE, 0.0, 0.0]
            options = {"maxiter": 80}
            solution = scipy.optimize.minimize(
                _cost, start, args=(spectra, band), jac=True, method="L-BFGS-B", options=options
            )
            if best is None or solution.fun < best.fun:
                best = solution
            on_step(done, len(_STARTS_PX))
        if best is None or not np.isfinite(best.x).all():
            raise NotEnoughEvidenceError("the spectrum of the patches fits no blur; choose other parts")
        lower = np.array([[best.x[0], 0.0], [best.x[1], best.x[2]]])
        covariance = lower @ lower.T
        kernel = resized(centred(gaussian(max(size, 55), covariance)), size)
        signal = np.mean([s.floor / np.maximum(s.power, 1e-30) for s in spectra], axis=0)
        edges = np.linspace(*_BAND, 15)
        ring = np.digitize(band.modulus, edges[1:-1])
        share = np.array([1.0 - signal[ring == i].mean() for i in range(14)])
        return PsfEstimate(
            kernel=kernel,
            confidence=_CONFIDENCE,
            reliability=np.clip(share, 0.0, 1.0),
            predicted_error=_ERROR,
            diagnostics={
                "width": float(np.sqrt(np.trace(covariance) / 2.0)),
                "slope": float(np.mean(best.x[4::_PER_PATCH])),
                "cost": float(best.fun),
            },
            seconds=time.process_time() - began,
            no_blur=is_no_blur(kernel),
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


def _periodogram(patch: Plane, model: NoiseModel, band: _Band) -> _Spectrum:
    """Mean of Hann-windowed tiles at half overlap, relative to the patch's mean square."""
    hann = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(_TILE) + 0.5) / _TILE)
    window = hann[:, None] * hann[None, :]
    values = patch.astype(np.float64)
    scale = float(np.mean(values**2))
    total = np.zeros(band.inside.shape)
    count = 0
    for row in range(0, values.shape[0] - _TILE + 1, _TILE // 2):
        for col in range(0, values.shape[1] - _TILE + 1, _TILE // 2):
            tile = values[row : row + _TILE, col : col + _TILE]
            total += np.abs(fft.rfft2((tile - tile.mean()) * window)) ** 2
            count += 1
    sigma = model.sigma_at(float(values.mean()))
    return _Spectrum(total[band.inside] / (count * scale), sigma**2 * float((window**2).sum()) / scale)


def _cost(p: Floats, spectra: Sequence[_Spectrum], band: _Band) -> tuple[float, Floats]:
    """Negative log-likelihood with weak priors, and its gradient."""
    l00, l10, l11 = p[:3]
    quadratic = l00**2 * band.row**2 + 2.0 * l00 * l10 * band.row * band.col + (l10**2 + l11**2) * band.col**2
    four_pi2 = 4.0 * np.pi**2
    mtf2 = np.exp(-four_pi2 * quadratic)
    log_f = np.log(band.modulus / 0.1)
    cosine, sine = np.cos(2.0 * band.angle), np.sin(2.0 * band.angle)
    gradient = np.zeros_like(p)
    total = 0.0
    for i, s in enumerate(spectra):
        at = 3 + _PER_PATCH * i
        amplitude, slope, e1, e2 = p[at : at + _PER_PATCH]
        exponent = np.clip(amplitude - slope * log_f + e1 * cosine + e2 * sine, -60.0, 60.0)
        scene = np.exp(exponent) * mtf2
        model = scene + s.floor + 1e-300
        total += float(np.mean(np.log(model) + s.power / model))
        pull = (1.0 / model - s.power / model**2) * scene / model.size
        gradient[at] += pull.sum()
        gradient[at + 1] -= (pull * log_f).sum()
        gradient[at + 2] += (pull * cosine).sum()
        gradient[at + 3] += (pull * sine).sum()
        on_c = -four_pi2 * pull
        gradient[0] += (on_c * (2.0 * l00 * band.row**2 + 2.0 * l10 * band.row * band.col)).sum()
        gradient[1] += (on_c * (2.0 * l00 * band.row * band.col + 2.0 * l10 * band.col**2)).sum()
        gradient[2] += (on_c * 2.0 * l11 * band.col**2).sum()
        total += _PRIOR_WEIGHT * ((slope - _SLOPE) / _SLOPE_SD) ** 2
        total += _PRIOR_WEIGHT * (e1**2 + e2**2) / _ORIENTATION_SD**2
        gradient[at + 1] += 2.0 * _PRIOR_WEIGHT * (slope - _SLOPE) / _SLOPE_SD**2
        gradient[at + 2] += 2.0 * _PRIOR_WEIGHT * e1 / _ORIENTATION_SD**2
        gradient[at + 3] += 2.0 * _PRIOR_WEIGHT * e2 / _ORIENTATION_SD**2
    return total, gradient
