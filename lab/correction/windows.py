"""Windows that overlap and sum to one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError


def bartlett_hann(length: int) -> NDArray[np.float64]:
    """Bartlett-Hann window sampled at half-integers, so that it tiles exactly at half overlap.

    With s = (n + 1/2) / length::

        w(s) = 0.62 - 0.48 |s - 1/2| - 0.38 cos(2 pi s),    w(s) + w(s + 1/2) = 1

    The symmetric variant with both end points does not sum to one.
    """
    if length < 2 or length % 2:
        raise InvalidInputError(f"a window that overlaps by half needs an even length >= 2, got {length}")
    s = (np.arange(length) + 0.5) / length
    return np.asarray(0.62 - 0.48 * np.abs(s - 0.5) - 0.38 * np.cos(2.0 * np.pi * s))


def partition(extent: int, parts: int) -> tuple[tuple[int, NDArray[np.float64]], ...]:
    """Cut `extent` pixels into `parts` overlapping windows that sum to one at every pixel.

    Centres lie evenly at (i + 1/2) extent / parts; between neighbouring centres one window
    falls as a Bartlett-Hann half while the next rises. The outer windows stay flat to the border.

    Returns
    -------
    tuple of (start, window)
        `window[j]` is the weight at pixel `start + j`.
    """
    if not 1 <= parts <= extent:
        raise InvalidInputError(f"{extent} pixels cannot be cut into {parts} windows")
    centres = (np.arange(parts) + 0.5) * extent / parts - 0.5
    t = np.arange(extent, dtype=np.float64)
    pieces = []
    for i in range(parts):
        weight = np.ones(extent)
        if i > 0:
            weight *= _rise((t - centres[i - 1]) / (centres[i] - centres[i - 1]))
        if i < parts - 1:
            weight *= 1.0 - _rise((t - centres[i]) / (centres[i + 1] - centres[i]))
        inside = np.flatnonzero(weight > 0.0)
        start, stop = int(inside[0]), int(inside[-1]) + 1
        pieces.append((start, weight[start:stop]))
    return tuple(pieces)


def _rise(s: NDArray[np.float64]) -> NDArray[np.float64]:
    """Left half of the Bartlett-Hann window, stretched onto 0..1, flat outside.

    The closed form is 0 at s = 0 and 1 at s = 1, with rise(s) + rise(1 - s) = 1.
    """
    half = 0.5 * np.clip(s, 0.0, 1.0)
    return np.asarray(0.62 - 0.48 * (0.5 - half) - 0.38 * np.cos(2.0 * np.pi * half))
