"""How the power spectra of scenes spread, so that the rest of a photographed one is the blur's.

In the bins of a patch, with L = ln(f / 0.1) and the angle t of the frequency, a scene's log power is

    s = a + z1 L + z2 L² + z3 cos 2t + z4 sin 2t + z5 cos 4t + z6 sin 4t + z7 L cos 2t + z8 L sin 2t + bias

and a roughness that the polynomial does not follow. Natural images fall off with about the square of the
frequency (D. J. Field, JOSA A 4, 1987); how far single windows stray from that was measured on
photographs of the development half by `lensmodel.lab.training.make_scene_spectra`. One window says little,
since a steep scene looks like a blurred one; from window to window the scene changes and the blur stays.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.spectrum import RING_LIMITS, RINGS, SECTORS, binned_spectrum
from lensmodel.core.types import NoiseModel, Plane

FIRST_RING: Final = 2
"""Rings below hold too few frequencies of a 64 px tile."""

BINS: Final = (RINGS - FIRST_RING) * SECTORS

_DATA = Path(__file__).parents[1] / "data" / "scene_spectra.npz"
_SIDE = 64  # pixels: one tile of a patch's spectrum
_EDGE = np.geomspace(*RING_LIMITS, RINGS + 1)  # cycles/pixel between the rings
_OWN, _NOISY = 0.13, 0.35  # scatter of log power: of scene alone, of noise alone
_LEAST = 1e-15  # keeps logarithms finite, far below any noise
_FAINTEST = 1e-5  # of |K|²: beyond, leakage and rounding hide the zeros
_LARGEST_RESIDUAL = 3.0  # of a natural logarithm: beyond it no fit is linear (chosen)
_SCENE_FALL = 2.3  # exponent of a scene's power, about 2: Field 1987

Floats = NDArray[np.float64]


def _bins_of_grid() -> tuple[NDArray[np.intp], NDArray[np.intp], Floats]:
    """Which entries of a 64 px `rfft2` grid each bin holds: their places, where a bin begins, how many."""
    row, col = np.meshgrid(fft.fftfreq(_SIDE), fft.rfftfreq(_SIDE), indexing="ij")
    frequency, angle = np.hypot(row, col), np.mod(np.arctan2(row, col), np.pi)
    ring = np.searchsorted(_EDGE, frequency, side="right") - 1
    sector = np.minimum((angle / np.pi * SECTORS).astype(int), SECTORS - 1)
    held = []
    for i in range(FIRST_RING, RINGS):
        for j in range(SECTORS):
            inside = (ring == i) & (sector == j)
            held.append(np.flatnonzero(inside if inside.any() else ring == i))
    count = np.array([len(places) for places in held])
    return np.concatenate(held), np.cumsum(count) - count, count.astype(np.float64)


def _polynomial() -> Floats:
    middle = np.sqrt(_EDGE[1:] * _EDGE[:-1])[FIRST_RING:]
    modulus, t = np.meshgrid(middle, (np.arange(SECTORS) + 0.5) * np.pi / SECTORS, indexing="ij")
    log_f, angle = np.log(modulus / 0.1).ravel(), t.ravel()
    turned = [np.cos(2 * angle), np.sin(2 * angle), np.cos(4 * angle), np.sin(4 * angle)]
    return np.stack(
        [np.ones(BINS), log_f, log_f**2, *turned, log_f * turned[0], log_f * turned[1]],
        axis=1,
    )


_PLACES, _BEGIN, _COUNT = _bins_of_grid()
SHAPES: Final = _polynomial()
"""Values of the polynomial's terms in the bins, shape (BINS, 9)."""

# Power of the usual scene
_FALL = 1.0 / np.maximum(np.hypot(fft.fftfreq(_SIDE)[:, None], fft.rfftfreq(_SIDE)), 1 / _SIDE) ** _SCENE_FALL


def _leaked(power: Floats) -> Floats:
    """Mean power of bins as seen through the Hann window of a tile, shape (..., 64, 33) to (..., BINS).

    The window mixes each frequency with its neighbours, weights 1/6, 2/3, 1/6 along either axis, and
    the lower ones count for more, since scenes fall off.
    """
    scene = power * _FALL
    mirrored = scene[..., -np.arange(_SIDE), :]
    wide = np.concatenate([mirrored[..., 1:2], scene, mirrored[..., -2:-1]], axis=-1)
    mixed = (np.roll(wide, 1, -2) + np.roll(wide, -1, -2)) / 6.0 + wide * (2.0 / 3.0)
    mixed = (mixed[..., :-2] + mixed[..., 2:]) / 6.0 + mixed[..., 1:-1] * (2.0 / 3.0)
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
    value : ndarray, shape (BINS,)
    derivatives : ndarray, shape (BINS, n)
    """
    transform = fft.rfft2(np.concatenate([kernel[None], changes]), (_SIDE, _SIDE))
    crossed = transform.real * transform[0].real + transform.imag * transform[0].imag
    power = _leaked(crossed) / _OPEN
    value = power[0] + _FAINTEST
    return np.log(value), (2.0 * power[1:] / value).T


@dataclass(frozen=True, slots=True, eq=False)
class ScenePrior:
    """Means and spreads of the polynomial's coefficients and of what it leaves.

    Parameters
    ----------
    usual : ndarray, shape (BINS,)
        Log power of a usual scene, but for its amplitude.
    spread : ndarray, shape (9, 9)
        Covariance of the coefficients; no bound on the amplitude, whose row and column are zero.
    roughness : ndarray, shape (BINS,)
        Standard deviation of what the polynomial leaves.
    """

    usual: Floats
    spread: Floats
    roughness: Floats

    @classmethod
    @lru_cache(maxsize=1)
    def load(cls) -> ScenePrior:
        """Read what `lensmodel.lab.training.make_scene_spectra` wrote."""
        with np.load(_DATA, allow_pickle=False) as stored:
            return cls.of({name: np.array(stored[name], dtype=np.float64) for name in stored.files})

    @classmethod
    def of(cls, measured: Mapping[str, Floats]) -> ScenePrior:
        """Make one of the coefficients' medians, their covariance, and the rings' bias and roughness."""
        rings = {name: np.repeat(measured[name], SECTORS) for name in ("bias", "roughness")}
        usual = SHAPES[:, 1:] @ measured["usual"][1:] + rings["bias"]
        return cls(usual, measured["spread"], rings["roughness"])


@dataclass(frozen=True, slots=True, eq=False)
class SceneSpectra:
    """Spectra of several patches behind one blur, with what is known of scenes.

    Parameters
    ----------
    log_power : ndarray, shape (n, BINS)
        Log power, noise included.
    noise : ndarray, shape (n,)
        Power of the noise.
    whitening : ndarray, shape (n, BINS, BINS)
        Makes residuals independent and of unit variance.
    usual : ndarray, shape (BINS,)
        See `ScenePrior`.
    """

    log_power: Floats
    noise: Floats
    whitening: Floats
    usual: Floats

    @classmethod
    def of(cls, kept: Sequence[tuple[Plane, NoiseModel]]) -> SceneSpectra:
        """Measure patches."""
        prior = ScenePrior.load()
        log_powers, floors, whitening = [], [], []
        for patch, model in kept:
            spectrum, floor = binned_spectrum(patch, model)
            power = np.maximum(spectrum[FIRST_RING:].astype(np.float64), _LEAST)
            share = np.repeat(np.clip(1.0 - floor / power.mean(axis=1), 0.0, 1.0), SECTORS)
            shapes = SHAPES * share[:, None]
            covariance = shapes @ prior.spread @ shapes.T
            scatter = (prior.roughness * share) ** 2 + _OWN**2 + (_NOISY * (1.0 - share)) ** 2
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
        blur : ndarray, shape (BINS,)
            Ln |K|².
        by_blur : ndarray, shape (BINS, m)
            Its derivatives.
        amplitudes : ndarray, shape (n,)

        Returns
        -------
        residuals : ndarray, shape (n * BINS,)
        derivatives : ndarray, shape (n * BINS, m + n)
        """
        count, unknowns = len(self.log_power), by_blur.shape[1]
        left = np.zeros((count, BINS))
        change = np.zeros((count, BINS, unknowns + count))
        for i in range(count):
            scene = np.exp(np.clip(amplitudes[i] + self.usual + blur, -60.0, 60.0))
            power = scene + self.noise[i]
            off = np.clip(self.log_power[i] - np.log(power), -_LARGEST_RESIDUAL, _LARGEST_RESIDUAL)
            share = scene / power
            moved = self.whitening[i] @ np.column_stack([off, by_blur * share[:, None], share])
            left[i] = moved[:, 0]
            change[i, :, :unknowns] = -moved[:, 1:-1]
            change[i, :, unknowns + i] = -moved[:, -1]
        return left.ravel(), change.reshape(count * BINS, -1)
