"""Ways to weigh neighbouring samples, by name. Each answer is a linear combination of kernels.

Every method here returns weights of sum 1 over the neighbours of a question; the kernel is the
weighted sum of theirs, whatever the method. So they share one fast path, one cross-validation and
one measure of what stands behind an answer.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.registry import Registry


@dataclass(frozen=True, slots=True, eq=False)
class Neighbours:
    """The samples near a question.

    Parameters
    ----------
    gaps : ndarray, shape (m, 7)
        Differences sample - question in bandwidths; 0 where unknown.
    votes : ndarray, shape (m,)
        Confidence of each sample, robustness included.
    """

    gaps: NDArray[np.float64]
    votes: NDArray[np.float64]

    @property
    def squared(self) -> NDArray[np.float64]:
        """Squared distances in bandwidths."""
        return np.asarray((self.gaps**2).sum(axis=1))


class Smoother(Protocol):
    """Weights of neighbours."""

    @property
    def transport(self) -> bool:
        """Whether kernels are scaled to the width predicted at the question."""

    @property
    def reach(self) -> float:
        """Distance in bandwidths beyond which samples are left out."""

    def weights(self, near: Neighbours) -> NDArray[np.float64]:
        """Weights of sum 1, shape (m,)."""


def gaussian_weights(squared: NDArray[np.float64], votes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Votes times exp(-d^2 / 2) of squared distances in bandwidths, sum 1, shape (m,)."""
    # relative to the nearest: far from all data the nearest still speak
    weight = votes * np.exp(-0.5 * (squared - squared.min()))
    total = weight.sum()
    if total > 0:
        return np.asarray(weight / total)
    alone = np.exp(-0.5 * (squared - squared.min()))
    return np.asarray(alone / alone.sum())


@dataclass(frozen=True, slots=True)
class NadarayaWatson:
    """Gaussian weights of fixed bandwidth, w_i ~ q_i exp(-d_i^2 / 2) (paper, eq. 4 and 7)."""

    transport: bool = False
    reach: float = 5.0

    def weights(self, near: Neighbours) -> NDArray[np.float64]:
        """Weights of sum 1."""
        return gaussian_weights(near.squared, near.votes)


smoothers: Registry[Smoother] = Registry(
    "regression",
    {
        "combined": lambda **params: NadarayaWatson(transport=True, **params),
        "nadaraya-watson": NadarayaWatson,
    },
)
"""Methods of regression by name, the usual one and the paper's; `register` adds others."""
