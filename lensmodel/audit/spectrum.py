"""Spectrum: power at high frequencies, and lines near the limit of the grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.audit import blocks
from lensmodel.audit.base import Pair, Severity
from lensmodel.audit.limits import LIMITS
from lensmodel.types import Plane

SLOPE: Final = 2.2
"""Power of natural pictures falls as |f|^-2.2. Source: A. Torralba, A. Oliva, "Statistics of natural image
categories", Network 14, 2003: 1.9 to 2.6 by category."""

SIDE, HOP = 32, 16
"""Side of the windows in pixels, and the way from one to the next, so that each pixel lies in four."""
_LOW: Final = (0.05, 0.11)
_HIGHER: Final = ((0.18, 0.28), (0.3, 0.45))
"""Bands in cycles/pixel. Lenses leave the first alone; it holds 2 to 3 periods of a window."""
_LIMIT: Final = 0.29
"""Frequency along an axis beyond which lines are looked for: periods below 3.5 pixels."""
_SECTORS: Final = 4
_NOISE: Final = 4.0
_NEAR: Final = np.outer([1.0, 2.0, 1.0], [1.0, 2.0, 1.0]).astype(np.float32)


def overcorrected(pair: Pair) -> Severity:
    """Severity of power at higher frequencies beyond what the photo's lower ones foretell, by direction.

    With the power Y of the photo, X of the result and n of the noise in windows of 32 pixels::

        s² = X(band) / ( (f_band / f_low)^-2.2 Y(low) + 4 n )

    the largest of two bands and four directions.
    """
    power = _spectra(pair)
    worst = np.zeros(power.noise.shape, dtype=np.float32)
    for low, bands in _masks():
        base = _around(power.original[..., low].mean(axis=-1))
        for band, share in bands:
            foretold = share * base + np.float32(_NOISE) * _around(power.noise)
            made = _around(power.corrected[..., band].mean(axis=-1))
            worst = np.maximum(worst, made / foretold)
    return _severity(worst, LIMITS["spectrum"])


def comb(pair: Pair) -> Severity:
    """Severity of lines near the limit of the grid that the photo has not.

    A line is a frequency that stands out of the geometric mean of its band, to which a few lines add
    little; as far as it does so in the photo, it belongs to the scene.
    """
    power, edge = _spectra(pair), _near_limit()
    noise = power.noise[..., None]
    was, now = power.original[..., edge], power.corrected[..., edge]
    own = was / _level(was + noise)
    made = now / _level(now + noise)
    line = (made / np.maximum(own, np.float32(1.0))).max(axis=-1)
    return _severity(line, LIMITS["comb"])


@dataclass(frozen=True, slots=True, eq=False)
class _Spectra:
    """Power in overlapping windows of the mean of the colours, before and after, and that of white noise."""

    original: NDArray[np.float32]
    corrected: NDArray[np.float32]
    noise: NDArray[np.float32]


def _spectra(pair: Pair) -> _Spectra:
    """Power of a pair, made once."""
    if "spectra" not in pair.memo:
        variance = blocks.sums(np.square(pair.luma_sigma))
        level = blocks.to_pixels(variance, pair.shape, first=(blocks.SIDE - 1) / 2.0, step=blocks.SIDE)
        energy = np.float32(np.square(_window()).sum() / blocks.SIDE**2)
        noise = _windows(level)[..., SIDE // 2, SIDE // 2] * energy
        pair.memo["spectra"] = _Spectra(_power(pair.luma[0]), _power(pair.luma[1]), noise)
    spectra: _Spectra = pair.memo["spectra"]
    return spectra


def _around(figures: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over the 3 x 3 windows around each, the near ones twice: some 64 pixels, as wide as `blocks`'."""
    return np.asarray(ndimage.correlate(figures, _NEAR, mode="constant"))


def _level(power: NDArray[np.float32]) -> NDArray[np.float32]:
    """Geometric mean over the last axis."""
    logarithms = np.log(np.maximum(power, np.float32(1e-20)))
    return np.asarray(np.exp(logarithms.mean(axis=-1, keepdims=True)))


def _power(plane: Plane) -> NDArray[np.float32]:
    values = _windows(plane)
    values = (values - values.mean(axis=(-1, -2), keepdims=True)) * _window()
    amplitude = fft.rfft2(values)
    return np.asarray(np.square(amplitude.real) + np.square(amplitude.imag), dtype=np.float32)


def _windows(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Overlapping windows, `(down, across, 32, 32)`; the last ones see the rim mirrored where it ends."""
    pads = [(0, max(SIDE - extent, (SIDE - extent) % HOP)) for extent in plane.shape]
    if any(after for _, after in pads):
        plane = np.pad(plane, pads, mode="symmetric")
    return np.lib.stride_tricks.sliding_window_view(plane, (SIDE, SIDE))[::HOP, ::HOP]


@lru_cache(maxsize=1)
def _window() -> NDArray[np.float32]:
    t = np.sin(np.pi * (np.arange(SIDE) + 0.5) / SIDE) ** 2
    return np.outer(t, t).astype(np.float32)


def _frequencies() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    down, across = np.meshgrid(fft.fftfreq(SIDE), fft.rfftfreq(SIDE), indexing="ij")
    return down, across


_Band = tuple[NDArray[np.bool_], np.float32]


@lru_cache(maxsize=1)
def _masks() -> tuple[tuple[NDArray[np.bool_], tuple[_Band, ...]], ...]:
    """Per direction the low band, and the higher ones with the share of its power that they should have."""
    down, across = _frequencies()
    radius, angle = np.hypot(down, across), np.arctan2(down, across)

    def ring(band: tuple[float, float]) -> NDArray[np.bool_]:
        return np.asarray((radius > band[0]) & (radius < band[1]))

    found = []
    for k in range(_SECTORS):
        off = np.abs((angle - k * np.pi / _SECTORS + np.pi / 2) % np.pi - np.pi / 2)
        sector = off <= np.pi / (2 * _SECTORS) + 1e-6
        bands = tuple(
            (ring(band) & sector, np.float32((sum(band) / sum(_LOW)) ** -SLOPE)) for band in _HIGHER
        )
        found.append((ring(_LOW) & sector, bands))
    return tuple(found)


@lru_cache(maxsize=1)
def _near_limit() -> NDArray[np.bool_]:
    down, across = _frequencies()
    return np.asarray(np.maximum(abs(down), abs(across)) >= _LIMIT)


def _severity(power: NDArray[np.floating], limit: float) -> Severity:
    return Severity((np.sqrt(power) / limit).astype(np.float32), HOP, (SIDE - 1) / 2.0)
