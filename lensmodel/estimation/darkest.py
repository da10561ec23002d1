r"""How dark a photo gets beside what is bright: a bound on the light that its lens throws far.

Where the scene is black, all light that is seen comes from elsewhere. With g the usual shape of far light
(`lensmodel.core.far_light`), h its share and x the scene,

    y(p) >= h (g * x)(p),        so that        h <= min over p of  y(p) / (g * y)(p)

since g hardly sees the difference between the scene and its photo. No scene is quite black, so the least
ratio is a bound, near the truth where it shows deep shadows. A photo out of focus, or of haze, shows none and
says little. Where far light ends sooner than g does, the middle of a wide shadow has less of it, and its
share comes out too small, which is the safe side. The smallest ratios of all are of noise; so each is a mean
over 3 x 3 pixels, one is taken in each block, and one in a hundred blocks may lie lower.
"""

from __future__ import annotations

from typing import Final

import numpy as np
import scipy  # its parts are loaded when they are needed

from lensmodel.core.far_light import SIDE, far_profile
from lensmodel.core.types import Plane

REACH: Final = 256  # pixels to all sides of a place that are looked at (chosen: some things of a scene)
_BLOCK: Final = 12  # pixels of a side: blocks apart by that do not show the same shadow (chosen)
_SHADOW: Final = 3  # pixels of a side of the mean (chosen: a third of the noise)
_LEAST_LIGHT: Final = 0.02  # around a place, full scale is 1: below, black level and noise decide (chosen)
_FEWEST_BLOCKS: Final = 100  # below, one in a hundred is none, and chance decides (chosen)
_LOWEST: Final = 3  # so many blocks may lie lower at least (chosen: no dead pixel decides)
_CLIPPED: Final = 0.95  # of the level where a sensor clips (chosen): light beyond is not seen
_MOST_CLIPPED: Final = 0.01
"""Share of the pixels around a place: more hide light that the bound would be too large without (chosen)."""


def darkest_share(plane: Plane, clip: float, row: int, col: int) -> float | None:
    """The least light at a place around (row, col) over that within reach of far light.

    Parameters
    ----------
    plane : Plane, shape (H, W)
        Linear light, full scale 1.
    clip : float
        Level where it clips.
    row, col : int
        Middle of the part that is looked at.

    Returns
    -------
    float or None
        0 or more; None where too little is bright, or too much is clipped.
    """
    rim = SIDE // 2
    top, left = max(row - REACH - rim, 0), max(col - REACH - rim, 0)
    part = np.asarray(plane[top : row + REACH + rim, left : col + REACH + rim], dtype=np.float32)
    if min(part.shape) < SIDE + _BLOCK:
        return None
    inner = (slice(rim, part.shape[0] - rim), slice(rim, part.shape[1] - rim))
    around = _convolved(part, far_profile().astype(np.float32))[inner]
    shadow = scipy.ndimage.uniform_filter(part, _SHADOW)[inner]
    lost = scipy.ndimage.uniform_filter((part >= _CLIPPED * clip).astype(np.float32), SIDE)[inner]
    ratio = np.where(
        (around >= _LEAST_LIGHT) & (lost < _MOST_CLIPPED), shadow / np.maximum(around, _LEAST_LIGHT), np.inf
    )
    rows, cols = (n // _BLOCK for n in ratio.shape)
    blocks = ratio[: rows * _BLOCK, : cols * _BLOCK].reshape(rows, _BLOCK, cols, _BLOCK).min(axis=(1, 3))
    seen = np.sort(blocks[np.isfinite(blocks)])
    if len(seen) < _FEWEST_BLOCKS:
        return None
    return max(float(seen[max(_LOWEST, len(seen) // 100)]), 0.0)


def _convolved(plane: Plane, kernel: Plane) -> Plane:
    """The plane convolved with a kernel about its middle; wrong within half a kernel of the rim."""
    shape = [scipy.fft.next_fast_len(n, real=True) for n in plane.shape]
    padded = np.zeros(shape, dtype=np.float32)
    padded[: kernel.shape[0], : kernel.shape[1]] = kernel
    H = scipy.fft.rfft2(np.roll(padded, (-(kernel.shape[0] // 2), -(kernel.shape[1] // 2)), axis=(0, 1)))
    convolved = scipy.fft.irfft2(scipy.fft.rfft2(plane, shape) * H, shape)
    return np.asarray(convolved[: plane.shape[0], : plane.shape[1]])
