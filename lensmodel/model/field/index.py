"""Which samples lie near a question: static kd-trees that grow by the logarithmic method.

New samples go to a tail that is searched one by one. When the tail is long enough it becomes a
tree; trees of equal rank are merged, so there are O(log n) of them and each sample is built in
O(log n) times. Sources: J. L. Bentley, J. B. Saxe, "Decomposable searching problems I", Journal of
Algorithms 1, 1980; the paper, section 6.3, asks for a tree that grows with the photos.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy  # `spatial` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

from lensmodel.model import variables as va

_BLOCK = 64  # samples of the smallest tree: fewer are searched one by one faster (chosen)
_TIGHT, _LOOSE = 0.6, 1.6
"""Stretch of the scale within which a built tree is still used: beyond, its ball holds many samples that do
not count, or too much has to be looked through; a narrower range builds more often (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class _Block:
    """Rows start..stop as trees, one for each set of variables that questions know."""

    start: int
    stop: int
    trees: dict[tuple[int, ...], tuple[scipy.spatial.cKDTree, NDArray[np.float64]]] = field(
        default_factory=dict
    )

    def near(
        self,
        points: NDArray[np.float64],
        asked: NDArray[np.float64],
        reach: float,
        scale: NDArray[np.float64],
    ) -> NDArray[np.intp]:
        rows = points[self.start : self.stop]
        # a sample that does not know a variable is near in it: the tree leaves that one out
        known = ~np.isnan(asked) & ~np.isnan(rows).any(axis=0)
        columns = tuple(int(c) for c in np.flatnonzero(known))
        stored = self.trees.get(columns)
        stretch = np.inf if stored is None else float((scale / stored[1])[list(columns)].max())
        if stored is None or not _TIGHT <= stretch <= _LOOSE:
            stored = self.trees[columns] = (
                scipy.spatial.cKDTree(rows[:, columns] / scale[list(columns)]),
                scale,
            )
            stretch = 1.0
        tree, built = stored
        # bandwidths shrink as samples come: an older tree is asked for a ball that surely holds ours
        inside = tree.query_ball_point((asked / built)[list(columns)], reach * stretch)
        return np.asarray(inside, dtype=np.intp) + self.start


@dataclass(frozen=True, slots=True, eq=False)
class SampleIndex:
    """Points searchable by distance in bandwidths; never changed, only extended.

    Parameters
    ----------
    points : ndarray, shape (n, d)
        NaN = unknown.
    blocks : tuple
        Trees over rows; the rows after the last one are searched directly.
    """

    points: NDArray[np.float64]
    blocks: tuple[_Block, ...] = ()

    def extended(self, points: NDArray[np.float64]) -> SampleIndex:
        """Return the index with more points, sharing the trees that need no change."""
        merged = np.concatenate([self.points, points])
        blocks = list(self.blocks)
        done = blocks[-1].stop if blocks else 0
        if len(merged) - done >= _BLOCK:
            blocks.append(_Block(done, len(merged)))
        while len(blocks) > 1 and _rank(blocks[-1]) >= _rank(blocks[-2]):
            last, before = blocks.pop(), blocks.pop()
            blocks.append(_Block(before.start, last.stop))
        return SampleIndex(merged, tuple(blocks))

    @classmethod
    def of(cls, points: NDArray[np.float64]) -> SampleIndex:
        """Index points."""
        return cls(points[:0]).extended(points)

    def near(self, asked: NDArray[np.float64], reach: float, scale: NDArray[np.float64]) -> NDArray[np.intp]:
        """Rows within `reach` bandwidths `scale` of the asked point, unknown variables left out."""
        done = self.blocks[-1].stop if self.blocks else 0
        parts = [block.near(self.points, asked, reach, scale) for block in self.blocks]
        parts.append(np.arange(done, len(self.points), dtype=np.intp))
        rows = np.sort(np.concatenate(parts))
        return rows[va.squared_distances(self.points[rows], asked, scale) <= reach * reach]


def _rank(block: _Block) -> int:
    return int((block.stop - block.start) // _BLOCK).bit_length()
