"""Which local spectra occur in photographs: a mixture, as the prior of a likelihood of blur.

The mean spectrum of a whole window does not tell a scene that falls off by itself from a blurred one.
Parts of a window do: some hold an edge, whose power falls with the square of the frequency across it, some
hold texture, some nothing, and how much power goes with which shape is much the same in all sharp
photographs.
With S the periodogram of a small tile behind the blur K, noise of power N, and J components of spectrum
P_j and share s_j, P. Whittle's likelihood of tiles that show one component each is ::

    ln L = sum over tiles of ln sum_j s_j exp( -t sum_f (ln M_j + S / M_j) ),    M_j = g P_j |K|^2 + N

with t = 1/2, since the window couples neighbouring frequencies, and one gain g, the likeliest, for the patch.
The components were learned by expectation maximisation from sharp photographs of the development half
(`lensmodel.lab.training.make_local_spectra`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import NoiseModel, Plane
from lensmodel.estimation.spectra.leakage import Leakage

SIDE: Final = 32
"""Side of a tile, pixels (chosen: small enough to show one thing)."""

COUPLED: Final = 0.5
"""t above (chosen: of two neighbours under the window, one is new)."""

_DATA = Path(__file__).parents[1] / "data" / "local_spectra.npz"
_LOWEST, _HIGHEST = 0.04, 0.5  # cycles/pixel: below, a tile holds no whole period to speak of
_STRIDE = 16  # half a tile: Welch's overlap
_LOG_GAINS: Final = np.linspace(-2.5, 2.5, 11)
"""Natural logarithms of a scene's contrast over the usual: tiles are a twelfth to twelve times as busy; finer
steps cost time (chosen)."""
_FAINTEST = 1e-4  # of |K|^2: leakage and rounding hide what lies below (chosen)

Floats = NDArray[np.float64]

_ROW, _COL = np.meshgrid(fft.fftfreq(SIDE), fft.rfftfreq(SIDE), indexing="ij")
_MODULUS = np.hypot(_ROW, _COL)
# Of two opposite frequencies one is enough; along the borders of the half plane both are there.
_TAKEN = (
    (_MODULUS > _LOWEST) & (_MODULUS <= _HIGHEST) & ~(((_COL == 0.0) | (_COL == _HIGHEST)) & (_ROW < 0.0))
)
FREQUENCIES: Final = int(_TAKEN.sum())
"""How many frequencies of a tile count."""

_HANN = 0.5 - 0.5 * np.cos(2.0 * np.pi * (np.arange(SIDE) + 0.5) / SIDE)  # von Hann's window
_WINDOW = _HANN[:, None] * _HANN
_LEAKAGE = Leakage.of(SIDE)


def periodograms(patch: Plane, stride: int = _STRIDE) -> Floats:
    """Power of Hann-windowed tiles at the frequencies that count, shape (tiles, FREQUENCIES).

    Parameters
    ----------
    patch : Plane, shape (h, w)
    stride : int
        From tile to tile, pixels.
    """
    tiles = sliding_window_view(patch.astype(np.float64), (SIDE, SIDE))[::stride, ::stride]
    tiles = tiles.reshape(-1, SIDE, SIDE)
    means = (tiles * _WINDOW).sum(axis=(1, 2), keepdims=True) / _WINDOW.sum()
    transform = fft.rfft2((tiles - means) * _WINDOW, axes=(1, 2))[:, _TAKEN]
    return np.asarray(transform.real**2 + transform.imag**2, dtype=np.float64) / float((_WINDOW**2).sum())


def _leaked(power: Floats) -> Floats:
    """Power as seen through the window of a tile, (..., SIDE, SIDE // 2 + 1) to (..., FREQUENCIES)."""
    return np.asarray(_LEAKAGE.seen(power)[..., _TAKEN], dtype=np.float64)


_OPEN = _leaked(np.ones((SIDE, SIDE // 2 + 1)))  # what leaks where the transfer function is 1 everywhere


def local_power(kernel: Floats) -> Floats:
    """|K|² at the frequencies of a tile, shape (FREQUENCIES,), of a kernel of at most 64 x 64."""
    transform = fft.rfft2(kernel, (2 * SIDE, 2 * SIDE))[::2, ::2]
    return np.maximum(_leaked(transform.real**2 + transform.imag**2) / _OPEN, 0.0) + _FAINTEST


def log_local_power(kernel: Floats, changes: Floats) -> tuple[Floats, Floats]:
    """Ln |K|² at the frequencies of a tile, shape (FREQUENCIES,), and its derivatives, (FREQUENCIES, n).

    Parameters
    ----------
    kernel : ndarray, shape (k, k)
        k at most 63.
    changes : ndarray, shape (n, k, k)
        Derivatives of the kernel.
    """
    transform = fft.rfft2(np.concatenate([kernel[None], changes]), (2 * SIDE, 2 * SIDE))[:, ::2, ::2]
    crossed = transform.real * transform[0].real + transform.imag * transform[0].imag
    power = _leaked(crossed) / _OPEN
    value = np.maximum(power[0], 0.0) + _FAINTEST
    return np.log(value), (2.0 * power[1:] / value).T


@dataclass(frozen=True, slots=True, eq=False)
class SpectrumMixture:
    """The components.

    Parameters
    ----------
    power : ndarray of float32, shape (J, FREQUENCIES)
        P_j, of windows of unit variance.
    share : ndarray of float32, shape (J,)
        s_j, of sum 1.
    """

    power: NDArray[np.float32]
    share: NDArray[np.float32]

    @classmethod
    @lru_cache(maxsize=1)
    def load(cls) -> SpectrumMixture:
        """Read what `lensmodel.lab.training.make_local_spectra` wrote."""
        with np.load(_DATA, allow_pickle=False) as stored:
            return cls(np.exp(stored["log_power"].astype(np.float32)), stored["share"].astype(np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class LocalSpectra:
    """Tiles of several patches behind one blur.

    Parameters
    ----------
    periodograms : tuple of ndarray of float32, each (tiles, FREQUENCIES)
        Periodograms of each patch, over the variance of its signal.
    noise : tuple of float
        Power of the noise of each patch in the same units.
    mixture : SpectrumMixture
    """

    periodograms: tuple[NDArray[np.float32], ...]
    noise: tuple[float, ...]
    mixture: SpectrumMixture

    @classmethod
    def of(
        cls, kept: Sequence[tuple[Plane, NoiseModel]], mixture: SpectrumMixture | None = None
    ) -> LocalSpectra:
        """Measure patches."""
        power, floors = [], []
        for patch, model in kept:
            noise = model.sigma_at(float(patch.mean())) ** 2
            scale = max(float(patch.var(dtype=np.float64)) - noise, 1e-12)
            power.append((periodograms(patch) / scale).astype(np.float32))
            floors.append(max(noise / scale, 1e-9))
        return cls(tuple(power), tuple(floors), mixture or SpectrumMixture.load())

    def likelihood(self, power: Floats) -> float:
        """Ln L behind a blur of this power, summed over patches, each at its likeliest gain."""
        scaled = [self.mixture.power * (gain * power).astype(np.float32) for gain in np.exp(_LOG_GAINS)]
        return sum(max(self._patch(i, signal) for signal in scaled) for i in range(len(self.periodograms)))

    def _patch(self, i: int, signal: NDArray[np.float32]) -> float:
        """Ln L of one patch with components of these powers."""
        inverse = 1.0 / (signal + np.float32(self.noise[i]))
        logs = np.log(self.mixture.share) + COUPLED * np.log(inverse).sum(axis=1)
        scores = logs - COUPLED * (self.periodograms[i] @ inverse.T)
        most = scores.max(axis=1, keepdims=True)
        return float((most + np.log(np.exp(scores - most).sum(axis=1, keepdims=True))).sum(dtype=np.float64))

    def pull(self, i: int, log_power: Floats) -> tuple[float, Floats, Floats]:
        """Ln L of one patch behind a blur of this log power, gain included, its slope and its curvature.

        Returns
        -------
        value : float
        slope : ndarray, shape (FREQUENCIES,)
            Derivative by ln power at each frequency.
        curvature : ndarray, shape (FREQUENCIES,)
            Fisher information of ln power, the components of the tiles given.
        """
        signal = self.mixture.power * np.exp(log_power).astype(np.float32)
        inverse = 1.0 / (signal + np.float32(self.noise[i]))
        logs = np.log(self.mixture.share) + COUPLED * np.log(inverse).sum(axis=1)
        scores = logs - COUPLED * (self.periodograms[i] @ inverse.T)
        most = scores.max(axis=1, keepdims=True)
        responsibilities = np.exp(scores - most)
        total = responsibilities.sum(axis=1, keepdims=True)
        value = float((most + np.log(total)).sum(dtype=np.float64))
        responsibilities /= total
        count, power = responsibilities.sum(axis=0)[:, None], responsibilities.T @ self.periodograms[i]
        part = signal * inverse
        slope = COUPLED * (part * (power * inverse - count)).sum(axis=0, dtype=np.float64)
        curvature = COUPLED * (count * part**2).sum(axis=0, dtype=np.float64)
        return value, slope, curvature

    def gains(self, log_power: Floats) -> Floats:
        """Log gain of each patch, the likeliest of a few, behind a blur of this log power."""
        scaled = [self.mixture.power * np.exp(log_power + step).astype(np.float32) for step in _LOG_GAINS]
        best = [
            int(np.argmax([self._patch(i, signal) for signal in scaled]))
            for i in range(len(self.periodograms))
        ]
        return np.asarray(_LOG_GAINS[best], dtype=np.float64)
