"""Focus distances where JSON and SQL have no infinity."""

from __future__ import annotations

import math
from typing import Final

INFINITY: Final = -1.0  # stands for a focus distance of infinity; no distance is negative


def written(focus_m: float | None) -> float | None:
    """Return a focus distance as JSON and SQL can hold it; None where it is no number."""
    if focus_m is None or math.isnan(focus_m):
        return None
    return INFINITY if math.isinf(focus_m) else focus_m


def read(stored: float | None) -> float | None:
    """Return the focus distance that `written` has encoded."""
    return math.inf if stored is not None and stored < 0 else stored
