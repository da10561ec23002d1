"""Ways to weigh neighbours that the product does not use: those that the comparison of regressions tells of.

`make_known` registers them by name in this process, as a user registers a method of his own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.model import Neighbours, Smoother, smoothers
from lensmodel.model.field.smoothers import NadarayaWatson, gaussian_weights


@dataclass(frozen=True, slots=True)
class NearestNeighbours:
    """Bandwidth that grows where samples are rare: the k-th neighbour lies at `at` bandwidths.

    The paper's closing proposal for the corners. Where samples are dense it is the fixed one.
    """

    k: int = 6
    at: float = 1.0
    transport: bool = False
    reach: float = 8.0
    physical: bool = False

    def weights(self, near: Neighbours) -> NDArray[np.float64]:
        """Weights of sum 1."""
        squared = near.squared
        kth = np.sqrt(np.partition(squared, min(self.k, squared.size) - 1)[min(self.k, squared.size) - 1])
        return gaussian_weights(squared / max(1.0, float(kth) / self.at) ** 2, near.votes)


@dataclass(frozen=True, slots=True)
class Abramson:
    """Bandwidths that belong to the samples: lambda_i = (p(x_i) / g)^(-1/2) within 0.5..3.

    p is a pilot density of the neighbours, g its geometric mean; a sample's kernel is divided by
    lambda_i^2, its volume in the field. Source: I. S. Abramson, "On bandwidth variation in kernel
    estimates", Annals of Statistics 10, 1982.
    """

    transport: bool = False
    reach: float = 5.0
    physical: bool = False

    def weights(self, near: Neighbours) -> NDArray[np.float64]:
        """Weights of sum 1."""
        place = near.gaps
        apart = ((place[:, None, :] - place[None, :, :]) ** 2).sum(axis=-1)
        density = np.exp(-0.5 * apart).mean(axis=1)
        stretch = np.clip((density / np.exp(np.log(density).mean())) ** -0.5, 0.5, 3.0)
        return gaussian_weights(near.squared / stretch**2, near.votes / stretch**2)


@dataclass(frozen=True, slots=True)
class LocalLinear:
    """A straight line in r through the neighbours: no first-order bias at the edge of the data.

    With rows t_i = (1, (r_i - r) / h_r) and W = diag(w)::

        l = e1' (T'WT + diag(0, ridge))^-1 T'W

    Falls back to `NadarayaWatson` where fewer than `least` samples stand behind the answer.
    """

    ridge: float = 0.3
    least: float = 5.0
    transport: bool = False
    reach: float = 4.0
    physical: bool = False

    def weights(self, near: Neighbours) -> NDArray[np.float64]:
        """Weights of sum 1; some may be negative."""
        w = gaussian_weights(near.squared, near.votes)
        if 1.0 / float((w**2).sum()) < self.least:
            return w
        t = near.gaps[:, 0]
        first, second = float((w * t).sum()), float((w * t * t).sum()) + self.ridge
        equivalent = w * (second - first * t)
        return np.asarray(equivalent / equivalent.sum())


@dataclass(frozen=True, slots=True)
class GaussianProcess:
    """Kriging with an unknown mean: weights of a Gaussian process on every pixel at once.

    Pixels, or their principal components, that share one covariance share one set of weights, so
    a process on PCA coefficients with common parameters is this, without the truncation::

        l = K^-1 k + K^-1 1 (1 - 1'K^-1 k) / (1'K^-1 1),   K = exp(-d_ij^2 / 2 L^2) + noise / q

    Parameters
    ----------
    length : float
        L, in bandwidths.
    noise : float
        Variance of a sample of vote 1, over that of the field.
    most : int
        Nearest neighbours that are used: the cost grows with their cube.
    """

    length: float = 4.0
    noise: float = 0.05
    most: int = 128
    transport: bool = False
    reach: float = 12.0
    physical: bool = False

    def weights(self, near: Neighbours) -> NDArray[np.float64]:
        """Weights of sum 1; some may be negative."""
        squared = near.squared
        chosen = np.argsort(squared, kind="stable")[: self.most]
        gaps = near.gaps[chosen]
        cross = gaps @ gaps.T
        norms = np.diag(cross)
        apart = np.maximum(norms[:, None] + norms[None, :] - 2 * cross, 0.0)
        covariance = np.exp(-0.5 * apart / self.length**2)
        covariance[np.diag_indices_from(covariance)] += self.noise / np.maximum(near.votes[chosen], 1e-3)
        sides = np.stack([np.exp(-0.5 * squared[chosen] / self.length**2), np.ones(chosen.size)], axis=1)
        solved = np.linalg.solve(covariance, sides)
        local = solved[:, 0] + solved[:, 1] * (1.0 - solved[:, 0].sum()) / solved[:, 1].sum()
        weights = np.zeros(squared.size)
        weights[chosen] = local
        return weights


COMPARED: Final[dict[str, Callable[..., Smoother]]] = {
    "nearest": NearestNeighbours,
    "abramson": Abramson,
    "local-linear": LocalLinear,
    "gaussian-process": GaussianProcess,
    "transport": lambda **params: NadarayaWatson(transport=True, **params),
    "transport-nearest": lambda **params: NearestNeighbours(transport=True, **params),
    "transport-local-linear": lambda **params: LocalLinear(transport=True, **params),
    "transport-gaussian-process": lambda **params: GaussianProcess(transport=True, **params),
}
"""By the names of docs/lab/lens-model.md."""


def make_known() -> None:
    """Register them, once in a process: models of this process can then be fitted with them."""
    for name, factory in COMPARED.items():
        if name not in smoothers:
            smoothers.register(name, factory)
