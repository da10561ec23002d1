"""Power of a patch in rings and sectors of frequency, and whether the patch repeats itself."""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are needed: processes that compute nothing do not wait
from numpy.typing import NDArray

from lensmodel.core.types import NoiseModel, Plane

# Bins (chosen): a ring is a fifth wider than the one within it, a sector is 15 degrees of half a turn.
RINGS: Final = 14
SECTORS: Final = 12

RING_LIMITS: Final = (0.03, 0.5)
"""Frequencies of the innermost and outermost ring, cycles/pixel; rings are equally wide in log."""

RING_EDGES: Final = np.geomspace(*RING_LIMITS, RINGS + 1)
"""Frequencies between the rings and at both ends, cycles/pixel."""

_TILE = 64  # pixels of a tile: two periods of the innermost ring; larger ones leave fewer to average (chosen)
_CORE_PX = (2, 4)  # nearer than this neighbours are alike: for the valley, for the peak
_REPEATS = (-0.4, 0.9)  # correlation at the valley and the peak of what repeats


def binned_spectrum(patch: Plane, noise: NoiseModel) -> tuple[NDArray[np.float32], float]:
    """Mean periodogram of Hann-windowed 64 px tiles at half overlap, in rings and sectors.

    Returns
    -------
    spectrum : ndarray of float32, shape (RINGS, SECTORS)
        Power per pixel of the window, noise included; frequencies 0.03 to 0.5 cycles/pixel.
    floor : float
        Power of the noise alone.
    """
    side = min(_TILE, *patch.shape)
    hann = 0.5 - 0.5 * np.cos(2 * np.pi * (np.arange(side) + 0.5) / side)
    window = hann[:, None] * hann[None, :]
    energy = float((window**2).sum())
    total = np.zeros((side, side // 2 + 1))
    count = 0
    for row in range(0, patch.shape[0] - side + 1, side // 2):
        for col in range(0, patch.shape[1] - side + 1, side // 2):
            tile = patch[row : row + side, col : col + side].astype(np.float64)
            total += np.abs(scipy.fft.rfft2((tile - tile.mean()) * window)) ** 2
            count += 1
    power = total / (count * energy)
    f_row, f_col = np.meshgrid(scipy.fft.fftfreq(side), scipy.fft.rfftfreq(side), indexing="ij")
    frequency, angle = np.hypot(f_row, f_col), np.mod(np.arctan2(f_row, f_col), np.pi)
    ring = np.searchsorted(RING_EDGES, frequency, side="right") - 1
    sector = np.minimum((angle / np.pi * SECTORS).astype(int), SECTORS - 1)
    spectrum = np.zeros((RINGS, SECTORS), dtype=np.float32)
    for i in range(RINGS):
        in_ring = ring == i
        mean = float(power[in_ring].mean()) if in_ring.any() else 0.0
        for j in range(SECTORS):
            bin_ = in_ring & (sector == j)
            spectrum[i, j] = float(power[bin_].mean()) if bin_.any() else mean
    return spectrum, float(noise.sigma_at(float(patch.mean())) ** 2)


def repeats(patch: Plane) -> bool:
    """Whether a patch repeats itself like a fence or an arcade, so that no blur can be told from it.

    Its autocorrelation then falls far below zero and comes back nearly to one.
    """
    power = np.abs(scipy.fft.rfft2((patch - patch.mean()).astype(np.float64))) ** 2
    correlation = scipy.fft.irfft2(power, s=patch.shape)
    if not correlation[0, 0] > 0:
        return False
    correlation /= correlation[0, 0]
    rows, cols = (np.minimum(np.arange(n), n - np.arange(n)) for n in patch.shape)
    gap = np.hypot(rows[:, None], cols[None, :])
    reach = gap < min(patch.shape) // 3
    valley = float(correlation[(gap > _CORE_PX[0]) & reach].min())
    peak = float(correlation[(gap > _CORE_PX[1]) & reach].max())
    return valley < _REPEATS[0] and peak > _REPEATS[1]
