"""A smooth parametric field of Gaussians, `kee`.

Source: E. Kee, S. Paris, S. Chen and J. Wang, "Modeling and removing spatially-varying optical blur",
ICCP 2011. The PSF of each colour is a Gaussian whose covariance is a polynomial of the place in the
frame. They fit it to a printed pattern; here it is fitted blindly, to the straight edges of photos.

Across an edge with unit normal n at place p the line spread function has the variance::

    s² = n' C(p) n + s0²,        C(p) = sum_j C_j m_j(p),    m_j monomials of degree <= d

which is linear in the C_j: one least-squares problem for all edges of a photo.

Departures from the paper:

1. Edges of a scene are soft by themselves, and always make blur look wider: of the residuals those of
   wider edges count less (an expectile), and what the edges of sharp photographs have is taken off.
2. Terms beyond the constant are drawn to zero where edges are few.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lab.blind.methods.edges import EdgeProfile, profiles
from lab.blind.steps.pyramid import View
from lab.rivals.rival import PhotoWindow, polynomial, powers, windows_of
from lensmodel.core import psf
from lensmodel.core.errors import NotEnoughEvidenceError
from lensmodel.core.types import CHANNELS, Channel, FieldPosition, Kernel
from lensmodel.photo import LinearPhoto

_DIRECTIONS = 24  # in half a turn, like `_STEP_PX` as in `lab.blind.methods.edges`
_STEP_PX = 0.25  # bins of a profile
_CORE_LEVEL = 0.05  # of the peak (chosen): what lies below is left out, noise would widen the variance
_SAMPLING_PX2 = 1.0 / 12.0 + 5.0 / 12.0 * _STEP_PX**2  # of the pixel, the bins and their differences
_LEAST_EDGES = 12  # of a colour (chosen): two for each of six monomials
_ROUNDS = 12  # of reweighted least squares (chosen)
_LEAST_PX2, _MOST_PX2 = 0.01, 36.0  # bounds of a variance (chosen): standard deviations of 0.1 and 6 pixels

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class GaussianField:
    """Gaussians whose covariance is a polynomial of the place.

    Parameters
    ----------
    terms : mapping of channel to ndarray, shape (terms, 3)
        C_j as (row row, row col, col col) in px², in the order of `powers`; x to the right and y
        upwards in half diagonals.
    degree : int
        d.
    """

    terms: dict[Channel, Floats]
    degree: int

    def covariance(self, position: FieldPosition, channel: Channel) -> Floats:
        """C(p), its eigenvalues kept positive."""
        x, y = position.r * math.cos(position.phi), position.r * math.sin(position.phi)
        rr, rc, cc = polynomial(np.array(x), np.array(y), self.degree) @ self.terms[channel]
        sizes, axes = np.linalg.eigh(np.array([[rr, rc], [rc, cc]]))
        return np.asarray(axes @ np.diag(np.clip(sizes, _LEAST_PX2, _MOST_PX2)) @ axes.T)

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the Gaussian of a place; see `PsfField`."""
        return psf.gaussian(size, self.covariance(position, channel))


@dataclass(frozen=True, slots=True)
class Kee:
    """Field of Gaussians from straight edges.

    Parameters
    ----------
    degree : int
        Of the polynomial. Four would hold what third-order aberrations do, and followed noise.
    expectile : float
        Weight of edges wider than the fit, against those that are narrower.
    softness_px2 : float
        Variance that the edges of sharp photographs have.
    pull : float
        Weight of drawing a term to zero, in edges.
    reach, along : int
        Half extent of an edge across and along, pixels.
    """

    degree: int = 2
    expectile: float = 0.02
    softness_px2: float = 0.6
    pull: float = 0.2
    reach: int = 9
    along: int = 4

    name = "kee"
    source = "Kee et al. 2011 (field of Gaussians, fitted to the edges of the photo)"

    def field(self, photos: Sequence[LinearPhoto]) -> GaussianField:
        """Fit the field; see `Rival`."""
        windows = windows_of(photos)
        return GaussianField(
            {channel: self._fitted(windows, i) for i, channel in enumerate(CHANNELS)}, self.degree
        )

    def _fitted(self, windows: Sequence[PhotoWindow], channel: int) -> Floats:
        places: list[tuple[float, float]] = []
        edges: list[EdgeProfile] = []
        for window in windows:
            view = View.of(window.plane(channel), window.noise[channel])
            found = profiles(view, self.reach, self.along)
            r, phi = window.position.r, window.position.phi
            places += [(r * math.cos(phi), r * math.sin(phi))] * len(found)
            edges += found
        if len(edges) < _LEAST_EDGES:
            raise NotEnoughEvidenceError(
                f"{len(edges)} straight edges determine no field of Gaussians; use photos with more of them"
            )
        angle = np.array([edge.direction for edge in edges]) * (math.pi / _DIRECTIONS)
        variance = np.array([core_variance(edge.spread) for edge in edges])
        variance -= _SAMPLING_PX2 + self.softness_px2
        return self.solved(np.array(places), angle, variance)

    def solved(self, places: Floats, angle: Floats, variance: Floats) -> Floats:
        """Fit the polynomial.

        Parameters
        ----------
        places : ndarray, shape (n, 2)
            x and y in half diagonals.
        angle : ndarray, shape (n,)
            Of the edge's normal, counter-clockwise from the right, radians.
        variance : ndarray, shape (n,)
            Along the normal, px², of the blur alone.

        Returns
        -------
        ndarray, shape (terms, 3)
            Entries (row row, row col, col col) of each C_j.
        """
        row, col = -np.sin(angle), np.cos(angle)
        along = np.stack([row * row, 2.0 * row * col, col * col], axis=-1)
        terms = polynomial(places[:, 0], places[:, 1], self.degree)
        design = (terms[:, :, None] * along[:, None, :]).reshape(len(angle), -1)
        order = np.repeat([i + j for i, j in powers(self.degree)], 3)
        pull = np.diag(np.where(order > 0, self.pull, 1e-6))
        weights = np.ones(len(angle))
        solution = np.zeros(design.shape[1])
        for _ in range(_ROUNDS):
            weighted = design * weights[:, None]
            solution = np.linalg.solve(weighted.T @ design + pull, weighted.T @ variance)
            residual = variance - design @ solution
            # far outliers, edges that are no edges, count by their distance and not by its square
            scale = 1.5 * float(np.median(np.abs(residual))) + 1e-9
            robust = 1.0 / np.maximum(np.abs(residual) / scale, 1.0)
            weights = robust * np.where(residual > 0, self.expectile, 1.0 - self.expectile)
        return np.asarray(solution.reshape(-1, 3))


def core_variance(spread: Floats) -> float:
    """Variance in px² of a line spread function above a twentieth of its peak."""
    s = (np.arange(spread.size) - spread.size // 2 + 0.5) * _STEP_PX
    core = np.where(spread > _CORE_LEVEL * spread.max(), spread, 0.0)
    core = core / core.sum()
    middle = float((core * s).sum())
    return float((core * (s - middle) ** 2).sum())
