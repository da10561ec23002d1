"""Kernels of all samples, turned and scaled from their own places to the place of a question.

In the radial frame of a place (u outwards, v along the ring) the kernels of a ring are alike, and
divided by the width of the place (see `transport`) those of all rings nearly are. So sample i is seen
from the question through the map of pixel offsets::

    M_i = L_i' S_i S^-1 L,      L = [[-sin phi, cos phi], [-cos phi, -sin phi]],   S = diag(s_u, s_v)

The kernel itself is kept in its own frame and resampled once (`splines`): turned into a common frame
and out of it again it would lose sharpness, and a frame fine enough to lose little is seventeen times
as large as the kernel.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.loops import compiled
from lensmodel.core.psf import PsfSample, resized
from lensmodel.model.field import splines
from lensmodel.model.field.kernel_store import KernelStore
from lensmodel.model.field.splines import FINER, Engine
from lensmodel.model.field.transport import WidthField

_CENTRED_PX = 1e-3  # pixels: a thousandth moves no figure that is reported
_STEPS = 6
"""Of centring at most: each lowers what is left many times over, and it ends when little is (chosen)."""
_ROOM = 1.35
"""Side over that of an answer, for kernels that are scaled down to it: few are scaled by more (chosen)."""
_MOST_BYTES = 1 << 29  # beyond, kernels are kept no finer than their pixels
MIRRORED = np.array([1.0, -1.0])
"""Factor on the scales that turns a map into that of the mirror image about the meridional plane."""


@dataclass(frozen=True, slots=True, eq=False)
class Answers:
    """Which samples answer which questions.

    Parameters
    ----------
    rows : ndarray of int, shape (m,)
        Samples, one question after the other.
    weights : ndarray, shape (m,)
        Sum 1 in each question.
    starts : ndarray of int, shape (questions + 1,)
        Where each question begins among the m.
    """

    rows: NDArray[np.intp]
    weights: NDArray[np.float64]
    starts: NDArray[np.intp]

    @property
    def counts(self) -> NDArray[np.intp]:
        """Samples of each question."""
        return np.diff(self.starts)

    @property
    def shares(self) -> NDArray[np.float64]:
        """Weights of the samples of a single question, none below 0, of sum 1."""
        weight = np.maximum(self.weights, 0.0)
        weight /= weight.sum()
        return weight

    def mean(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Weighted means of values `(n,)` of the samples, one for each question; weights below 0 are 0."""
        weight, first = np.maximum(self.weights, 0.0), self.starts[:-1]
        means = np.add.reduceat(weight * values[self.rows], first) / np.add.reduceat(weight, first)
        return np.asarray(means)


@dataclass(frozen=True, slots=True, eq=False)
class LocalKernels:
    """Splines of the samples with the frames that they belong to; extended, never changed.

    Parameters
    ----------
    side : int
        Odd side of the stored kernels.
    splines : KernelStore
        Coefficients.
    angles, radii : ndarray, shape (n,)
        phi of the places in radians; radius of the light in pixels.
    widths : ndarray, shape (n, 2)
        Scales (s_u, s_v) of the places.
    finer : int
        Coefficients for each pixel along an axis.
    engine : {"auto", "scipy"}
        Which code reads the splines; the numbers are the same.
    """

    side: int
    splines: KernelStore
    angles: NDArray[np.float64]
    radii: NDArray[np.float64]
    widths: NDArray[np.float64]
    finer: int = FINER
    engine: Engine = "auto"

    @classmethod
    def of(cls, samples: Sequence[PsfSample], where: NDArray[np.float64], field: WidthField) -> LocalKernels:
        """Keep samples at points `where` (n, 7)."""
        side = max(s.kernel.shape[0] for s in samples)
        empty = np.empty(0)
        width = (FINER * (side - 1) + 1) ** 2
        finer = FINER if 4 * width * len(samples) <= _MOST_BYTES else 1
        store = KernelStore((finer * (side - 1) + 1) ** 2)
        start = cls(side, store, empty, empty, np.empty((0, 2)), finer)
        return start.extended(samples, where, field)

    def extended(
        self, samples: Sequence[PsfSample], where: NDArray[np.float64], field: WidthField
    ) -> LocalKernels:
        """Return these with more, none larger than `side`."""
        radii = np.empty(len(samples))

        def rows() -> Iterator[NDArray[np.float32]]:  # one after the other: there may be very many
            for i, sample in enumerate(samples):
                spline = splines.coefficients(resized(sample.kernel, self.side), self.finer)
                radii[i] = splines.light_radius(spline)
                yield spline.astype(np.float32).ravel()

        kept = self.splines.extended(rows(), len(samples))
        return replace(
            self,
            splines=kept,
            angles=np.concatenate([self.angles, [s.position.phi for s in samples]]),
            radii=np.concatenate([self.radii, radii]),
            widths=np.concatenate([self.widths, field.over(where)]),
        )

    def rescaled(self, where: NDArray[np.float64], field: WidthField) -> LocalKernels:
        """Return the same kernels with widths of another field."""
        return replace(self, widths=field.over(where))

    @property
    def nbytes(self) -> int:
        """Bytes kept."""
        return int(self.splines.rows.nbytes + self.angles.nbytes + self.radii.nbytes + self.widths.nbytes)

    def kernels(
        self,
        answers: Answers,
        angles: NDArray[np.float64],
        widths: NDArray[np.float64],
        size: int,
        mirror: float = 0.0,
    ) -> NDArray[np.float64]:
        """Means of the neighbours at places of `angles` (q,) and `widths` (q, 2), shape (q, size, size).

        Non-negative, sum 1, centre of mass on the middle pixel. Centring moves the points at which the
        splines are read: kernels are not resampled again.
        """
        shifts = np.zeros((len(angles), 2))
        light = np.empty((len(angles), size, size))
        t = np.arange(size, dtype=np.float64) - size // 2
        open_ = np.arange(len(angles))
        maps, weights, rows, starts = self._seen(answers, angles, widths, mirror)
        for _ in range(_STEPS):
            part = _subset(starts, open_)
            kernels = splines.sums(
                self.splines.rows,
                self.radii,
                rows[part],
                weights[part],
                maps[part],
                np.concatenate([[0], np.cumsum(np.diff(starts)[open_])]),
                shifts[open_],
                size,
                engine=self.engine,
            )
            kernels = _without_negatives(kernels, self.engine)
            light[open_] = kernels
            total = kernels.sum(axis=(1, 2))
            row, col = kernels.sum(axis=2) @ t / total, kernels.sum(axis=1) @ t / total
            shifts[open_] -= np.stack([row, col], axis=1)
            open_ = open_[np.hypot(row, col) >= _CENTRED_PX]
            if not open_.size:
                break
        return np.asarray(light / light.sum(axis=(1, 2), keepdims=True))

    def apart(
        self, rows: NDArray[np.intp], angle: float, width: NDArray[np.float64], size: int
    ) -> NDArray[np.float64]:
        """Kernels of single samples as seen from one place, shape (m, size, size)."""
        count = len(rows)
        single = Answers(rows, np.ones(count), np.arange(count + 1))
        maps, weights, _, starts = self._seen(
            single, np.full(count, angle), np.broadcast_to(width, (count, 2)), 0.0
        )
        return splines.sums(
            self.splines.rows,
            self.radii,
            rows,
            weights,
            maps,
            starts,
            np.zeros((count, 2)),
            size,
            engine=self.engine,
        )

    def upright(self, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """Kernels at phi = 0 and unit width, rows towards -v, columns towards u."""
        side = 2 * int(np.ceil(self.side // 2 * _ROOM)) + 1
        return self.apart(rows, 0.0, np.ones(2), side)

    def _seen(
        self,
        answers: Answers,
        angles: NDArray[np.float64],
        widths: NDArray[np.float64],
        mirror: float,
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
        """Maps, weights times determinants, rows and starts; mirrored samples follow their originals."""
        asked = np.repeat(np.arange(len(angles)), answers.counts)
        rows = answers.rows
        scale = self.widths[rows] / widths[asked]
        factor = answers.weights * scale[:, 0] * scale[:, 1]
        own, here = self.angles[rows], angles[asked]
        if mirror == 0.0:
            return affine_maps(own, here, scale * self.finer), factor, rows, answers.starts
        scale = scale * self.finer
        both = np.stack([affine_maps(own, here, scale), affine_maps(own, here, scale * MIRRORED)], axis=1)
        shares = np.stack([factor, mirror * factor], axis=1) / (1.0 + mirror)
        return both.reshape(-1, 2, 2), shares.ravel(), np.repeat(rows, 2), answers.starts * 2


def affine_maps(
    own: NDArray[np.float64], here: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """L_i' diag(scale) L for angles `own` of the samples and `here` of the questions, shape (m, 2, 2)."""
    c, s, d, t = np.cos(own), np.sin(own), np.cos(here), np.sin(here)
    u, v = scale[:, 0], scale[:, 1]
    maps = np.empty((len(own), 2, 2))
    maps[:, 0, 0] = s * u * t + c * v * d
    maps[:, 0, 1] = -s * u * d + c * v * t
    maps[:, 1, 0] = -c * u * t + s * v * d
    maps[:, 1, 1] = c * u * d + s * v * t
    return maps


def _subset(starts: NDArray[np.intp], questions: NDArray[np.intp]) -> NDArray[np.intp]:
    """Positions that belong to some of the questions."""
    if len(questions) == len(starts) - 1:
        return np.arange(starts[-1])
    return np.concatenate([np.arange(starts[i], starts[i + 1]) for i in questions])


def _without_negatives(values: NDArray[np.float64], engine: Engine) -> NDArray[np.float64]:
    """Nearest arrays, in L2, that are not negative and have the same sums, shape (q, k, k).

    max(x - t, 0) with t such that the sum stays: clipping alone would keep the crests of a spline's
    ripples round a sharp kernel and drop their troughs. Source: W. Wang, M. A. Carreira-Perpinan,
    "Projection onto the probability simplex", arXiv 1309.1541, 2013.
    """
    flat = values.reshape(len(values), -1)
    module = compiled("lensmodel.model.field.compiled") if engine == "auto" else None
    if module is not None:
        module.without_negatives(flat)  # a view: the values are those of `splines.sums`, ours alone
        return values
    if flat.min() >= 0.0:
        return values
    total = flat.sum(axis=1, keepdims=True)
    total = np.where(total > 0.0, total, flat.max(axis=1, keepdims=True))
    falling = -np.sort(-flat, axis=1)
    excess = (np.cumsum(falling, axis=1) - total) / np.arange(1, flat.shape[1] + 1)
    last = flat.shape[1] - 1 - np.argmax((falling > excess)[:, ::-1], axis=1)
    t = excess[np.arange(len(flat)), last]
    return np.asarray(np.maximum(flat - t[:, None], 0.0).reshape(values.shape))
