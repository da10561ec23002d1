"""Where to begin the fit of a wavefront: parameters whose ray spots have the moments of the samples.

A ray through the pupil point p lands at X(p) = sum_k g_k grad B_k(p), and g is linear in the
unknowns. So the second and third central moments of the spots are quadratic and cubic forms, cheap
enough to be fitted from many random beginnings. Second moments alone do not know a spot from the
same turned by 180 degrees; third moments do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.descent import Descent
from lensmodel.core.psf import PsfSample, second_moments
from lensmodel.optics.pupil import ray_gradients

_RAYS = 11
"""Across the pupil: enough for moments that only give a beginning; the cost grows with its square
(chosen)."""
_BEGINNINGS, _TRIES = 24, 25
"""At random, and steps that are tried from each: moments are cheap, and most descents end earlier
(chosen)."""
_ENOUGH = 1e-4  # of the cost: less gained in a step ends a descent (chosen)
_SEED = 0  # any number: fits repeat to the bit
_FLOOR = 1e-9  # of the diagonal that is damped: far below any that counts (chosen)
_LEVEL = 0.01  # of the peak: fainter pixels are noise to a second moment (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class _SpotFit:
    """Unknowns of a wavefront, and how well the moments of its ray spots are those of the samples."""

    terms: NDArray[np.float64]
    cost: float
    normal: NDArray[np.float64]
    gradient: NDArray[np.float64]


def starts(
    samples: Sequence[PsfSample],
    designs: NDArray[np.float64],
    prior_px: NDArray[np.float64],
    q: float,
    count: int,
) -> list[NDArray[np.float64]]:
    """Propose unknowns, the likeliest first.

    Parameters
    ----------
    samples : sequence of PsfSample
    designs : ndarray, shape (n, 6, m)
        Blur terms of each sample per unknown.
    prior_px : ndarray, shape (m,)
        Usual size of each unknown.
    q : float
        Width of diffraction in pixels.
    count : int
        How many to return.
    """
    across, up = _rays()
    second, third = _moments(samples, q)
    scale = float(max(np.median(second[:, 0] + second[:, 1]) / 2.0, 0.05))
    rng = np.random.default_rng(_SEED)
    ranked = []
    for _ in range(_BEGINNINGS):
        terms = rng.normal(0.0, 0.4 * np.sqrt(scale), len(prior_px)) * prior_px / prior_px.max()
        ranked.append(
            _descended(terms, designs, across, up, second / scale, third / scale**1.5, scale, prior_px)
        )
    ranked.sort(key=lambda pair: pair[0])
    kept: list[NDArray[np.float64]] = []
    for _, terms in ranked:
        if all(np.abs(terms - other).max() > 0.1 * np.sqrt(scale) for other in kept):
            kept.append(terms)
    return kept[:count]


def _rays() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Gradients of the six terms over the pupil, (6, rays) each, means taken off."""
    p = (np.arange(_RAYS) + 0.5) * 2.0 / _RAYS - 1.0
    x, y = (a.ravel() for a in np.meshgrid(p, p))
    inside = x * x + y * y <= 1.0
    across, up = ray_gradients(x[inside], y[inside])
    return across - across.mean(axis=1, keepdims=True), up - up.mean(axis=1, keepdims=True)


def _moments(samples: Sequence[PsfSample], q: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Second (xx, yy, xy) and third (xxx, xxy, xyy, yyy) central moments, (right, up)."""
    second, third = [], []
    floor = 1.0 / 12.0 + (0.45 * q) ** 2  # pixel, and the core of diffraction
    for s in samples:
        (rr, rc), (_, cc) = second_moments(s.kernel, _LEVEL)
        second.append([max(cc - floor, 0.0), max(rr - floor, 0.0), -rc])
        core = np.where(s.kernel > _LEVEL * s.kernel.max(), s.kernel, 0.0)
        core = core / core.sum()
        t = np.arange(core.shape[0]) - core.shape[0] // 2
        x = (t - float(core.sum(axis=0) @ t))[None, :]
        y = -(t - float(core.sum(axis=1) @ t))[:, None]
        third.append([float((core * m).sum()) for m in (x**3, x * x * y, x * y * y, y**3)])
    return np.array(second), np.array(third)


def _descended(
    terms: NDArray[np.float64],
    designs: NDArray[np.float64],
    across: NDArray[np.float64],
    up: NDArray[np.float64],
    second: NDArray[np.float64],
    third: NDArray[np.float64],
    scale: float,
    prior_px: NDArray[np.float64],
) -> tuple[float, NDArray[np.float64]]:
    """Least squares of the moments; returns the cost and the unknowns."""
    rays = across.shape[1]
    by_x = np.einsum("nkm,kr->nmr", designs, across)
    by_y = np.einsum("nkm,kr->nmr", designs, up)
    ridge = 0.02 * np.sqrt(scale) / prior_px
    two, three = 1.0 / scale, 0.3 / scale**1.5

    def about(t: NDArray[np.float64]) -> _SpotFit:
        x, y = np.einsum("nmr,m->nr", by_x, t), np.einsum("nmr,m->nr", by_y, t)
        pairs = [(x * x, [(2 * x, None)]), (y * y, [(None, 2 * y)]), (x * y, [(y, x)])]
        cubes = [
            (x**3, [(3 * x * x, None)]),
            (x * x * y, [(2 * x * y, x * x)]),
            (x * y * y, [(y * y, 2 * x * y)]),
            (y**3, [(None, 3 * y * y)]),
        ]
        values, slopes = [], []
        for group, factor, wanted in ((pairs, two, second), (cubes, three, 0.3 * third)):
            for column, (value, ((dx, dy),)) in enumerate(group):
                values.append(factor * value.mean(axis=1) - wanted[:, column])
                slope = np.zeros((len(x), len(t)))
                if dx is not None:
                    slope += np.einsum("nmr,nr->nm", by_x, dx) / rays
                if dy is not None:
                    slope += np.einsum("nmr,nr->nm", by_y, dy) / rays
                slopes.append(factor * slope)
        values.append(ridge * t)
        slopes.append(np.diag(ridge))
        miss, change = np.concatenate(values), np.concatenate(slopes)
        return _SpotFit(t, float(miss @ miss), change.T @ change, -(change.T @ miss))

    descent = Descent(_TRIES, _TRIES, enough_of_cost=_ENOUGH, floor=_FLOOR, most_tries=_TRIES)
    state = descent.down(about(terms), lambda state, step: about(state.terms + step))
    return state.cost, state.terms
