"""Nadaraya-Watson regression over kernels in rotated local frames (paper, section 6.2, eq. 4-8).

The weight of a sample factorises into one of place and settings, common to all its pixels, and one of (u, v).
So the sum over all pixels of all samples is one of kernels::

    f(u, v) = sum_i W_i C_i(u, v) / sum_i W_i,     W_i = q_i exp(-d_i^2 / 2)

with C_i the sample's kernel in its own radial frame, d_i its distance in bandwidths (`variables`), q_i its
weight. The samples near a question are found in a kd-tree (paper, section 6.3). Departures from the paper:
n in eq. (8) counts PSFs, not pixels; the smoothing over (u, v) is that of the spline, because a bandwidth of
pixels would widen the PSF; unless the mode is "paper", kernels are scaled to the width of the place before
averaging (`WidthField`).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
import scipy  # `spatial` is loaded where it is needed: it takes a second
from numpy.typing import NDArray

from lensmodel.core.errors import NoSamplesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import camera_bodies
from lensmodel.model import variables as va
from lensmodel.model.answer import PAPER, ModelSettings, Part
from lensmodel.model.bandwidths import bandwidths, cross_validate
from lensmodel.model.local_frame import Answers, LocalKernels, WidthField

_REACH: Final = 5.0  # bandwidths: a Gaussian has fallen to 4e-6 there
_DROPPED: Final = 3e-5  # samples that together weigh less are left out (chosen: below single precision)
_FEW: Final = 8  # neighbours at least, however far: a mean of fewer is no better than its worst (chosen)

_DRIFT: Final = 0.15  # relative L2 for each unit of `Support` beyond the first to the nearest sample (chosen)
# the same for each unit beyond the outermost sample (chosen: the median of drawn lenses wide open changes by
# .53 to .62 over a unit outwards; no command repeats it)
_OUTWARD: Final = 0.5
_WIDEST: Final = 255  # pixels: side of the widest kernel that is made for coarser pixels: memory


@dataclass(frozen=True, slots=True, eq=False)
class Neighbourhood:
    """Samples by their points and weights, in a kd-tree of the variables that a question knows."""

    points: NDArray[np.float64]  # (n, 7), of `variables`; NaN = unknown
    weights: NDArray[np.float64]  # (n,), samples of weight 0 take no part
    scale: NDArray[np.float64]  # (7,), bandwidths
    _trees: dict[tuple[int, ...], scipy.spatial.cKDTree] = field(default_factory=dict)

    def near(self, positions: Sequence[FieldPosition], settings: LensSettings) -> Answers:
        """Weigh the samples near each of some places."""
        chosen = [self._weighed(va.point(position, settings)) for position in positions]
        return Answers(
            np.concatenate([rows for rows, _ in chosen]),
            np.concatenate([weights for _, weights in chosen]),
            np.array([len(rows) for rows, _ in chosen]),
        )

    def _weighed(self, asked: NDArray[np.float64]) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
        """Rows and weights of sum 1 for one question, the least first (eq. 4 and 7)."""
        rows = self.within(asked, _REACH)
        squared = va.squared_distances(self.points[rows], asked, self.scale)
        near = np.flatnonzero((squared <= _REACH**2) & (self.weights[rows] > 0.0))
        if len(near) < _FEW:  # the nearest few, however far
            rows = np.arange(len(self.points))
            squared = va.squared_distances(self.points, asked, self.scale)
            squared[self.weights <= 0.0] = np.inf
            near = np.argsort(squared, kind="stable")[: min(_FEW, np.count_nonzero(self.weights > 0.0))]
        rows, squared = rows[near], squared[near]
        weight = self.weights[rows] * np.exp(-0.5 * (squared - squared.min()))
        order = np.argsort(weight, kind="stable")
        kept = order[np.cumsum(weight[order]) > _DROPPED * weight.sum()]
        return rows[kept], weight[kept] / weight[kept].sum()

    def within(self, asked: NDArray[np.float64], reach: float) -> NDArray[np.intp]:
        """Rows within `reach` bandwidths of a point, and some beyond where a variable is not known."""
        # a sample that does not know a variable is near in it: the tree leaves that one out
        known = tuple(np.flatnonzero(~np.isnan(asked) & ~np.isnan(self.points).any(axis=0)).tolist())
        scale = self.scale[list(known)]
        if known not in self._trees:
            self._trees[known] = scipy.spatial.cKDTree(self.points[:, known] / scale)
        inside = self._trees[known].query_ball_point(asked[list(known)] / scale, reach)
        return np.sort(np.asarray(inside, dtype=np.intp))


class Regression:
    """Kernels of samples, prepared for questions; `NoSamplesError` if no sample has a weight."""

    def __init__(self, samples: Sequence[PsfSample], settings: ModelSettings) -> None:
        base = np.array([s.weight for s in samples])
        if not (base > 0).any():
            raise NoSamplesError(f"none of the {len(samples)} samples has a weight; include a photo again")
        self.samples = samples
        self._pitch_um = camera_bodies.usual_pitch(samples)  # that all kernels are brought to, or None
        common = camera_bodies.at_pitch(samples, self._pitch_um)
        points = va.points(common)
        self._widths = WidthField() if settings.mode == PAPER else WidthField.fit(common, base)
        self._local = LocalKernels.of(common, points, self._widths)
        self._validation = cross_validate(common, settings, self._local, points, base)
        if self._validation.spoilt:  # that photo has bent the widths too: fit them again without it
            self._widths = WidthField.fit(common, self._validation.weights)
            self._local = replace(self._local, widths=self._widths.over(points))
            self._validation = cross_validate(common, settings, self._local, points, base)
        self._where = va.all_in_units(common)
        # what the estimators expect of their samples; 0 where they expect nothing
        self._expected = np.array([0.0 if s.error is None else min(s.error, 1.0) for s in samples])
        self._photos = np.array([s.photo for s in samples], dtype=object)
        self.bandwidth = bandwidths(points, settings, self._validation.factors)
        self._around = Neighbourhood(points, self._validation.weights, va.scales(self.bandwidth))

    def ask(self, position: FieldPosition, settings: LensSettings, size: int, pitch_um: float | None) -> Part:
        """Answer at a place, in pixels of some pitch."""
        near = self._around.near([position], settings)
        where, asked = self._where[near.rows], va.in_units(position, settings)
        support = va.Support.of(where, asked)
        outward = math.hypot(*asked[:2]) - float(np.hypot(where[:, 0], where[:, 1]).max())
        return Part(
            self.kernels([position], settings, size, pitch_um)[0],
            self._error(near, support.nearest, max(outward, 0.0)),
            near.weights,
            self._photos[near.rows],
            support,
        )

    def kernels(
        self, positions: Sequence[FieldPosition], settings: LensSettings, size: int, pitch_um: float | None
    ) -> NDArray[np.float64]:
        """Return the kernels of many places, shape (q, size, size)."""
        near = self._around.near(positions, settings)
        widths = self._widths.over(np.array([va.point(p, settings) for p in positions]))
        angles = np.array([p.phi for p in positions])
        own = self._pitch_um
        if own is None or pitch_um is None or camera_bodies.alike(own, pitch_um):
            return self._local.kernels(near, angles, widths, size)
        inside = min(2 * math.ceil(size / 2 * pitch_um / own) + 1, max(_WIDEST, size))
        kernels = self._local.kernels(near, angles, widths, inside)
        return np.stack([camera_bodies.rescaled(kernel, own, pitch_um, size) for kernel in kernels])

    def _error(self, near: Answers, nearest: float, outward: float) -> float:
        """Expected relative L2 error of one answer.

        With held-out errors h, of which the scatter s of neighbours is a part, m independent photos, what the
        estimators expect t, all near the place, the distance d to the nearest sample and o outward from all::

            own^2 = max(h^2 - s^2 (1 + 1/m), h^2 / 9) + s^2 / m       shared^2 = max(t^2 - s^2, t^2 / 4)
            error^2 = own^2 + shared^2 + (0.15 max(d - 1, 0))^2 + (0.5 o)^2

        Estimators that err alike do not scatter: at least half of what they expect is taken for shared.
        """
        weight, rows = near.weights, near.rows
        _, number = np.unique(self._photos[rows].astype(str), return_inverse=True)
        independent = 1.0 / float((np.bincount(number, weight) ** 2).sum())
        held_out = float(weight @ self._validation.errors[rows] ** 2)
        scatter = min(float(weight @ self._validation.noise[rows]), held_out)
        own = max(held_out - scatter * (1.0 + 1.0 / independent), held_out / 9.0) + scatter / independent
        expected = float(weight @ self._expected[rows] ** 2)
        if len(self._where) == 1 and expected > 0.0:
            own = 0.0  # no other sample foretells it
        shared = max(expected - scatter, expected / 4.0)
        drift = math.hypot(_DRIFT * max(nearest - 1.0, 0.0), _OUTWARD * outward)
        return min(math.sqrt(own + shared + drift * drift), 1.0)

    @property
    def nbytes(self) -> int:
        """Bytes of stored kernels."""
        return self._local.splines.nbytes
