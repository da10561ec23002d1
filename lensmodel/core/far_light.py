"""Light that a lens throws far from the core of its blur: what shape it has, and how a kernel gets it.

Spherical aberration of higher order and the aberrations of oblique rays spread up to half of the light over
ten pixels and more, as a veil around everything bright. Spectra do not show it: where they begin, it has
faded, and what is left looks like a scene of less contrast.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

NEAR, FAR = 3.5, 18.0
"""Pixels: where far light begins and ends (chosen: outside the core that spectra tell, and as ray-traced
designs of development fall off in the mean)."""

SIDE: Final = 2 * int(FAR) + 1
"""Pixels of a side that hold all of it."""


def far_profile(size: int = SIDE) -> NDArray[np.float64]:
    """Far light of sum 1 around a point: as much at each radius as 1 - r / FAR, shape (size, size).

    Of a size below `SIDE` the middle alone, whose sum is less than 1.
    """
    half = max(size, SIDE) // 2
    t = np.arange(-half, half + 1)
    r = np.hypot(t[:, None], t[None, :])
    light = np.where((r >= NEAR) & (r < FAR), (1.0 - r / FAR) / np.maximum(r, 1.0), 0.0)
    cut = half - size // 2
    return np.asarray((light / light.sum())[cut : 2 * half + 1 - cut, cut : 2 * half + 1 - cut])


def with_far_light(kernels: NDArray[np.float64], shares: NDArray[np.float64]) -> NDArray[np.float64]:
    """Kernels of sum 1 of which some shares lie far away, shape (n, size, size).

    Parameters
    ----------
    kernels : ndarray, shape (n, size, size)
        Of odd size, of sum 1.
    shares : ndarray, shape (n,)
        0..1; what falls outside a small kernel is left out, and the rest has the sum 1 again.
    """
    if not shares.any():
        return kernels
    part = shares[:, None, None]
    spread = (1.0 - part) * kernels + part * far_profile(kernels.shape[1])
    return np.asarray(spread / spread.sum(axis=(1, 2), keepdims=True))
