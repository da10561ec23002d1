"""What the lenses of a library are like: widths over the field, colours, and how uneven copies are."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lab.population.sets import Lens
from lensmodel.neural.network import SIDE, assembled

_PERCENTILES: Final = (10, 50, 90)
_POINT: Final = 0.1  # pixels: narrower kernels are points
_RING: Final = (0.5, 0.85)  # radii between which the sides of a lens are compared


def widths(lens: Lens) -> NDArray[np.float64]:
    """R.m.s. widths of the kernels along one axis in pixels, wide open, shape (places, 3)."""
    kernels = assembled(lens.truth[0])
    at = np.arange(SIDE) - SIDE // 2
    rows, cols = kernels.sum(-1) @ at**2, kernels.sum(-2) @ at**2
    spread: NDArray[np.float64] = np.sqrt((rows + cols) / 2.0)
    return spread


def describe(lenses: Sequence[Lens]) -> dict[str, tuple[float, ...]]:
    """Percentiles (10, 50, 90) over lenses of what is known of real ones.

    "center", "mid" and "corner": width of green in pixels; "red" and "blue": median width over that of green;
    "sides": widest over narrowest place at half to most of the way to the corner; "f-number".
    """
    rows: dict[str, list[float]] = {}
    for lens in lenses:
        width, r = np.maximum(widths(lens), _POINT), np.hypot(*lens.xy.T)
        for zone, inside in (("center", r < 0.3), ("mid", (r >= 0.3) & (r <= 0.75)), ("corner", r > 0.75)):
            rows.setdefault(zone, []).append(float(np.median(width[inside, 1])))
        for colour, name in ((0, "red"), (2, "blue")):
            rows.setdefault(name, []).append(float(np.median(width[:, colour] / width[:, 1])))
        ring = width[(r > _RING[0]) & (r < _RING[1]), 1]
        if ring.size:
            rows.setdefault("sides", []).append(float(ring.max() / ring.min()))
        rows.setdefault("f-number", []).append(float(np.exp(lens.settings[0, 0])))
    return {
        name: tuple(float(v) for v in np.percentile(values, _PERCENTILES)) for name, values in rows.items()
    }
