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

import numpy as np
from numpy.typing import NDArray

from lensmodel.psf import PsfSample, resized
from lensmodel.types import FieldPosition, Kernel

NUGGETS = (1e-4, 1e-3, 1e-2, 1e-1, 1.0)
"""Variances of a sample of vote 1, over that of the field, that cross-validation chooses from."""

_MOST = 64
_SETTINGS = (3, 4, 5, 6)


def pixel_rows(samples: Sequence[PsfSample], side: int) -> list[NDArray[np.float32]]:
    """Kernels of the image frame as flat rows of `side` squared pixels."""
    return [resized(s.kernel, side).astype(np.float32).ravel() for s in samples]


def field_vector(position: FieldPosition) -> NDArray[np.float64]:
    """(x, y) to the right and up, in half-diagonals."""
    return position.r * np.array([np.cos(position.phi), np.sin(position.phi)])


def predict(
    rows: NDArray[np.float32],
    vectors: NDArray[np.float64],
    where: NDArray[np.float64],
    votes: NDArray[np.float64],
    vector: NDArray[np.float64],
    asked: NDArray[np.float64],
    scale: NDArray[np.float64],
    nugget: float,
) -> NDArray[np.float64]:
    """Kriged row of pixels at a place, from the nearest samples.

    Parameters
    ----------
    rows : ndarray, shape (n, k^2)
        Kernels of the image frame.
    vectors, vector : ndarray, shape (n, 2), (2,)
        Places of samples and question, from `field_vector`.
    where, asked, scale : ndarray, shape (n, 7), (7,), (7,)
        Points and bandwidths, of which the settings count.
    votes : ndarray, shape (n,)
        Those of 0 take no part.
    nugget : float
        Variance of a sample of vote 1.
    """
    apart = settings_gap(where, asked, scale)
    nearness = ((vectors - vector) ** 2).sum(axis=1) + apart
    nearness[votes <= 0] = np.inf
    few = min(_MOST, int((votes > 0).sum()))
    chosen = np.argpartition(nearness, few - 1)[:few]
    places, settings = vectors[chosen], where[chosen]
    between = np.sqrt(((places[:, None] - places[None]) ** 2).sum(axis=-1))
    gaps = settings_gap(settings[:, None, :], settings[None, :, :], scale)
    covariance = matern(between) * np.exp(-0.5 * gaps)
    covariance[np.diag_indices_from(covariance)] += nugget / np.maximum(votes[chosen], 1e-3)
    towards = matern(np.sqrt(((places - vector) ** 2).sum(axis=1))) * np.exp(-0.5 * apart[chosen])
    solved = np.linalg.solve(covariance, np.stack([towards, np.ones(few)], axis=1))
    # far from every sample `towards` vanishes, and what is left is the mean
    weights = solved[:, 0] + solved[:, 1] * (1.0 - solved[:, 0].sum()) / solved[:, 1].sum()
    return np.asarray(weights @ rows[chosen], dtype=np.float64)


def held_out_errors(
    rows: NDArray[np.float32],
    vectors: NDArray[np.float64],
    where: NDArray[np.float64],
    votes: NDArray[np.float64],
    scale: NDArray[np.float64],
    groups: NDArray[np.intp],
) -> tuple[float, NDArray[np.float64]]:
    """Choose the nugget by leaving groups out; return it with the relative L2 of every sample.

    With B = K^-1 - K^-1 1 1'K^-1 / (1'K^-1 1), the residuals of a group p that was left out are
    (B_pp)^-1 (B C)_p: one inverse serves all groups.
    """
    values = np.asarray(rows, dtype=np.float64)
    norms = np.sqrt((values**2).sum(axis=1))
    between = np.sqrt(((vectors[:, None] - vectors[None]) ** 2).sum(axis=-1))
    gaps = settings_gap(where[:, None, :], where[None, :, :], scale)
    covariance = matern(between) * np.exp(-0.5 * gaps)
    best: tuple[float, float, NDArray[np.float64]] | None = None
    for nugget in NUGGETS:
        inverse = np.linalg.inv(covariance + np.diag(nugget / np.maximum(votes, 1e-3)))
        ones = inverse.sum(axis=1)
        projected = inverse - np.outer(ones, ones) / ones.sum()
        answered = projected @ values
        errors = np.ones(len(values))
        for group in np.unique(groups):
            held = np.flatnonzero(groups == group)
            if len(held) < len(values):
                left = np.linalg.solve(projected[np.ix_(held, held)], answered[held])
                errors[held] = np.sqrt((left**2).sum(axis=1)) / np.maximum(norms[held], 1e-30)
        score = float(np.average(np.minimum(errors, 1.5), weights=np.maximum(votes, 1e-9)))
        if best is None or score < best[0]:
            best = (score, nugget, errors)
    assert best is not None
    return best[1], best[2]


def as_pixels(row: NDArray[np.float64], size: int) -> Kernel:
    """Row of pixels as a kernel of odd side `size`; negative pixels become zero."""
    side = round(row.size**0.5)
    return resized(np.maximum(row.reshape(side, side), 0.0), size)


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
