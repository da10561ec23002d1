"""The spectra of several patches behind one blur, beside what is known of scenes (`scene.prior`)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.spectrum import RING_EDGES, RINGS, SECTORS, binned_spectrum
from lensmodel.core.types import NoiseModel, Plane
from lensmodel.estimation.spectra.leakage import Leakage
from lensmodel.scene.prior import (
    FIRST_WINDOW_RING,
    LARGEST_RESIDUAL,
    LEAST_POWER,
    NOISE_SCATTER,
    WINDOW_BINS,
    WINDOW_SCATTER,
    WINDOW_SHAPES,
    WindowPrior,
)

_SIDE = 64  # pixels: one tile of a patch's spectrum
_FAINTEST = 1e-5  # of |K|²: beyond, leakage and rounding hide the zeros (chosen)

Floats = NDArray[np.float64]


def _bins_of_grid() -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Which entries of a 64 px `rfft2` grid each bin holds: their places, where a bin begins, how many."""
    row, col = np.meshgrid(fft.fftfreq(_SIDE), fft.rfftfreq(_SIDE), indexing="ij")
    frequency, angle = np.hypot(row, col), np.mod(np.arctan2(row, col), np.pi)
    ring = np.searchsorted(RING_EDGES, frequency, side="right") - 1
    sector = np.minimum((angle / np.pi * SECTORS).astype(int), SECTORS - 1)
    held = []
    for i in range(FIRST_WINDOW_RING, RINGS):
        for j in range(SECTORS):
            inside = (ring == i) & (sector == j)
            held.append(np.flatnonzero(inside if inside.any() else ring == i))
    count = np.array([len(places) for places in held])
    return np.concatenate(held), np.cumsum(count) - count, count.astype(np.float64)


_PLACES, _BEGIN, _COUNT = _bins_of_grid()
_LEAKAGE = Leakage.of(_SIDE)


def _leaked(power: Floats) -> Floats:
    """Mean power of bins as seen through the window of a tile, shape (..., 64, 33) to (..., WINDOW_BINS)."""
    mixed = _LEAKAGE.seen(power)
    flat = mixed.reshape(*mixed.shape[:-2], -1)[..., _PLACES]
    return np.asarray(np.add.reduceat(flat, _BEGIN, axis=-1) / _COUNT, dtype=np.float64)


_OPEN = _leaked(np.ones((_SIDE, _SIDE // 2 + 1)))  # what leaks where the transfer function is 1 everywhere


def log_power(kernel: Floats, changes: Floats) -> tuple[Floats, Floats]:
    """Ln |K|² in the bins and its derivatives, as the periodogram of a blurred scene would show it.

    Parameters
    ----------
    kernel : ndarray, shape (k, k)
        k at most 63.
    changes : ndarray, shape (n, k, k)
        Derivatives of the kernel.

    Returns
    -------
    value : ndarray, shape (WINDOW_BINS,)
    derivatives : ndarray, shape (WINDOW_BINS, n)
    """
    transform = fft.rfft2(np.concatenate([kernel[None], changes]), (_SIDE, _SIDE))
    crossed = transform.real * transform[0].real + transform.imag * transform[0].imag
    power = _leaked(crossed) / _OPEN
    value = power[0] + _FAINTEST
    return np.log(value), (2.0 * power[1:] / value).T


@dataclass(frozen=True, slots=True, eq=False)
class SceneSpectra:
    """Spectra of several patches behind one blur, with what is known of scenes.

    Parameters
    ----------
    log_power : ndarray, shape (n, WINDOW_BINS)
        Log power, noise included.
    noise : ndarray, shape (n,)
        Power of the noise.
    whitening : ndarray, shape (n, WINDOW_BINS, WINDOW_BINS)
        Makes residuals independent and of unit variance.
    usual : ndarray, shape (WINDOW_BINS,)
        See `WindowPrior`.
    """

    log_power: Floats
    noise: Floats
    whitening: Floats
    usual: Floats

    @classmethod
    def of(cls, kept: Sequence[tuple[Plane, NoiseModel]]) -> SceneSpectra:
        """Measure patches."""
        prior = WindowPrior.load()
        log_powers, floors, whitening = [], [], []
        for patch, model in kept:
            spectrum, floor = binned_spectrum(patch, model)
            power = np.maximum(spectrum[FIRST_WINDOW_RING:].astype(np.float64), LEAST_POWER)
            share = np.repeat(np.clip(1.0 - floor / power.mean(axis=1), 0.0, 1.0), SECTORS)
            shapes = WINDOW_SHAPES * share[:, None]
            covariance = shapes @ prior.spread @ shapes.T
            scatter = (
                (prior.roughness * share) ** 2 + WINDOW_SCATTER**2 + (NOISE_SCATTER * (1.0 - share)) ** 2
            )
            covariance[np.diag_indices_from(covariance)] += scatter
            whitening.append(np.linalg.inv(np.linalg.cholesky(covariance)))
            log_powers.append(np.log(power).ravel())
            floors.append(floor)
        return cls(np.array(log_powers), np.array(floors), np.array(whitening), prior.usual)

    def begin(self, blur: Floats) -> Floats:
        """Amplitudes of the scenes to begin with, shape (n,), behind a blur of log power `blur`."""
        return np.asarray(np.median(self.log_power - self.usual - blur, axis=1), dtype=np.float64)

    def residuals(self, blur: Floats, by_blur: Floats, amplitudes: Floats) -> tuple[Floats, Floats]:
        """Whitened residuals of all bins of all patches, and their derivatives.

        Parameters
        ----------
        blur : ndarray, shape (WINDOW_BINS,)
            Ln |K|².
        by_blur : ndarray, shape (WINDOW_BINS, m)
            Its derivatives.
        amplitudes : ndarray, shape (n,)

        Returns
        -------
        residuals : ndarray, shape (n * WINDOW_BINS,)
        derivatives : ndarray, shape (n * WINDOW_BINS, m + n)
        """
        count, unknowns = len(self.log_power), by_blur.shape[1]
        left = np.zeros((count, WINDOW_BINS))
        change = np.zeros((count, WINDOW_BINS, unknowns + count))
        for i in range(count):
            scene = np.exp(np.clip(amplitudes[i] + self.usual + blur, -60.0, 60.0))
            power = scene + self.noise[i]
            off = np.clip(self.log_power[i] - np.log(power), -LARGEST_RESIDUAL, LARGEST_RESIDUAL)
            share = scene / power
            moved = self.whitening[i] @ np.column_stack([off, by_blur * share[:, None], share])
            left[i] = moved[:, 0]
            change[i, :, :unknowns] = -moved[:, 1:-1]
            change[i, :, unknowns + i] = -moved[:, -1]
        return left.ravel(), change.reshape(count * WINDOW_BINS, -1)
