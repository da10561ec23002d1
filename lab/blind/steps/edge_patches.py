"""Patch prior of the estimator `sun`: where edges are, and what sharp ones look like.

A window of 5 px on an edge is q = σ z + μ: its own mean μ, a pattern z of zero mean and unit norm, and a
contrast σ. The patterns are ideal steps, bars and corners; the contrasts follow the distribution that
edges of sharp scenes have. The paper matches σ itself, in display values; linear light has no such common
scale, so that here the steepness is matched, σ over the range of values within some pixels: blur lowers
σ but not the range of an isolated edge. Source: L. Sun, S. Cho, J. Wang and J. Hays, "Edge-based blur kernel
estimation using patch priors", ICCP 2013, section 3.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy import ndimage

SIDE = 5  # pixels of a window, as in the paper
EDGE_SHARE = 0.03
"""So many of the pixels lie on the mask, the strongest first."""

_ORIENTATIONS = 8  # of the filters: 22.5 degrees apart (chosen)
_REACH = 4  # pixels of a filter: two standard deviations along the edge
_ALONG_PX, _ACROSS_PX = 2.0, 1.0  # standard deviations of a filter (chosen): longer than wide
_LEAST_LENGTH = 4  # pixels of an edge: shorter ones are noise (chosen)
_AROUND = 11  # pixels: window of the local range, two patterns wide (chosen)
_DATA = Path(__file__).parents[2] / "data" / "edge_patches.npz"

Image = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class EdgePatchPrior:
    """Patterns of sharp edges and the distribution of their contrast."""

    patches: Image  # (n, 25), zero mean, unit norm; closed under turns by 90 degrees and change of sign
    steepness: Image  # (q,), quantiles at (i + 1/2) / q of σ over the local range

    @classmethod
    def load(cls, path: Path = _DATA) -> EdgePatchPrior:
        """Read what `lab.training.make_edge_patches` wrote."""
        with np.load(path, allow_pickle=False) as stored:
            return cls(stored["patches"].astype(np.float64), stored["steepness"].astype(np.float64))

    def sharpened(self, windows: Image, ranges: Image) -> Image:
        """Replace windows `(n, 25)` by sharp ones: best pattern, own mean, matched contrast.

        The steepness of rank r among the windows becomes the quantile r of sharp scenes, never less
        than it was: blur only takes contrast away.
        """
        mean = windows.mean(axis=1, keepdims=True)
        flat = windows - mean
        contrast = np.linalg.norm(flat, axis=1)
        best = (flat @ self.patches.T).argmax(axis=1)
        steep = contrast / np.maximum(ranges, 1e-9)
        rank = (steep.argsort(kind="stable").argsort(kind="stable") + 0.5) / max(len(windows), 1)
        places = (np.arange(len(self.steepness)) + 0.5) / len(self.steepness)
        wanted = np.maximum(np.interp(rank, places, self.steepness) * ranges, contrast)
        return np.asarray(wanted[:, None] * self.patches[best] + mean)


@lru_cache(maxsize=1)
def default_prior() -> EdgePatchPrior:
    """Return the prior that ships with the library."""
    return EdgePatchPrior.load()


def edge_mask(x: Image, share: float = EDGE_SHARE) -> NDArray[np.bool_]:
    """Mark thin edges: strongest responses to elongated derivative filters, local maxima across."""
    responses = np.stack([np.abs(ndimage.correlate(x, f, mode="nearest")) for f in _bank()])
    strength, way = responses.max(axis=0), responses.argmax(axis=0)
    crest = np.zeros(x.shape, dtype=bool)
    padded = np.pad(strength, 1)
    for i in range(_ORIENTATIONS):
        angle = math.pi * i / _ORIENTATIONS
        down, across = round(-math.sin(angle)), round(math.cos(angle))
        ahead = padded[1 + down : padded.shape[0] - 1 + down, 1 + across : padded.shape[1] - 1 + across]
        behind = padded[1 - down : padded.shape[0] - 1 - down, 1 - across : padded.shape[1] - 1 - across]
        crest |= (way == i) & (strength >= ahead) & (strength >= behind)
    rim = SIDE // 2
    inside = np.zeros(x.shape, dtype=bool)
    inside[rim:-rim, rim:-rim] = True
    crest &= inside & (strength > 1e-9)
    count = max(int(share * x.size), 1)
    if int(crest.sum()) > count:
        crest &= strength >= np.partition(strength[crest], -count)[-count]
    label, _ = ndimage.label(crest, np.ones((3, 3), dtype=np.int_))
    long = np.bincount(label.ravel()) >= _LEAST_LENGTH
    long[0] = False
    return np.asarray(long[label])


def steepness_of(x: Image) -> Image:
    """σ of the window around each pixel over the local range, 0 where nothing varies."""
    mean = ndimage.uniform_filter(x, SIDE, mode="nearest")
    power = ndimage.uniform_filter(x * x, SIDE, mode="nearest") - mean * mean
    return np.sqrt(np.maximum(power, 0.0)) * SIDE / np.maximum(local_range(x), 1e-9)


def local_range(x: Image) -> Image:
    """Largest less smallest value within 5 px in each direction."""
    return np.asarray(
        ndimage.maximum_filter(x, _AROUND, mode="nearest")
        - ndimage.minimum_filter(x, _AROUND, mode="nearest")
    )


def target(x: Image, mask: NDArray[np.bool_], prior: EdgePatchPrior) -> tuple[Image, Image]:
    """Mean of the sharp windows over each pixel, and how many lie over it: q and count, both (H, W)."""
    rim = SIDE // 2
    rows, cols = np.nonzero(mask)
    windows = sliding_window_view(x, (SIDE, SIDE))[rows - rim, cols - rim].reshape(-1, SIDE * SIDE)
    sharp = prior.sharpened(windows, local_range(x)[rows, cols]).reshape(-1, SIDE, SIDE)
    total, count = np.zeros_like(x), np.zeros_like(x)
    for i in range(SIDE):
        for j in range(SIDE):
            place = (rows + i - rim, cols + j - rim)
            np.add.at(total, place, sharp[:, i, j])
            np.add.at(count, place, 1.0)
    return np.where(count > 0, total / np.maximum(count, 1.0), x), count


@lru_cache(maxsize=1)
def _bank() -> tuple[Image, ...]:
    """Derivatives of Gaussians, long along the edge; each responds to its own direction."""
    t = np.arange(-_REACH, _REACH + 1, dtype=np.float64)
    filters = []
    for i in range(_ORIENTATIONS):
        angle = math.pi * i / _ORIENTATIONS
        u = math.cos(angle) * t[None, :] - math.sin(angle) * t[:, None]
        v = math.sin(angle) * t[None, :] + math.cos(angle) * t[:, None]
        one = u * np.exp(-0.5 * ((u / _ACROSS_PX) ** 2 + (v / _ALONG_PX) ** 2))
        filters.append(one / np.abs(one).sum())
    return tuple(filters)
