"""The PSF as a smooth function of the place in the image frame, without turning any kernel.

Aberrations are polynomials of the field vector (x, y), so the kernel of the image frame is smooth
all over the field, the centre included, where the local frame has no direction. Each pixel is a
Gaussian process of unknown mean with Matern-3/2 covariance over (x, y)::

    c(d) = (1 + sqrt(3) d) exp(-sqrt(3) d) G(settings),   d in half-diagonals
    l = K^-1 k + K^-1 1 (1 - 1'K^-1 k) / (1'K^-1 1),   K = c + nugget / q

One set of weights l serves all pixels (kriging). It is exact where samples are good and dense, and
knows nothing of the symmetry of a ring: what it gains and where is left to held-out errors.
Source: C. E. Rasmussen, C. K. I. Williams, "Gaussian Processes for Machine Learning", 2006, ch. 4;
N. Cressie, "Statistics for Spatial Data", 1993, section 3.2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample, resized
from lensmodel.core.types import FieldPosition
from lensmodel.model import variables as va

NUGGETS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0, 10.0, 100.0)
"""Variances of a sample of vote 1, over that of the field, that cross-validation chooses from."""

_SETTINGS = (3, 4, 5, 6)  # columns of `variables.COLUMNS` that are no place
_CAP = 1.5  # relative errors beyond count no more than this: one outlier chooses nothing (chosen)
_ALIKE = 1e-7  # covariance below which a sample is left out of an answer
_KNOWN = 32  # settings that are remembered

Alike = tuple[NDArray[np.float64], NDArray[np.float64], slice | NDArray[np.intp]]


def field_vector(position: FieldPosition) -> NDArray[np.float64]:
    """(x, y) to the right and up, in half-diagonals."""
    return position.r * np.array([np.cos(position.phi), np.sin(position.phi)])


@dataclass(frozen=True, slots=True, eq=False)
class ImageFrame:
    """A field kriged once for all: with B of `fit`, the rest B C and the mean, l C = c' (B C) + mean.

    Parameters
    ----------
    vectors, where : ndarray, shape (m, 2), (m, 7)
        Places and points of the samples that it was made from.
    rest : ndarray, shape (m, side^2)
        In double precision: with a small nugget its rows are large and nearly cancel.
    mean : ndarray, shape (side^2,)
    nugget : float
        Variance of a sample of vote 1 over that of the field.
    settings : dict
        Which samples speak at settings that were asked for, how much, and where they lie.
    """

    vectors: NDArray[np.float64]
    where: NDArray[np.float64]
    rest: NDArray[np.float64]
    mean: NDArray[np.float64]
    nugget: float
    settings: dict[bytes, Alike] = field(default_factory=dict, init=False)

    @classmethod
    def fit(
        cls,
        samples: Sequence[PsfSample],
        where: NDArray[np.float64],
        votes: NDArray[np.float64],
        scale: NDArray[np.float64],
        groups: NDArray[np.intp],
    ) -> tuple[ImageFrame, NDArray[np.float64]]:
        """Choose the nugget by leaving groups out; return it with the held-out errors of the samples.

        With B = K^-1 - K^-1 1 1'K^-1 / (1'K^-1 1), the residuals of a group p that was left out are
        (B_pp)^-1 (B C)_p: one inverse serves all groups and, after that, all questions.

        Parameters
        ----------
        samples : sequence of PsfSample
            Those that vote.
        where, scale : ndarray, shape (m, 7), (7,)
            Points and bandwidths, of which the settings count.
        votes : ndarray, shape (m,)
        groups : ndarray of int, shape (m,)
            Samples that are held out together.
        """
        order = np.lexsort(where[:, _SETTINGS].T)  # those of one setting together, see `rows`
        back = np.argsort(order)
        samples, where = [samples[i] for i in order], where[order]
        votes, groups = votes[order], groups[order]
        side = max(s.kernel.shape[0] for s in samples)
        values = np.stack([resized(s.kernel, side).ravel() for s in samples])
        vectors = va.vectors(where)
        norms = np.sqrt((values**2).sum(axis=1))
        covariance = matern(np.sqrt(squared_gaps(vectors, vectors)))
        covariance *= np.exp(-0.5 * settings_gap(where[:, None, :], where[None, :, :], scale))
        own = [np.flatnonzero(groups == group) for group in np.unique(groups)]
        best: tuple[float, ImageFrame, NDArray[np.float64]] | None = None
        for nugget in NUGGETS:
            inverse = np.linalg.inv(covariance + np.diag(nugget / np.maximum(votes, 1e-3)))
            ones = inverse.sum(axis=1)
            mean = ones @ values / ones.sum()
            answered = inverse @ (values - mean)  # equal to B C
            projected = inverse - np.outer(ones, ones) / ones.sum()
            errors = np.ones(len(values))
            for held in own:
                if len(held) < len(values):
                    left = np.linalg.solve(projected[np.ix_(held, held)], answered[held])
                    errors[held] = np.sqrt((left**2).sum(axis=1)) / np.maximum(norms[held], 1e-30)
            score = float(np.average(np.minimum(errors, _CAP), weights=np.maximum(votes, 1e-9)))
            if best is None or score < best[0]:
                best = (score, cls(vectors, where, answered, mean, nugget), errors)
        assert best is not None
        return best[1], best[2][back]

    def rows(
        self, vectors: NDArray[np.float64], asked: NDArray[np.float64], scale: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Kriged rows of pixels at places `vectors` (q, 2) and one setting, shape (q, side^2).

        Parameters
        ----------
        asked, scale : ndarray, shape (7,)
            Point of the question, of which the settings count, and bandwidths.
        """
        # bytes, since an unknown setting is NaN, which is not equal to itself
        key = asked[list(_SETTINGS)].tobytes() + scale.tobytes()
        known = self.settings.get(key)
        if known is None:
            gap = settings_gap(self.where, asked, scale)
            alike = np.exp(-0.5 * (gap - gap.min()))  # far from all settings the nearest still speak
            near = np.flatnonzero(alike > _ALIKE)
            part = slice(int(near[0]), int(near[-1]) + 1) if _run(near) else near
            known = alike[part], self.vectors[part], part
            if len(self.settings) >= _KNOWN:
                self.settings.clear()
            self.settings[key] = known
        alike, places, part = known
        towards = matern(np.sqrt(squared_gaps(vectors, places))) * alike
        # far from every sample `towards` vanishes, and what is left is the mean
        return np.asarray(towards @ self.rest[part] + self.mean)


def _run(rows: NDArray[np.intp]) -> bool:
    """Whether rows follow each other: a slice of them is no copy."""
    return int(rows[-1] - rows[0]) == len(rows) - 1


def as_kernels(rows: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    """Rows of pixels as kernels of odd side `size`, shape (q, size, size); negative pixels become zero."""
    side = round(rows.shape[1] ** 0.5)
    kernels = np.maximum(rows.reshape(-1, side, side), 0.0)
    cut, pad = max((side - size) // 2, 0), max((size - side) // 2, 0)
    kernels = kernels[:, cut : side - cut, cut : side - cut]
    kernels = kernels / np.maximum(kernels.sum(axis=(1, 2), keepdims=True), 1e-30)
    return np.pad(kernels, ((0, 0), (pad, pad), (pad, pad))) if pad else kernels


def squared_gaps(a: NDArray[np.float64], b: NDArray[np.float64]) -> NDArray[np.float64]:
    """Squared distances of places `a` (m, 2) from places `b` (n, 2), shape (m, n)."""
    x, y = np.subtract.outer(a[:, 0], b[:, 0]), np.subtract.outer(a[:, 1], b[:, 1])
    return np.asarray(x * x + y * y)


def matern(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matern-3/2 covariance of a distance in half-diagonals."""
    scaled = np.sqrt(3.0) * distance
    return np.asarray((1.0 + scaled) * np.exp(-scaled))


def settings_gap(
    where: NDArray[np.float64], asked: NDArray[np.float64], scale: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Squared distance of settings in bandwidths; unknown ones drop out."""
    total = np.zeros(np.broadcast_shapes(where.shape[:-1], asked.shape[:-1]))
    for column in _SETTINGS:
        values = where[..., column]
        first = values.flat[0]
        if np.isnan(asked[..., column]).all() or (
            (values == first).all() and (asked[..., column] == first).all()
        ):
            continue  # most lenses are asked for at the one setting that they have: this is the fast path
        gap = (values - asked[..., column]) / scale[column]
        total += np.where(np.isnan(gap), 0.0, gap * gap)
    return total
