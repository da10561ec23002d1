"""What is thought of the PSF at one place: its mean, and how far the true one may lie from that.

A kernel that is known only roughly is not to be undone as if it were exact. With H the transfer function of
the true kernel, a random quantity to whoever does not know it, the linear filter of least expected error
needs its mean and its variance at each frequency::

    G = E[H]* S / ( |E[H]|² S + Var[H] S + n )

Mixing a point into the mean kernel comes close to that with a kernel that any method can use
(`lensmodel.correction.expected_gain.plan` chooses the share).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, delta, otf
from lensmodel.core.types import Channel, FieldPosition, Kernel

GRID: Final = (64, 64)
"""Shape of the grid whose `rfft2` frequencies variances are given on."""
WIDEST: Final = 63
"""Largest side of a kernel that the grid holds."""
_LEAST: Final = 1e-30  # keeps divisions finite, far below any power


@dataclass(frozen=True, slots=True)
class Narrowing:
    """A kernel changed to `width` times its width, of which `share` stays and the rest becomes a point."""

    width: float = 1.0
    share: float = 1.0

    def of(self, kernel: Kernel) -> Kernel:
        """Return the kernel so changed."""
        changed = kernel if self.width == 1.0 else narrowed(kernel, self.width)
        if self.share == 1.0:
            return changed
        return as_kernel(self.share * changed + (1.0 - self.share) * delta(kernel.shape[0]))


@dataclass(frozen=True, slots=True, eq=False)
class Belief:
    """Mean and uncertainty of a PSF.

    Parameters
    ----------
    kernel : Kernel, shape (k, k)
        The mean.
    variance : ndarray, shape (64, 33)
        Expected |H - E[H]|² at the `rfft2` frequencies of `GRID`.
    error : float
        Expected relative L2 distance of the true kernel from the mean.
    """

    kernel: Kernel
    variance: NDArray[np.float32]
    error: float

    @classmethod
    def of_error(cls, kernel: Kernel, error: float) -> Belief:
        """A kernel of which only the relative L2 error e is known: most likely its width is wrong.

        Var[H] = e² |H|² ln²|H| sum |H|² / sum |H|² ln²|H|, as an error of the width makes.
        """
        if not (math.isfinite(error) and error >= 0.0):
            raise InvalidInputError(f"psf_error must be finite and not negative, got {error}")
        if error == 0.0 or kernel.shape[0] > WIDEST:
            return cls(kernel, np.zeros((GRID[0], GRID[1] // 2 + 1), dtype=np.float32), error)
        H = otf(kernel, GRID)
        power = np.maximum(H.real**2 + H.imag**2, _LEAST)
        shape = power * np.log(power) ** 2
        times = _times()
        scale = error**2 * float((times * power).sum()) / max(float((times * shape).sum()), _LEAST)
        return cls(kernel, (scale * shape).astype(np.float32), error)

    @classmethod
    def mixture(
        cls, kernels: Sequence[Kernel], narrowings: Sequence[Narrowing], shares: NDArray[np.float64]
    ) -> Belief:
        """Several kernels, each changed in several ways, of which one is thought to be true.

        Parameters
        ----------
        kernels : sequence of Kernel, all of shape (k, k)
            k at most 63.
        narrowings : sequence of Narrowing
        shares : ndarray, shape (len(kernels), len(narrowings))
            Probabilities of sum 1.
        """
        side = kernels[0].shape[0]
        if side > WIDEST:
            raise InvalidInputError(f"kernels of a belief have at most {WIDEST} pixels a side, got {side}")
        average, power = np.zeros((side, side)), np.zeros((GRID[0], GRID[1] // 2 + 1))
        for kernel, own in zip(kernels, shares, strict=True):
            for narrowing, share in zip(narrowings, own, strict=True):
                if share > 0.0:
                    changed = narrowing.of(kernel)
                    H = otf(changed, GRID)
                    average += share * changed
                    power += share * (H.real**2 + H.imag**2)
        mean = as_kernel(average)
        H = otf(mean, GRID)
        squared = H.real**2 + H.imag**2
        variance = np.maximum(power - squared, 0.0)
        times = _times()
        error = math.sqrt(float((times * variance).sum()) / max(float((times * squared).sum()), _LEAST))
        return cls(mean, variance.astype(np.float32), error)

    def widened(self, factor: float) -> Belief:
        """Return it with `factor` times the variance."""
        scaled = (np.float32(factor) * self.variance).astype(np.float32)
        return Belief(self.kernel, scaled, math.sqrt(factor) * self.error)


@runtime_checkable
class UncertainField(Protocol):
    """The PSF of every place and channel, and how sure it is."""

    def kernel_at(self, position: FieldPosition, channel: Channel, size: int) -> Kernel:
        """Return the mean kernel of odd side `size`."""

    def belief_at(self, position: FieldPosition, channel: Channel, size: int) -> Belief:
        """Return what is thought of the PSF there."""


def narrowed(kernel: Kernel, width: float) -> Kernel:
    """Kernel at `width` times its width: each pixel's light moves towards the centre as a smaller square.

    No light becomes negative or leaves its place for another, as it would by interpolation with a sinc, whose
    tails a deconvolution turns into a net of dots.
    """
    along = _overlaps(kernel.shape[0], width)
    return as_kernel(along @ kernel @ along.T)


@lru_cache(maxsize=32)
def _overlaps(side: int, width: float) -> NDArray[np.float64]:
    """How much of the square of each pixel, `width` as wide, falls into each pixel, along one axis."""
    t = np.arange(side) - side // 2
    low, high = width * (t - 0.5), width * (t + 0.5)
    inside = np.minimum(high, t[:, None] + 0.5) - np.maximum(low, t[:, None] - 0.5)
    return np.maximum(inside, 0.0) / width


@lru_cache(maxsize=1)
def _times() -> NDArray[np.float64]:
    """How often each column of the half spectrum stands in the whole."""
    times = np.full((GRID[0], GRID[1] // 2 + 1), 2.0)
    times[:, [0, -1]] = 1.0
    times.setflags(write=False)
    return times
