"""Kernels of all samples, turned and scaled from their own places to the place of a question.

In the radial frame of a place (u outwards, v along the ring) the kernels of a ring are alike, and
divided by the width of the place (see `widths`) those of all rings nearly are. So sample i is seen
from the question through the map of pixel offsets::

    M_i = L_i' S_i S^-1 L,      L = [[-sin phi, cos phi], [-cos phi, -sin phi]],   S = diag(s_u, s_v)

The kernel itself is kept in its own frame and resampled once (`splines`): turned into a common frame
and out of it again it would lose sharpness, and a frame fine enough to lose little is seventeen times
as large as the kernel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample, resized
from lensmodel.model import splines
from lensmodel.model.neighbours import Answers
from lensmodel.model.splines import FINER
from lensmodel.model.widths import WidthField

_CENTRED_PX = 1e-3  # pixels: a thousandth moves no figure that is reported
_STEPS = 6
"""Of centring at most: each lowers what is left many times over, and it ends when little is (chosen)."""
_ROOM = 1.35
"""Side over that of an answer, for kernels that are scaled down to it: few are scaled by more (chosen)."""
_MOST_BYTES = 1 << 29  # beyond, kernels are kept no finer than their pixels


@dataclass(frozen=True, slots=True, eq=False)
class LocalKernels:
    """Splines of the samples with the frames that they belong to."""

    side: int  # odd side of the stored kernels
    splines: NDArray[np.float32]  # (n, (finer (side - 1), coefficients
    # (n,), phi of the places in radians; radius of the light in steps of the grid
    angles: NDArray[np.float64]
    radii: NDArray[np.float64]
    widths: NDArray[np.float64]  # (n, 2), scales (s_u, s_v) of the places
    finer: int = FINER  # coefficients for each pixel along an axis

    @classmethod
    def of(cls, samples: Sequence[PsfSample], where: NDArray[np.float64], field: WidthField) -> LocalKernels:
        """Keep samples at points `where` (n, 7)."""
        side = max(s.kernel.shape[0] for s in samples)
        finer = FINER if 4 * (FINER * (side - 1) + 1) ** 2 * len(samples) <= _MOST_BYTES else 1
        stored = np.empty((len(samples), (finer * (side - 1) + 1) ** 2), dtype=np.float32)
        radii = np.empty(len(samples))
        for i, sample in enumerate(samples):
            spline = splines.coefficients(resized(sample.kernel, side), finer)
            stored[i], radii[i] = spline.ravel(), splines.light_radius(spline)
        angles = np.array([s.position.phi for s in samples])
        return cls(side, stored, angles, radii, field.over(where), finer)

    def rescaled(self, where: NDArray[np.float64], field: WidthField) -> LocalKernels:
        """Return the same kernels with widths of another field."""
        return replace(self, widths=field.over(where))

    @property
    def nbytes(self) -> int:
        """Bytes kept."""
        return int(self.splines.nbytes + self.angles.nbytes + self.radii.nbytes + self.widths.nbytes)

    def kernels(
        self,
        answers: Answers,
        angles: NDArray[np.float64],
        widths: NDArray[np.float64],
        size: int,
    ) -> NDArray[np.float64]:
        """Means of the neighbours at places of `angles` (q,) and `widths` (q, 2), shape (q, size, size).

        Non-negative, sum 1, centre of mass on the middle pixel. Centring moves the points at which the
        splines are read: kernels are not resampled again.
        """
        from lensmodel.model import loops  # noqa: PLC0415 - Numba takes a while to load

        shifts = np.zeros((len(angles), 2))
        light = np.empty((len(angles), size, size))
        t = np.arange(size, dtype=np.float64) - size // 2
        open_ = np.arange(len(angles))
        maps, weights, rows, starts = self._seen(answers, angles, widths)
        for _ in range(_STEPS):
            part = _subset(starts, open_)
            kernels = np.zeros((len(open_), size, size))
            ends = np.concatenate([[0], np.cumsum(np.diff(starts)[open_])])
            read = rows[part], weights[part], maps[part], ends, shifts[open_]
            loops.sums(self.splines, self.radii, *read, kernels)
            loops.without_negatives(kernels.reshape(len(open_), -1))
            light[open_] = kernels
            total = kernels.sum(axis=(1, 2))
            row, col = kernels.sum(axis=2) @ t / total, kernels.sum(axis=1) @ t / total
            shifts[open_] -= np.stack([row, col], axis=1)
            open_ = open_[np.hypot(row, col) >= _CENTRED_PX]
            if not open_.size:
                break
        return np.asarray(light / light.sum(axis=(1, 2), keepdims=True))

    def upright(self, rows: NDArray[np.intp]) -> NDArray[np.float64]:
        """Kernels at phi = 0 and unit width, rows towards -v, columns towards u, shape (m, side, side)."""
        from lensmodel.model import loops  # noqa: PLC0415 - as above

        count, side = len(rows), 2 * int(np.ceil(self.side // 2 * _ROOM)) + 1
        single = Answers(rows, np.ones(count), np.arange(count + 1))
        maps, weights, _, starts = self._seen(single, np.zeros(count), np.ones((count, 2)))
        kernels = np.zeros((count, side, side))
        loops.sums(self.splines, self.radii, rows, weights, maps, starts, np.zeros((count, 2)), kernels)
        return kernels

    def _seen(
        self, answers: Answers, angles: NDArray[np.float64], widths: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.intp], NDArray[np.intp]]:
        """Maps, weights times determinants, rows and starts."""
        asked = np.repeat(np.arange(len(angles)), answers.counts)
        rows = answers.rows
        scale = self.widths[rows] / widths[asked]
        factor = answers.weights * scale[:, 0] * scale[:, 1]
        own, here = self.angles[rows], angles[asked]
        return affine_maps(own, here, scale * self.finer), factor, rows, answers.starts


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
