"""How far a correction may leave the two levels between which an edge steps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Planes

_BEYOND: Final = 0.06
"""Share of a clean step by which a result may leave its plateaus: half of what shows as a halo, which leaves
the other half for grain and the mixture of colours in the picture (chosen)."""

_UNSURE: Final = 0.1
"""Error of a kernel below which more is allowed: what a certain one shows beside an edge was there
(chosen)."""

_UNEVEN: Final = 0.4
"""Spread of a plateau, as a share of the step, at which a whole step is allowed: noise and a slope change
little at a third of it, and texture, which spreads over 0.7, is practically free (chosen)."""

_GAMMA: Final = 2.2
"""Steps are compared as they are seen, by about the power of sRGB (IEC 61966-2-1), so that a dark line,
hardly any of the light, is not overlooked."""

_NEAREST, _FURTHEST = 6, 16
"""Least and greatest reach of the windows in which plateaus are looked for, pixels (chosen: with less, even
sharp edges show no plateau; the cost grows with the square, and far levels belong to other things)."""

_DENSE: Final = 8
"""Reach of windows up to which every pixel is used, beyond it every second along a side: a blur so wide
leaves no line between them (chosen)."""

_ENDS: Final = (0.03, 0.18)
"""Quantiles between which a plateau lies: what is rarer than the first is a speck. Either side of an edge
half a blur away has more than the second, and a line that is narrower than its blur less (chosen)."""

_AT_ONCE: Final = 4096
"""Windows in memory at once (chosen: 5 MB of the largest, and calls that still cost little beside the
work)."""


def plateau_reach(spread: int) -> int:
    """Margin in pixels around a tile that `plateaus_held` needs for a blur that spreads light so far."""
    return _window(spread) + 1


def plateau_share(error: float) -> float:
    """Share of a clean step by which a result may leave it, for a kernel with a relative error."""
    return _BEYOND * max((_UNSURE / error) ** 2, 1.0) if error > 0.0 else float("inf")


def plateaus_held(photo: Planes, restored: Planes, errors: Sequence[float], spread: int) -> Planes:
    """Hold a result between the plateaus of a step, widened by a share of it.

    A kernel that is too wide gives an edge a halo. The photo's range within two pixels bounds that by the
    step or more; but where an edge steps from one even level to another, beyond the reach of the blur on
    both sides, there was only light between them. With q the quantiles of a window of the photo as
    seen (the power 1 / 2.2 of its light, a mean of 3 x 3 pixels against noise)::

        step = q82 - q18,    u = max( q18 - q3, q97 - q82 ) / step
        q3 - ( s + (u / 0.4)⁴ ) step  <=  x  <=  q97 + ( s + (u / 0.4)⁴ ) step

    Where there is a line, a corner or texture in the window, u is large and the bound is wide: what blur
    hid there must come back. So it is where noise is as large as the step.

    Parameters
    ----------
    photo : Planes, shape (channels, rows + 2 m, cols + 2 m)
        With m = `plateau_reach` pixels around.
    restored : Planes, shape (channels, rows, cols)
        The correction of its middle.
    errors : sequence of float
        Expected relative L2 errors of the kernels; 0 for no bound.
    spread : int
        How far the blur spreads light, pixels.

    Returns
    -------
    Planes
    """
    held = restored
    for c, error in enumerate(errors):
        if error > 0.0:
            if held is restored:
                held = np.array(restored, dtype=np.float32)
            _hold(photo[c], held[c], plateau_share(error), _window(spread))
    return held


def _hold(photo: NDArray[np.floating], corrected: NDArray[np.float32], share: float, reach: int) -> None:
    """Hold a plane, in place."""
    level = ndimage.uniform_filter(_as_seen(photo), 3, mode="nearest")
    shown = _as_seen(corrected)
    margin = reach + 1
    inner = (slice(margin, -margin), slice(margin, -margin))
    low, high = (f(level, 2 * reach + 1)[inner] for f in (ndimage.minimum_filter, ndimage.maximum_filter))
    room = np.float32(0.5 * share) * (high - low)
    rows, cols = np.nonzero((shown > high + room) | (shown < low - room))
    if rows.size == 0:
        return
    steps = np.arange(0, 2 * reach + 1, 1 if reach <= _DENSE else 2) + 1
    down, across = (grid.ravel()[:, None] for grid in np.meshgrid(steps, steps, indexing="ij"))
    for first in range(0, rows.size, _AT_ONCE):
        pixels = rows[first : first + _AT_ONCE], cols[first : first + _AT_ONCE]
        bottom, top = _bounds(level[pixels[0] + down, pixels[1] + across], np.float32(share))
        corrected[pixels] = np.clip(corrected[pixels], bottom, top)


def _bounds(window: NDArray[np.float32], share: np.float32) -> tuple[NDArray[np.float32], ...]:
    """Least and greatest light that levels `(pixel of the window, window)` allow."""
    last = len(window) - 1
    ranks = [round(q * last) for q in (*_ENDS, 1.0 - _ENDS[1], 1.0 - _ENDS[0])]
    least, dark, light, most = np.partition(window, ranks, axis=0)[ranks]
    step = np.maximum(light - dark, np.float32(1e-6))
    uneven = np.maximum(dark - least, most - light) / step
    more = (share + (uneven / np.float32(_UNEVEN)) ** 4) * step
    floor = np.asarray(least - more, dtype=np.float32)
    bottom = np.where(floor > 0.0, np.power(np.maximum(floor, 0.0), np.float32(_GAMMA)), np.float32(-np.inf))
    return bottom, np.power(most + more, np.float32(_GAMMA))


def _as_seen(light: NDArray[np.floating]) -> NDArray[np.float32]:
    return np.asarray(np.power(np.maximum(light, 0.0), 1.0 / _GAMMA), dtype=np.float32)


def _window(spread: int) -> int:
    """Reach of a window that holds both plateaus of an edge whose blur the pixel in its middle lies in."""
    return min(max(2 * spread + 2, _NEAREST), _FURTHEST)
