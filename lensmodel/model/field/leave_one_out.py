"""Leave one photo out: how wrong a model of the other photos is, and which bandwidths are best.

Every answer is a linear combination f_i = sum_j w_ij C_j, so the squared error of all held-out
samples follows from the Gram matrix G = C C' alone::

    |C_i - f_i|^2 = G_ii - 2 (W G)_ii + (W G W')_ii

Trying another bandwidth costs products of n x n matrices and touches no kernel. Samples of one
photo share its shake, focus and noise: leaving out single samples would be optimistic. With a
single photo there is no other choice, and each sample is its own group.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError

MULTIPLES = (0.35, 0.5, 0.7, 1.0, 1.4, 2.0, 2.8)
"""Of the bandwidth by the normal reference rule: in steps of a root of two, up to which errors hardly differ
(chosen)."""
PHI_MULTIPLES = (0.5, 0.7, 1.0, 1.4, 2.0, 4.0, 20.0)
"""The same around the centre; 20 means rotational symmetry, and 4 is halfway to it (chosen)."""
MIRRORS = (0.0, 0.3, 1.0)  # weights of mirror images: none, some, full (chosen)
_CAP = 1.5  # relative errors beyond count no more than this: one outlier chooses nothing (chosen)
_AS_GOOD, _NEGLIGIBLE = 1.01, 1e-3  # errors nearer than this are equal: their difference is noise (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class HeldOut:
    """Samples prepared for cross-validation.

    Parameters
    ----------
    gram, mirrored : ndarray, shape (n, n)
        Products <C_i, C_j> and <C_i, M C_j>, M the reflection v -> -v.
    place, turn, others : ndarray, shape (n, n)
        Squared distances in r, in phi and in the settings, in bandwidths.
    votes : ndarray, shape (n,)
    groups : ndarray of int, shape (n,)
        Samples that are held out together.
    """

    gram: NDArray[np.float64]
    mirrored: NDArray[np.float64]
    place: NDArray[np.float64]
    turn: NDArray[np.float64]
    others: NDArray[np.float64]
    votes: NDArray[np.float64]
    groups: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        rows: NDArray[np.floating],
        side: int,
        where: NDArray[np.float64],
        scale: NDArray[np.float64],
        votes: NDArray[np.float64],
        groups: NDArray[np.intp],
    ) -> HeldOut:
        """Prepare kernels given as flat rows of a square grid, at points `where` (n, 7)."""
        rows = np.asarray(rows, dtype=np.float64)  # errors are small differences of these products
        flipped = rows.reshape(-1, side, side)[:, ::-1].reshape(len(rows), -1)
        gap = np.nan_to_num((where[:, None, :] - where[None, :, :]) / scale, nan=0.0) ** 2
        return cls(
            gram=rows @ rows.T,
            mirrored=rows @ flipped.T,
            place=gap[..., 0],
            turn=gap[..., 1] + gap[..., 2],
            others=gap[..., 3:].sum(axis=-1),
            votes=votes,
            groups=groups,
        )

    def errors(self, r: float = 1.0, phi: float = 1.0, mirror: float = 0.0) -> NDArray[np.float64]:
        """Relative L2 of each sample against the model of the other groups.

        Parameters
        ----------
        r, phi : float
            Factors on the bandwidths.
        mirror : float
            Weight of the mirrored samples, 0..1.
        """
        return self.errors_of(self.weights(r, phi), mirror)

    def weights(self, r: float = 1.0, phi: float = 1.0) -> NDArray[np.float64]:
        """Held-out Nadaraya-Watson weights, rows of sum 1."""
        squared = self.place / r**2 + self.turn / phi**2 + self.others
        squared = np.where(self.groups[:, None] == self.groups[None, :], np.inf, squared)
        nearest = squared.min(axis=1, keepdims=True)
        weight = self.votes * np.exp(-0.5 * (squared - np.where(np.isfinite(nearest), nearest, 0.0)))
        total = weight.sum(axis=1, keepdims=True)
        return np.asarray(weight / np.where(total > 0, total, 1.0))

    def errors_of(self, weight: NDArray[np.float64], mirror: float = 0.0) -> NDArray[np.float64]:
        """Relative L2 of each sample against its weighted mean of others."""
        own = np.diag(self.gram)
        direct, across = weight @ self.gram, weight @ self.mirrored
        whole = 1.0 + mirror
        linear = np.diag(direct + mirror * across) / whole
        square = ((1 + mirror**2) * direct + 2 * mirror * across) / whole**2
        squared = own - 2 * linear + np.einsum("ij,ij->i", square, weight)
        relative = np.sqrt(np.maximum(squared, 0.0) / np.maximum(own, 1e-30))
        return np.where(weight.sum(axis=1) > 0, relative, 1.0)

    def noise(self, weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Squared relative scatter of each sample's others about their weighted mean.

        From the weights of `weights`: sum_j w_j |C_j - f|^2 / (1 - sum_j w_j^2), over the sample's |C_i|^2.
        """
        own = np.diag(self.gram)
        spread = weight @ own - np.einsum("ij,ij->i", weight @ self.gram, weight)
        free = np.maximum(1.0 - (weight**2).sum(axis=1), 0.1)
        return np.asarray(np.maximum(spread, 0.0) / free / np.maximum(own, 1e-30))

    def score(self, errors: NDArray[np.float64]) -> float:
        """Mean error by vote; gross errors count at most 1.5."""
        return float(np.average(np.minimum(errors, _CAP), weights=np.maximum(self.votes, 1e-9)))


@dataclass(frozen=True, slots=True)
class Choice:
    """What cross-validation chose: factors on the bandwidths, weight of the mirrored samples."""

    r: float = 1.0
    phi: float = 1.0
    mirror: float = 0.0
    error: float = 1.0

    def __post_init__(self) -> None:
        if not (0.0 < self.r < np.inf and 0.0 < self.phi < np.inf and 0.0 <= self.mirror <= 1.0):
            raise InvalidInputError(
                f"factors on bandwidths must be positive and a mirror lie in 0..1, got {self}"
            )
        if not 0.0 <= self.error < np.inf:
            raise InvalidInputError(f"a held-out error must be finite and not negative, got {self.error}")


def choose_factors(held: HeldOut, *, r: bool = True, phi: bool = True, mirror: bool = True) -> Choice:
    """Search the factors, each only where it is free, for the least held-out error."""

    def best(options: tuple[float, ...], make: Callable[[float], Choice]) -> Choice:
        # the least reach among those that are as good: far neighbours cost time and trust in a symmetry
        tried = [make(option) for option in options]
        least = min(choice.error for choice in tried)
        return next(choice for choice in tried if choice.error <= least * _AS_GOOD + _NEGLIGIBLE)

    def at(r_: float, phi_: float, mirror_: float) -> Choice:
        return Choice(r_, phi_, mirror_, held.score(held.errors(r_, phi_, mirror_)))

    chosen = at(1.0, 1.0, 0.0)
    for _ in range(2):
        now = chosen
        if r:
            now = best(MULTIPLES, lambda x, c=now: at(x, c.phi, c.mirror))  # type: ignore[misc] # mypy infers no default
        if phi:
            now = best(PHI_MULTIPLES, lambda x, c=now: at(c.r, x, c.mirror))  # type: ignore[misc] # same
        if mirror:
            now = best(MIRRORS, lambda x, c=now: at(c.r, c.phi, x))  # type: ignore[misc] # same
        if (now.r, now.phi, now.mirror) == (chosen.r, chosen.phi, chosen.mirror):
            break
        chosen = now
    return chosen
