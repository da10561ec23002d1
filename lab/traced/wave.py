"""The exit pupil of one object point as smooth functions of the direction cosines.

Path, stop, rims and starting points of a bundle are fitted by polynomials of (L, M) with total degree
limited, in products of Chebyshev polynomials. Pupil distortion and the obliquity of the field, which a
transform over normalised pupil coordinates loses, are kept. The amplitude follows from energy: what
enters through an area ds dt leaves into dL dM, so that |A|^2 is the Jacobian d(s, t) / d(L, M).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import NDArray

from lab.traced.rays import Bundle

Array = NDArray[np.float64]

PATH_DEGREE: Final = 12
"""Of the path: its residual stays below 0.013 waves in the copies of `copies`, mostly below 0.003."""

MAP_DEGREE: Final = 6
"""Of where rays cross the stop and the rims: higher degrees swing outside the light."""

_GUARD: Final = 1.3  # times the affine image of the stop: beyond it, polynomials mean nothing


@dataclass(frozen=True, slots=True)
class TracedPupil:
    """What one object point sees through the lens in one wavelength."""

    # middle of the bundle's cosines and half its extent; polynomials live on [-1, 1]
    center: tuple[float, float]
    half: tuple[float, float]
    path_um: Array  # (d, d), chebyshev coefficients of W(L, M) in micrometres
    stop: Array  # (2, m, m), of the places where the stop and the rims are crossed, mm
    rims: Array
    entrance: Array  # (2, m, m), of the places where rays start, mm
    residual_um: float  # root mean square misfit of the path

    @classmethod
    def of(cls, bundle: Bundle) -> TracedPupil:
        """Fit a bundle."""
        low, high = bundle.cosines.min(axis=1), bundle.cosines.max(axis=1)
        center, half = (low + high) / 2.0, (high - low) / 2.0
        x, y = (bundle.cosines - center[:, None]) / half[:, None]
        degree = PATH_DEGREE
        while (degree + 1) * (degree + 2) > x.size:  # two rays a coefficient, when hardly any are left
            degree -= 2
        path, misfit = _fit(x, y, bundle.path_um[None], degree)
        maps, _ = _fit(
            x, y, np.vstack([bundle.stop, bundle.entrance, bundle.rims.reshape(-1, x.size)]), MAP_DEGREE
        )
        return cls(
            (float(center[0]), float(center[1])),
            (float(half[0]), float(half[1])),
            path[0],
            maps[:2],
            maps[4:].reshape(-1, 2, *maps.shape[1:]),
            maps[2:4],
            float(np.sqrt(np.mean(misfit**2))),
        )

    def grid(self, step: float) -> tuple[Array, Array]:
        """Cosines L and M, relative to `center`, that are multiples of `step` and cover the light."""
        axes = []
        for half in self.half:
            reach = math.ceil(half / step)
            axes.append(np.arange(-reach, reach + 1, dtype=np.float64) * step)
        return axes[0], axes[1]

    def evaluate(
        self, L: Array, M: Array, radius: float, limits: tuple[float, ...], focus_um: float
    ) -> tuple[Array, Array]:
        """Amplitude and path on the grid of L (right) and M (up), both `(M, L)`.

        Parameters
        ----------
        L, M : ndarray
            Relative to `center`.
        radius, limits : float, tuple of float
            Of the stop and the rims, mm.
        focus_um : float
            The sensor stands so much behind the plane that was traced.

        Returns
        -------
        amplitude, path_um : ndarray, shape (len(M), len(L))
            Edges of the amplitude are one sample wide. The path has no mean slope left.
        """
        x, y = L / self.half[0], M / self.half[1]
        tall, wide = (L + self.center[0])[None, :], (M + self.center[1])[:, None]
        path = _values(self.path_um, x, y) + focus_um * np.sqrt(1.0 - tall**2 - wide**2)
        amplitude = self._inside(x, y)
        for coefficients, limit in zip((self.stop, *self.rims), (radius, *limits), strict=True):
            amplitude = amplitude * _soft_disc(coefficients, x, y, limit)
        amplitude *= np.sqrt(np.maximum(self._jacobian(x, y), 0.0))
        return amplitude, path

    def _inside(self, x: Array, y: Array) -> Array:
        """1 where the affine part of the map to the stop stays near the light that was traced."""
        near = (np.abs(x) <= _GUARD)[None, :] & (np.abs(y) <= _GUARD)[:, None]
        return near.astype(np.float64)

    def _jacobian(self, x: Array, y: Array) -> Array:
        s, t = self.entrance
        along_x = [_values(chebyshev.chebder(c, axis=0), x, y) for c in (s, t)]
        along_y = [_values(chebyshev.chebder(c, axis=1), x, y) for c in (s, t)]
        return np.abs(along_x[0] * along_y[1] - along_x[1] * along_y[0])


def _fit(x: Array, y: Array, values: Array, degree: int) -> tuple[Array, Array]:
    """Coefficients `(k, degree + 1, degree + 1)` of `values` `(k, n)`, and the misfit."""
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i)]
    tx, ty = chebyshev.chebvander(x, degree), chebyshev.chebvander(y, degree)
    basis = np.stack([tx[:, i] * ty[:, j] for i, j in powers], axis=1)
    solved = np.linalg.lstsq(basis, values.T, rcond=1e-13)[0]
    coefficients = np.zeros((values.shape[0], degree + 1, degree + 1))
    for k, (i, j) in enumerate(powers):
        coefficients[:, i, j] = solved[k]
    return coefficients, values - (basis @ solved).T


def _values(coefficients: Array, x: Array, y: Array) -> Array:
    """Values `(len(y), len(x))` on a grid."""
    tx = chebyshev.chebvander(x, coefficients.shape[0] - 1)
    ty = chebyshev.chebvander(y, coefficients.shape[1] - 1)
    return np.asarray(ty @ coefficients.T @ tx.T)


def _soft_disc(coefficients: Array, x: Array, y: Array, radius: float) -> Array:
    """Disc in the mapped plane whose edge is one sample of the grid wide."""
    u, v = _values(coefficients[0], x, y), _values(coefficients[1], x, y)
    rho = np.hypot(u, v)
    slope = np.hypot(*np.gradient(rho))
    return np.clip((radius - rho) / np.maximum(slope, 1e-12) + 0.5, 0.0, 1.0)
