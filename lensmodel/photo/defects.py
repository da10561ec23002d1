"""Defective pixels of a sensor: found on the mosaic, one by one, and replaced by their neighbours.

A hot pixel taken for a point of light teaches a kernel as narrow as itself, and a correction makes a ring of
it. Light comes through a lens: the pixels beside a point of light, which have the other colours, see some of
it. A pixel that stands alone among its own colour while those beside it see nothing is no picture.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

_SIGMAS: Final = 12.0
"""Least height above all neighbours of the colour, in standard deviations of the noise (chosen): less does no
harm, and faint stars stay."""

_CONTRAST: Final = 1.5
"""Least height relative to what the neighbours of the colour differ by (chosen): texture stays below."""

_BESIDE: Final = 0.04
"""Largest share of the height that the pixels beside it may see in the middle, with one standard deviation
(chosen): of a point of light through the sharpest lenses they see twice that, in the weakest colour."""

_LARGEST_BESIDE: Final = 0.3
"""The same of the brightest of them (chosen): between two pixels a point of light lies in both."""

_MOST: Final = 2e-3
"""Share of the pixels above which what was found is a picture after all, such as a sky of stars (chosen)."""

_RING: Final = [(row, col) for row in (-2, 0, 2) for col in (-2, 0, 2) if row or col]
_BESIDE_IT: Final = [(-1, 0), (0, -1), (0, 1), (1, 0)]
_DIAGONAL: Final = [(-1, -1), (-1, 1), (1, -1), (1, 1)]
_ACROSS: Final = [(-2, 0), (0, -2), (0, 2), (2, 0)]

Places = tuple[NDArray[np.intp], NDArray[np.intp]]


def find_defects(values: NDArray[np.uint16], sigma: NDArray[np.floating]) -> Places:
    """Find pixels of a Bayer mosaic that stand alone, brighter or darker than all around them."""
    rows, cols = [], []
    for row in (0, 1):
        for col in (0, 1):
            site = values[row::2, col::2].astype(np.int32)
            ring = np.pad(site, 1, mode="reflect")
            height, width = site.shape
            low, high = np.full_like(site, np.iinfo(np.uint16).max), np.zeros_like(site)
            for down, right in ((0, 0), (0, 1), (0, 2), (1, 0), (1, 2), (2, 0), (2, 1), (2, 2)):
                neighbour = ring[down : down + height, right : right + width]
                np.minimum(low, neighbour, out=low)
                np.maximum(high, neighbour, out=high)
            least = np.maximum(_CONTRAST * (high - low), _SIGMAS * float(sigma[row, col].min()))
            at = np.nonzero(np.maximum(site - high, low - site) > least)
            rows.append(2 * at[0] + row)
            cols.append(2 * at[1] + col)
    found = _alone(values, (np.concatenate(rows), np.concatenate(cols)), sigma)
    return found if len(found[0]) <= _MOST * values.size else (found[0][:0], found[1][:0])


def replace_defects(values: NDArray[np.uint16], places: Places, colours: NDArray[np.uint8]) -> None:
    """Write the median of the nearest neighbours of its colour into each place."""
    rows, cols = places
    green = np.isin(colours[rows, cols], (1, 3))
    for chosen, offsets in ((green, _DIAGONAL), (~green, _RING)):
        at = rows[chosen], cols[chosen]
        values[at] = np.rint(np.median(_around(values, at, offsets), axis=0)).astype(values.dtype)


def _alone(values: NDArray[np.uint16], at: Places, sigma: NDArray[np.floating]) -> Places:
    """Those of the candidates that are no light, by their neighbours."""
    levels = np.linspace(0.0, 65535.0, sigma.shape[2])
    here, ring = values[at].astype(np.float32), _around(values, at, _RING)
    middle = np.median(ring, axis=0)
    sign = np.where(here > middle, 1.0, -1.0).astype(np.float32)
    height = np.minimum(sign * (here - ring.max(axis=0)), sign * (here - ring.min(axis=0)))
    noise = np.empty_like(here)
    for row in (0, 1):
        for col in (0, 1):
            site = (at[0] % 2 == row) & (at[1] % 2 == col)
            noise[site] = np.interp(middle[site], levels, sigma[row, col])
    kept = (height > _SIGMAS * noise) & (height > _CONTRAST * np.ptp(ring, axis=0))
    at, height, noise, sign = (at[0][kept], at[1][kept]), height[kept], noise[kept], sign[kept]
    bumps = []
    for row, col in _BESIDE_IT:
        beside = at[0] + row, at[1] + col
        level = np.median(_around(values, beside, _ACROSS), axis=0)
        bumps.append(sign * (_around(values, at, [(row, col)])[0] - level))
    seen = np.reshape(bumps, (len(_BESIDE_IT), -1))
    alone = (np.median(seen, axis=0) < _BESIDE * height + noise) & (
        seen.max(axis=0) < _LARGEST_BESIDE * height
    )
    return at[0][alone], at[1][alone]


def _around(values: NDArray[np.uint16], at: Places, offsets: list[tuple[int, int]]) -> NDArray[np.float32]:
    """Values at offsets from places, shape (offsets, places); the frame is mirrored, which keeps colours."""
    height, width = values.shape
    out = np.empty((len(offsets), len(at[0])), dtype=np.float32)
    for k, (row, col) in enumerate(offsets):
        out[k] = values[_mirrored(at[0] + row, height), _mirrored(at[1] + col, width)]
    return out


def _mirrored(index: NDArray[np.intp], length: int) -> NDArray[np.intp]:
    """Reflect about the first and last index of the same parity: the colour stays, and so do distances."""
    last = length - 1 - (length - 1 - index) % 2
    index = np.where(index < 0, 2 * (index % 2) - index, index)
    return np.where(index >= length, 2 * last - index, index)
