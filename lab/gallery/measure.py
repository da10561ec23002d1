"""The figures of one picture, tile by tile, and which bars they keep."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lab.gallery import figures
from lab.gallery.pictures import Rendered
from lab.images import gains

TILE: Final = 1024
"""Side of a tile: a multiple of the squares of the figures; bounds the memory."""

OVERSHOOT_PERCENT: Final = 12.0
GRAIN: Final = (0.8, 1.0)
ZONE_LOSS_DB: Final = 0.05
LOSS_SHARE: Final = 0.01
"""Bars (chosen): most overshoot in percent, grain over the original's, a zone's loss, losing blocks."""

_MARGIN: Final = 14  # pixels around a tile: the reach of a profile, and two for its slope
_SQUARE: Final = 48  # pixels (chosen): half of a crop of `lab.gallery.crops`

Figures = dict[str, Any]


def measured(before: Rendered, after: Rendered, truth: Rendered | None) -> Figures:
    """Take all figures of a picture."""
    faults: dict[str, list[NDArray[np.intp]]] = {"dots": [], "hue_flips": []}
    edges, places, changed = [], [], 0
    for row, col, window, inner in _tiles(*before.shape[:2]):
        old, new = _unit(before[window]), _unit(after[window])
        true = None if truth is None else _unit(truth[window])
        for name, find in (("dots", figures.dots), ("hue_flips", figures.hue_flips)):
            faults[name].append(np.argwhere(find(old, new, true)[inner]) + np.array([row, col]))
        edges.append(figures.overshoots(old, new, true))
        places.append(figures.grain(old[inner], new[inner], None if true is None else true[inner]))
        changed += int((np.abs(new[inner] - old[inner]).max(axis=-1) > 1.0 / 255.0).sum())
    counts: Figures = {}
    for name, tiles in faults.items():
        pixels = np.concatenate(tiles)
        counts |= {name: len(pixels), f"{name}_at": _densest(pixels)}
    edge_table = np.concatenate(edges)
    gained = None if truth is None else gains(before, after, truth)
    return {
        **counts,
        "edges": len(edge_table),
        "overshoot": figures.percentile_of_edges(edge_table),
        "grain": figures.grain_ratio(np.concatenate(places)),
        "changed": changed / float(np.prod(before.shape[:2])),
        "gains": None if gained is None else asdict(gained),
    }


def bars(found: Figures) -> dict[str, bool]:
    """Say which bars a picture keeps; one that could not be measured on it is left out."""
    kept = {"dots": found["dots"] == 0, "hue flips": found["hue_flips"] == 0}
    if found["overshoot"] is not None:
        kept["overshoot"] = found["overshoot"][1] <= OVERSHOOT_PERCENT
    if found["grain"] is not None:
        kept["grain"] = all(GRAIN[0] <= round(ratio, 2) <= GRAIN[1] for ratio in found["grain"].values())
    if found["gains"] is not None:
        kept["zones"] = min(found["gains"]["zones"].values()) >= -ZONE_LOSS_DB
        kept["blocks"] = found["gains"]["loss_share"] <= LOSS_SHARE
    return kept


def _densest(pixels: NDArray[np.intp]) -> list[int] | None:
    """Middle of the square that holds most of some pixels."""
    if len(pixels) == 0:
        return None
    squares, numbers = np.unique(pixels // _SQUARE, axis=0, return_counts=True)
    return [int(k) * _SQUARE + _SQUARE // 2 for k in squares[numbers.argmax()]]


def _unit(part: Rendered) -> NDArray[np.float32]:
    return np.asarray(part, dtype=np.float32) / np.float32(65535.0)


def _tiles(height: int, width: int) -> Iterator[tuple[int, int, tuple[slice, slice], tuple[slice, slice]]]:
    """First row and column of each tile, the tile with its margin, and the tile within that."""
    for row in range(0, height, TILE):
        for col in range(0, width, TILE):
            top, left = max(row - _MARGIN, 0), max(col - _MARGIN, 0)
            window = (slice(top, row + TILE + _MARGIN), slice(left, col + TILE + _MARGIN))
            inner = (
                slice(row - top, min(row + TILE, height) - top),
                slice(col - left, min(col + TILE, width) - left),
            )
            yield row, col, window, inner
