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
        from lensmodel.model.loops import near  # noqa: PLC0415 - Numba takes a while to load

        asked = np.array([va.point(position, settings) for position in positions])
        limits = (self.scale, REACH**2, _FEW, DROPPED)
        if len(self.points) <= _MANY:
            return Answers(*near(self.points, self.weights, asked, *limits))
        rows, weights = [], []
        for point in asked:
            part = self.within(point, REACH)
            if np.count_nonzero(self.weights[part] > 0) < _FEW:
                part = np.arange(len(self.points))
            own, weight, _ = near(self.points[part], self.weights[part], point[None], *limits)
            rows.append(part[own])
            weights.append(weight)
        starts = np.concatenate([[0], np.cumsum([len(own) for own in rows])]).astype(np.intp)
        return Answers(np.concatenate(rows), np.concatenate(weights), starts)

    def within(self, asked: NDArray[np.float64], reach: float) -> NDArray[np.intp]:
        """Rows within `reach` bandwidths of a point, and some beyond that do not know all its variables."""
        # a sample that does not know a variable is near in it: the tree leaves that one out
        known = tuple(np.flatnonzero(~np.isnan(asked) & ~np.isnan(self.points).any(axis=0)).tolist())
        scale = self.scale[list(known)]
        if known not in self._trees:
            self._trees[known] = scipy.spatial.cKDTree(self.points[:, known] / scale)
        inside = self._trees[known].query_ball_point(asked[list(known)] / scale, reach)
        return np.sort(np.asarray(inside, dtype=np.intp))
