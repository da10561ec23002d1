"""How wide the PSF is where: so that kernels of other places can be brought to the width of this one.

A Nadaraya-Watson mean cross-fades kernels of different widths, which is too wide where the blur
grows outwards and ends too early in the corners. Widths are smooth and few: the root mean square
widths along u and v, as logarithms, follow a low-order polynomial of the place::

    log s = b0 + b1 r^2 + b2 r^4 + b3 x + b4 y + b5 x r^2 + b6 y r^2 + b7 (x^2 - y^2) + b8 x y + settings

(third-order theory: coma grows as r, astigmatism and field curvature as r^2; a decentred copy adds
odd terms in x and y). Each sample is scaled to its place's predicted width before averaging, and
the mean is scaled back to the width predicted at the query.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import PsfSample, second_moments
from lensmodel.core.types import WAVELENGTH_NM
from lensmodel.model import variables as va

# Of 1, r, r^2, then the rest: weak, only against too few samples (chosen)
_PLACE_RIDGE = np.array([1e-6, 1e-3, 1e-2, 0.05, 0.05, 0.05, 0.05, 0.05, 0.05])
_SETTING_RIDGE = 0.05
"""Of the terms of the settings: with none, two apertures would scale kernels at will (chosen)."""
_RANGE = (0.45, 2.5)  # factors by which a kernel is scaled at most: beyond, its shape is another one (chosen)
_HUBER = 0.15  # of a logarithm of the width: the scatter of estimates (chosen)
_MIN_SAMPLES = 6  # below, widths are carried nowhere: the fit over the field has more terms (chosen)
_MOST = 3000  # samples: the cost of the fit grows with them (chosen)
_ROUNDS = 4  # of reweighting: each costs as much, and later ones change less (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class WidthField:
    """Widths (s_u, s_v) of the PSF over the field, relative to a reference width of the model."""

    # (m, 2), coefficients of log s_u and log s_v; None = one width everywhere
    slopes: NDArray[np.float64] | None = None
    reference: float = 0.0  # logarithm of the width that counts as 1
    stops: float = 0.0  # origins of the settings, where terms of them are zero
    focal: float = 0.0

    def over(self, where: NDArray[np.float64]) -> NDArray[np.float64]:
        """Widths along u and v at points `(n, 7)` of `variables`, over the reference width, shape (n, 2)."""
        if self.slopes is None:
            return np.ones((len(where), 2))
        # no matrix product: how that rounds hangs on how many places are asked for at once
        logarithms = (self._features(where)[:, :, None] * self.slopes).sum(axis=1)
        return np.clip(np.exp(logarithms - self.reference), *_RANGE)

    def _features(self, where: NDArray[np.float64]) -> NDArray[np.float64]:
        r2 = where[:, 0] ** 2
        x, y = va.vectors(where).T
        stops, focal = where[:, 3] - self.stops, where[:, 5] - self.focal
        stops[np.isnan(stops)] = focal[np.isnan(focal)] = 0.0
        wave = (where[:, 4] - WAVELENGTH_NM["g"]) / 100.0
        place = [np.ones_like(r2), r2, r2 * r2, x, y, x * r2, y * r2, x * x - y * y, x * y]
        return np.stack(
            [*place, stops, stops * stops, stops * r2, focal, focal * r2, wave, wave * wave], axis=1
        )

    @classmethod
    def fit(cls, samples: Sequence[PsfSample], weights: NDArray[np.float64]) -> WidthField:
        """Fit the widths of weighted samples robustly; one width everywhere below six samples.

        Huber's weights by iteration: a width that is wrong by a factor counts less, not nothing.
        """
        rows = np.flatnonzero(weights > 0)
        if len(rows) < _MIN_SAMPLES:
            return cls()
        if len(rows) > _MOST:
            rows = rows[np.linspace(0, len(rows) - 1, _MOST).round().astype(np.intp)]
        samples = [samples[int(i)] for i in rows]
        where = va.points(samples)
        known = (column[~np.isnan(column)] for column in (where[:, 3], where[:, 5]))
        stops, focal = (float(np.median(column)) if column.size else 0.0 for column in known)
        origin = cls(stops=stops, focal=focal)
        design = origin._features(where)
        target = np.array([_log_widths(s) for s in samples])
        weight = np.maximum(weights[rows], 1e-3)
        extra = design.shape[1] - len(_PLACE_RIDGE)
        ridge = np.diag(np.concatenate([_PLACE_RIDGE, np.full(extra, _SETTING_RIDGE)])) * weight.mean()
        trust = np.ones(len(samples))
        slopes = np.zeros((design.shape[1], 2))
        for _ in range(_ROUNDS):
            weighted = design * (weight * trust)[:, None]
            slopes = np.linalg.solve(design.T @ weighted + ridge, weighted.T @ target)
            miss = np.abs(target - design @ slopes).max(axis=1)
            trust = np.minimum(1.0, _HUBER / np.maximum(miss, 1e-12))
        seen = design @ slopes
        reference = float((seen.min() + seen.max()) / 2.0)  # as far from the narrowest as from the widest
        return cls(slopes, reference, stops, focal)


def _log_widths(sample: PsfSample) -> tuple[float, float]:
    """Logarithms of the root mean square widths along u and v, pixels."""
    (rr, rc), (_, cc) = second_moments(sample.kernel)
    c, s = np.cos(sample.position.phi), np.sin(sample.position.phi)
    # u points to (-sin, cos) and v to (-cos, -sin) in (row, col)
    uu = s * s * rr - 2 * s * c * rc + c * c * cc
    vv = c * c * rr + 2 * s * c * rc + s * s * cc
    return float(0.5 * np.log(max(uu, 0.04))), float(0.5 * np.log(max(vv, 0.04)))
