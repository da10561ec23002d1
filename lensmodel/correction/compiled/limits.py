"""The halo limiter of `bounds`, compiled."""

from __future__ import annotations

import numpy as np

from lensmodel.core.jit import jit
from lensmodel.correction.compiled.common import Real


@jit
def hold(photo: Real, share: float, dark: float, corrected: Real) -> None:
    """Hold `corrected` within the range of `photo`, 2 pixels wider on each side; see `bounds.limited`."""
    rows, cols = corrected.shape
    wide = cols + 4
    low, high = np.empty(wide, np.float32), np.empty(wide, np.float32)
    for i in range(rows):
        low[:] = photo[i]
        high[:] = photo[i]
        for k in range(1, 5):
            for j in range(wide):
                low[j] = min(low[j], photo[i + k, j])
                high[j] = max(high[j], photo[i + k, j])
        for j in range(cols):
            least, most = low[j], high[j]
            for k in range(1, 5):
                least = min(least, low[j + k])
                most = max(most, high[j + k])
            room = share * (most - least)
            corrected[i, j] = min(max(corrected[i, j], least - room, dark * least), most + room)
