"""Which samples answer a question, and with which Nadaraya-Watson weights (paper, eq. 4 and 7).

    w_i ~ q_i exp(-d_i^2 / 2),     d_i the distance in bandwidths, q_i the weight of the sample

Source of the tree: the paper, section 6.3.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np
import scipy  # `spatial` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import variables as va

REACH: Final = 5.0  # bandwidths: a Gaussian has fallen to 4e-6 there
DROPPED: Final = 3e-5
"""Samples that together weigh less are left out (chosen: below what a kernel in single precision holds)."""
_FEW: Final = 8  # neighbours at least, however far: a mean of fewer is no better than its worst (chosen)
_MANY: Final = 4096  # fewer samples are looked through as fast as a tree (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Which samples answer which questions."""

    rows: NDArray[np.intp]  # (m,), samples, one question after the other
    weights: NDArray[np.float64]  # (m,), sum 1 in each question
    starts: NDArray[np.intp]  # (questions + 1,), where each question begins among the m

    @property
    def counts(self) -> NDArray[np.intp]:
        """Samples of each question."""
        return np.diff(self.starts)


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Samples by their points and weights, in kd-trees that are built when they are first asked."""

    points: NDArray[np.float64]  # (n, 7), of `variables`; NaN = unknown
    weights: NDArray[np.float64]  # (n,), samples of weight 0 take no part
    scale: NDArray[np.float64]  # (7,), bandwidths
    _trees: dict[tuple[int, ...], scipy.spatial.cKDTree] = field(default_factory=dict)

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Weigh the samples near each of some places."""
        chosen = [self._weighed(va.point(position, settings)) for position in positions]
        ends = np.cumsum([len(rows) for rows, _ in chosen])
        return Answers(
            np.concatenate([rows for rows, _ in chosen]),
            np.concatenate([weights for _, weights in chosen]),
            np.concatenate([[0], ends]).astype(np.intp),
        )

    def _weighed(self, asked: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Rows and weights of sum 1 for one question, the least first."""
        rows = np.arange(len(self.points)) if len(self.points) <= _MANY else self.within(asked, REACH)
        squared = va.squared_distances(self.points[rows], asked, self.scale)
        near = np.flatnonzero((squared <= REACH**2) & (self.weights[rows] > 0.0))
        if len(near) < _FEW:  # the nearest few, however far
            rows = np.arange(len(self.points))
            squared = va.squared_distances(self.points, asked, self.scale)
            squared[self.weights <= 0.0] = np.inf
            near = np.argsort(squared, kind="stable")[: min(_FEW, np.count_nonzero(self.weights > 0.0))]
        rows, squared = rows[near], squared[near]
        weight = self.weights[rows] * np.exp(-0.5 * (squared - squared.min()))
        order = np.argsort(weight, kind="stable")
        kept = order[np.cumsum(weight[order]) > DROPPED * weight.sum()]
        return rows[kept], weight[kept] / weight[kept].sum()

    def within(self, asked: NDArray[np.float64], reach: float) -> NDArray[np.intp]:
        """Rows within `reach` bandwidths of a point, and some beyond that do not know all its variables."""
        # a sample that does not know a variable is near in it: the tree leaves that one out
        known = tuple(np.flatnonzero(~np.isnan(asked) & ~np.isnan(self.points).any(axis=0)).tolist())
        scale = self.scale[list(known)]
        if known not in self._trees:
            self._trees[known] = scipy.spatial.cKDTree(self.points[:, known] / scale)
        inside = self._trees[known].query_ball_point(asked[list(known)] / scale, reach)
        return np.sort(np.asarray(inside, dtype=np.intp))
