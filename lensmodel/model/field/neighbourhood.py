"""Which samples answer a question, and with which weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.loops import compiled
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import variables as va
from lensmodel.model.field.index import SampleIndex
from lensmodel.model.field.local_frame import Answers
from lensmodel.model.field.smoothers import NadarayaWatson, Neighbours, Smoother
from lensmodel.model.field.splines import Engine

DROPPED = 3e-5
"""Samples that together weigh less are left out; what they would change is a small part of that
(chosen: below what a kernel in single precision holds)."""

_FEW = 8  # neighbours at least, however far: a mean of fewer is no better than its worst (chosen)
_WIDER, _MANY = 3, 4096  # growth of a search; fewer samples are looked through as fast as trees (chosen)
_PAIRS = 1 << 19  # gaps at once: 29 MB of doubles (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Samples by their points, votes and a way to weigh them.

    Parameters
    ----------
    index : SampleIndex
    votes : ndarray, shape (n,)
        Samples of vote 0 take no part.
    scale : ndarray, shape (7,)
        Bandwidths.
    smoother : Smoother
    engine : {"auto", "scipy"}
        Which code looks; the answers are the same.
    """

    index: SampleIndex
    votes: NDArray[np.float64]
    scale: NDArray[np.float64]
    smoother: Smoother
    engine: Engine = "auto"

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Weigh the samples near each of some places."""
        asked = np.array([va.point(position, settings) for position in positions])
        module = compiled("lensmodel.model.field.compiled") if self.engine == "auto" else None
        scanned = len(asked) > 1 or len(self.index.points) <= _MANY
        if module is not None and scanned and isinstance(self.smoother, NadarayaWatson):
            limit = self.smoother.reach**2
            return Answers(
                *module.near(self.index.points, self.votes, asked, self.scale, limit, _FEW, DROPPED)
            )
        neighbours = self._by_tree(asked) if len(asked) == 1 else self._by_table(asked)
        counts = [len(weights) for _, weights in neighbours]
        return Answers(
            np.concatenate([rows for rows, _ in neighbours]),
            np.concatenate([weights for _, weights in neighbours]),
            np.concatenate([[0], np.cumsum(counts)]).astype(np.intp),
        )

    def _by_tree(self, asked: NDArray[np.float64]) -> list[tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """Cost of the neighbours, not of the samples."""
        neighbours = []
        for point in asked:
            rows = self.index.near(point, self.smoother.reach, self.scale)
            rows = rows[self.votes[rows] > 0]
            if rows.size < _FEW:
                rows = self._nearest(point)
            gaps = va.gaps(self.index.points[rows], point, self.scale)
            neighbours.append(self._weighed(rows, gaps))
        return neighbours

    def _by_table(self, asked: NDArray[np.float64]) -> list[tuple[NDArray[np.intp], NDArray[np.float64]]]:
        """Many places of one setting: distances in settings are computed once, those of place in a table."""
        apart = va.gaps(self.index.points, asked[0], self.scale)
        apart[:, :3] = 0.0
        settings, limit = (apart * apart).sum(axis=1), self.smoother.reach**2
        rows = np.flatnonzero((settings <= limit) & (self.votes > 0))
        points, other = self.index.points[rows], settings[rows]
        neighbours = []
        at_once = max(_PAIRS // max(len(rows), 1), 1)
        for first in range(0, len(asked), at_once):
            part = asked[first : first + at_once]
            gap = (points[None, :, :3] - part[:, None, :3]) / self.scale[:3]
            squared = np.einsum("qnk,qnk->qn", gap, gap) + other
            for point, table, distance in zip(part, gap, squared, strict=True):
                near = np.flatnonzero(distance <= limit)
                if near.size < _FEW:
                    nearest = self._nearest(point)
                    gaps = va.gaps(self.index.points[nearest], point, self.scale)
                    neighbours.append(self._weighed(nearest, gaps))
                    continue
                gaps = apart[rows[near]]
                gaps[:, :3] = table[near]
                neighbours.append(self._weighed(rows[near], gaps))
        return neighbours

    def _nearest(self, point: NDArray[np.float64]) -> NDArray[np.intp]:
        """The nearest few that vote, however far."""
        rows, reach = np.arange(len(self.index.points)), self.smoother.reach
        for _ in range(_WIDER if len(rows) > _MANY else 0):
            reach *= 2.0
            within = self.index.near(point, reach, self.scale)
            if np.count_nonzero(self.votes[within] > 0) >= _FEW:
                rows = within
                break
        squared = va.squared_distances(self.index.points[rows], point, self.scale)
        squared[self.votes[rows] <= 0] = np.inf
        order = np.argsort(squared, kind="stable")[:_FEW]
        return rows[order[np.isfinite(squared[order])]]

    def _weighed(
        self, rows: NDArray[np.intp], gaps: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        weight = self.smoother.weights(Neighbours(gaps, self.votes[rows]))
        size = np.abs(weight)
        order = np.argsort(size, kind="stable")
        kept = order[np.cumsum(size[order]) > DROPPED]
        return rows[kept], weight[kept] / weight[kept].sum()
