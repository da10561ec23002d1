"""The physical mean of a lens and what its samples say beyond it.

One wavefront N is fitted to all samples C (`wavefront_fit`) and rendered where a question is asked:
kernels of the corner change too quickly over the field to be interpolated between nodes. What is left
of the samples is kriged with mean zero, so that far from all samples the wavefront alone remains::

    f(x, y) = N(x, y) + c'(x, y) K^-1 (C - N),    K = c + nugget / q

Cost: some seconds of CPU at the first question, one or two milliseconds at each.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.errors import NotEnoughEvidenceError
from lensmodel.psf import PsfSample, resized
from lensmodel.regression import variables as va
from lensmodel.regression.kriging import NUGGETS, field_vector, matern, settings_gap, squared_gaps
from lensmodel.regression.wavefront import Wavefront
from lensmodel.regression.wavefront_fit import MIN_SAMPLES, fit_wavefront, spread
from lensmodel.types import FieldPosition, LensSettings

_MOST = 240
_AROUND = 6  # pixels beyond the side that was fitted, for corners wider than every sample
_OCTAVES = 0.25
_NOTHING_LEFT = 1e3
_WORST = 1.5
_ALIKE = 1e-7


@dataclass(frozen=True, slots=True, eq=False)
class Physics:
    """A fitted wavefront with the kriged rest of the samples.

    Parameters
    ----------
    front : Wavefront
    rows : ndarray of int, shape (m,)
        Samples that the rest is known of.
    vectors, where : ndarray, shape (m, 2), (m, 7)
        Their places and points.
    rest : ndarray, shape (m, side^2)
        K^-1 (C - N): the rest at a place is the product of its covariances and this.
    errors : ndarray, shape (n,)
        Relative L2 of every sample, of its own group's rest nothing known.
    """

    front: Wavefront
    rows: NDArray[np.intp]
    vectors: NDArray[np.float64]
    where: NDArray[np.float64]
    rest: NDArray[np.float32]
    errors: NDArray[np.float64]


class PhysicalMean:
    """Kernels of `Physics`, fitted at the first question, at most once.

    Parameters
    ----------
    samples : sequence of PsfSample
    votes : ndarray, shape (n,)
        Those of 0 take no part.
    groups : ndarray of int, shape (n,)
        Samples that are held out together.
    scale : ndarray, shape (7,)
        Bandwidths, of which those of the settings count.
    """

    def __init__(
        self,
        samples: Sequence[PsfSample],
        votes: NDArray[np.float64],
        groups: NDArray[np.intp],
        scale: NDArray[np.float64],
    ) -> None:
        self._samples, self._votes, self._groups, self._scale = samples, votes, groups, scale
        self._guard = threading.Lock()
        self._known: Physics | None = None
        self._asked = False
        self._side = max(s.kernel.shape[0] for s in samples)

    def fitted(self) -> Physics | None:
        """Return the fit; None where there are too few samples or several focal lengths."""
        with self._guard:
            if not self._asked:
                self._known, self._asked = self._fit(), True
            return self._known

    def rows(self, positions: Sequence[FieldPosition], settings: LensSettings) -> NDArray[np.float64]:
        """Kernels of the image frame as flat rows, shape (q, side^2).

        Raises
        ------
        NotEnoughEvidenceError
            Where `fitted` is None.
        """
        physics = self.fitted()
        if physics is None:
            raise NotEnoughEvidenceError(
                f"{len(self._samples)} samples make no wavefront: it takes {MIN_SAMPLES} of one focal length"
            )
        vectors = np.array([field_vector(position) for position in positions])
        gap = settings_gap(physics.where, va.point(positions[0], settings), self._scale)
        alike = np.exp(-0.5 * gap)
        near = np.flatnonzero(alike > _ALIKE)
        found = np.stack([self._rendered(physics.front, position, settings) for position in positions])
        if near.size:
            towards = matern(np.sqrt(squared_gaps(vectors, physics.vectors[near]))) * alike[near]
            found += towards.astype(np.float32) @ physics.rest[near]
        return found

    def extended_errors(self, count: int) -> NDArray[np.float64] | None:
        """Held-out errors of the first `count` samples; the usual one of those added later."""
        physics = self.fitted()
        if physics is None:
            return None
        usual = np.full(max(count - len(physics.errors), 0), float(np.median(physics.errors)))
        return np.concatenate([physics.errors[:count], usual])

    def _rendered(
        self, front: Wavefront, position: FieldPosition, settings: LensSettings
    ) -> NDArray[np.float64]:
        side = min(front.size + _AROUND, self._side)
        return resized(front.kernel(position, settings, side), self._side).ravel()

    def _fit(self) -> Physics | None:
        voting = [int(i) for i in np.flatnonzero(self._votes > 0)]
        if len(voting) < MIN_SAMPLES or not _one_focal_length([self._samples[i] for i in voting]):
            return None
        known = {id(self._samples[i]): i for i in voting}
        front = fit_wavefront([self._samples[i].with_weight(float(self._votes[i])) for i in voting])
        if front is None:
            return None
        kept = sorted(known[id(s)] for s in spread([self._samples[i] for i in voting], _MOST))
        chosen = np.array(kept, dtype=np.intp)
        samples = [self._samples[i] for i in kept]
        wanted = np.stack([resized(s.kernel, self._side).ravel() for s in samples])
        left = wanted - [self._rendered(front, s.position, s.settings) for s in samples]
        where, vectors = va.points(samples), np.array([field_vector(s.position) for s in samples])
        gaps = settings_gap(where[:, None, :], where[None, :, :], self._scale)
        covariance = matern(np.sqrt(squared_gaps(vectors, vectors))) * np.exp(-0.5 * gaps)
        votes = np.maximum(self._votes[chosen], 1e-3)
        rest, held = _kriged(covariance, votes, self._groups[chosen], left)
        seen = held / np.maximum(np.sqrt((wanted**2).sum(axis=1)), 1e-30)
        errors = np.full(len(self._samples), float(np.median(seen)))
        errors[chosen] = seen
        return Physics(front, chosen, vectors, where, rest.astype(np.float32), errors)


def _kriged(
    covariance: NDArray[np.float64],
    votes: NDArray[np.float64],
    groups: NDArray[np.intp],
    left: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """K^-1 R and the norms of R - R predicted from other groups, for the best nugget.

    The residuals of a group p that was left out are ((K^-1)_pp)^-1 (K^-1 R)_p.
    """
    best: tuple[float, NDArray[np.float64], NDArray[np.float64]] | None = None
    for nugget in (*NUGGETS, _NOTHING_LEFT):
        inverse = np.linalg.inv(covariance + np.diag(nugget / votes))
        answered = inverse @ left
        held = np.empty(len(left))
        for group in np.unique(groups):
            own = np.flatnonzero(groups == group)
            missed = np.linalg.solve(inverse[np.ix_(own, own)], answered[own])
            held[own] = np.sqrt((missed**2).sum(axis=1))
        score = float(votes @ np.minimum(held, _WORST))
        if best is None or score < best[0]:
            best = score, answered, held
    assert best is not None
    return best[1], best[2]


def _one_focal_length(samples: Sequence[PsfSample]) -> bool:
    focal = [math.log2(s.settings.focal_mm) for s in samples if s.settings.focal_mm is not None]
    return not focal or max(focal) - min(focal) <= _OCTAVES
