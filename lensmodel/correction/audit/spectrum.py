"""Spectrum: power at high frequencies, and lines near the limit of the grid."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.types import Plane
from lensmodel.correction.audit import blocks
from lensmodel.correction.audit.check import Severity, TilePair
from lensmodel.correction.audit.tolerances import LIMITS

SLOPE: Final = 2.2
"""Power of natural pictures falls as |f|^-2.2. Source: A. Torralba, A. Oliva, "Statistics of natural image
categories", Network 14, 2003: 1.9 to 2.6 by category."""

SIDE, HOP = 32, 16
"""Side of the windows in pixels, and the step between them, so that each pixel lies in four (chosen: smaller
windows do not hold two periods of the low band, larger ones mix places of the picture)."""
_LOW: Final = (0.05, 0.11)
_HIGHER: Final = ((0.18, 0.28), (0.3, 0.45))
"""Bands in cycles/pixel (chosen: lenses leave the first alone, it holds 2 to 3 periods of a window; the
others begin where lenses do take away, and end short of the limit of the grid)."""
_LIMIT: Final = 0.29
"""Frequency along an axis beyond which to look for lines, cycles/pixel: periods below 3.5 pixels (chosen)."""
_SHARES: Final = tuple(np.float32((sum(band) / sum(_LOW)) ** -SLOPE) for band in _HIGHER)
"""Power predicted in each of the higher bands, over that in the low one."""
_SECTORS: Final = 4  # directions: along, across and both diagonals
_NOISE: Final = 4.0
"""Times the noise's power, below which no slope is seen (chosen: with less, noise that a correction amplifies
would count as detail that no slope foretells; with more, faint false detail would pass)."""


def overcorrected(pair: TilePair) -> Severity:
    """Severity of power at higher frequencies beyond what the photo's lower ones predict, by direction.

    With the power Y of the photo, X of the result and n of the noise in windows of 32 pixels::

        s² = X(band) / ( (f_band / f_low)^-2.2 Y(low) + 4 n )

    the largest of two bands and four directions.
    """
    powers = _powers(pair)
    was, now = _around(powers.original), _around(powers.corrected)
    noise = np.float32(_NOISE) * _around(powers.noise)
    worst = np.zeros(noise.shape, dtype=np.float32)
    for first in range(0, len(was), 1 + len(_HIGHER)):
        for k, share in enumerate(_SHARES, start=first + 1):
            np.maximum(worst, now[k] / (share * was[first] + noise), out=worst)
    return _severity(worst, LIMITS["spectrum"])


def comb(pair: TilePair) -> Severity:
    """Severity of lines near the limit of the grid that the photo does not have.

    A line is a frequency that stands out of the geometric mean of its band, to which a few lines add
    little; to the extent that it does so in the photo, it belongs to the scene.
    """
    return _severity(_powers(pair).line, LIMITS["comb"])


@dataclass(frozen=True, slots=True, eq=False)
class _Powers:
    """Power in overlapping windows of the mean of the colours.

    Parameters
    ----------
    original, corrected : ndarray of float32, shape (bands, down, across)
        Means over the bands: of each direction the low one, then the higher ones.
    noise : ndarray of float32, shape (down, across)
        That of white noise.
    line : ndarray of float32, shape (down, across)
        The largest line near the limit of the grid over its band, and over what it is in the photo.
    """

    original: NDArray[np.float32]
    corrected: NDArray[np.float32]
    noise: NDArray[np.float32]
    line: NDArray[np.float32]


def _powers(pair: TilePair) -> _Powers:
    """Powers of a pair, computed once."""
    if "powers" not in pair.memo:
        variance = blocks.sums(np.square(pair.luma_sigma))
        level = blocks.to_pixels(variance, pair.shape, first=(blocks.SIDE - 1) / 2.0, step=blocks.SIDE)
        energy = np.float32(np.square(_window()).sum() / blocks.SIDE**2)
        noise = level[np.ix_(*(_middles(extent) for extent in pair.shape))] * energy
        pair.memo["powers"] = _measured(pair, noise)
    powers: _Powers = pair.memo["powers"]
    return powers


def _measured(pair: TilePair, noise: NDArray[np.float32]) -> _Powers:
    labels, edge = _labels(), _near_limit()
    planes = _whole_windows(pair.luma)
    if pair.loops is not None:
        bands = np.empty((2, labels.max() + 1, *noise.shape), dtype=np.float32)
        line = np.empty_like(noise)
        order, starts = _bands()
        pair.loops.powers(planes, HOP, _window(), order, starts, np.flatnonzero(edge), noise, bands, line)
        return _Powers(bands[0], bands[1], noise, line)
    was, now = (_power(plane) for plane in planes)
    means = [
        np.stack([power[..., labels == band].mean(axis=-1) for band in range(labels.max() + 1)])
        for power in (was, now)
    ]
    before, after = was[..., edge], now[..., edge]
    line_before = before / _level(before + noise[..., None])
    line_after = after / _level(after + noise[..., None])
    line = (line_after / np.maximum(line_before, np.float32(1.0))).max(axis=-1)
    return _Powers(means[0], means[1], noise, line)


def _around(figures: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sum over the 3 x 3 windows around each, the near ones twice: about 64 pixels, as wide as `blocks`'."""
    wide = np.pad(figures, [(0, 0)] * (figures.ndim - 2) + [(1, 1), (1, 1)])
    down = wide[..., :-2, :] + np.float32(2.0) * wide[..., 1:-1, :] + wide[..., 2:, :]
    return np.asarray(down[..., :-2] + np.float32(2.0) * down[..., 1:-1] + down[..., 2:])


def _level(power: NDArray[np.float32]) -> NDArray[np.float32]:
    """Geometric mean over the last axis."""
    logarithms = np.log(np.maximum(power, np.float32(1e-20)))
    return np.asarray(np.exp(logarithms.mean(axis=-1, keepdims=True)))


def _power(plane: Plane) -> NDArray[np.float32]:
    """Power spectra of overlapping windows, `(down, across, frequencies)`."""
    values = np.lib.stride_tricks.sliding_window_view(plane, (SIDE, SIDE))[::HOP, ::HOP]
    values = (values - values.mean(axis=(-1, -2), keepdims=True)) * _window()
    amplitude = fft.rfft2(values)
    power = np.square(amplitude.real) + np.square(amplitude.imag)
    return np.asarray(power, dtype=np.float32).reshape(*power.shape[:2], -1)


def _beyond(extent: int) -> int:
    """Pixels missing to make whole windows."""
    return max(SIDE - extent, (SIDE - extent) % HOP)


def _whole_windows(planes: NDArray[np.float32]) -> NDArray[np.float32]:
    """Planes whose last windows end at the rim; missing pixels are mirrored."""
    pads = [(0, _beyond(extent)) for extent in planes.shape[1:]]
    return np.pad(planes, [(0, 0), *pads], mode="symmetric") if any(after for _, after in pads) else planes


@lru_cache(maxsize=64)
def _middles(extent: int) -> NDArray[np.intp]:
    """Pixels in the middles of the windows, mirrored like them."""
    whole = np.pad(np.arange(extent), (0, _beyond(extent)), mode="symmetric")
    return np.asarray(whole[SIDE // 2 : len(whole) - SIDE // 2 + 1 : HOP])


@lru_cache(maxsize=1)
def _window() -> NDArray[np.float32]:
    t = np.sin(np.pi * (np.arange(SIDE) + 0.5) / SIDE) ** 2
    return np.outer(t, t).astype(np.float32)


def _frequencies() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    down, across = np.meshgrid(fft.fftfreq(SIDE), fft.rfftfreq(SIDE), indexing="ij")
    return down, across


@lru_cache(maxsize=1)
def _labels() -> NDArray[np.int64]:
    """Band of each frequency, direction by direction the low one and then the higher ones; -1 for none."""
    down, across = _frequencies()
    radius, angle = np.hypot(down, across), np.arctan2(down, across)
    labels = np.full(radius.shape, -1, dtype=np.int64)
    bands = (_LOW, *_HIGHER)
    for k in range(_SECTORS):
        off = np.abs((angle - k * np.pi / _SECTORS + np.pi / 2) % np.pi - np.pi / 2)
        sector = off <= np.pi / (2 * _SECTORS)  # none lies on the border of two
        for n, (low, high) in enumerate(bands):
            labels[sector & (radius > low) & (radius < high)] = k * len(bands) + n
    return labels.ravel()


@lru_cache(maxsize=1)
def _bands() -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Frequencies band by band, and where each band begins; the last one is the end."""
    labels = _labels()
    members = [np.flatnonzero(labels == band) for band in range(labels.max() + 1)]
    return np.concatenate(members), np.cumsum([0, *map(len, members)])


@lru_cache(maxsize=1)
def _near_limit() -> NDArray[np.bool_]:
    down, across = _frequencies()
    return np.asarray(np.maximum(abs(down), abs(across)) >= _LIMIT).ravel()


def _severity(power: NDArray[np.floating], limit: float) -> Severity:
    return Severity((np.sqrt(power) / limit).astype(np.float32), HOP, (SIDE - 1) / 2.0)
