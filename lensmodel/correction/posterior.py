"""Posterior of the PSF at one place: its mean, and how far the true one may lie from that.

A kernel that is known only roughly is not to be undone as if it were exact. With H the true transfer
function, random to whoever does not know it, the linear filter of least expected error needs its mean and its
variance at each frequency::

    G = E[H]* S / ( |E[H]|² S + Var[H] S + n )

Mixing a point into the mean kernel comes close to that with a kernel that any method can use
(`lensmodel.correction.expected_gain.plan` chooses the share).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Final, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import otf
from lensmodel.core.types import Channel, FieldPosition, Kernel

GRID: Final = (64, 64)  # pixels: variances are given at its `rfft2` frequencies
WIDEST: Final = 63  # pixels: side of the largest kernel that the grid holds
_LEAST: Final = 1e-30  # keeps divisions finite, far below any power


@dataclass(frozen=True, slots=True, eq=False)
class PsfPosterior:
    """Mean and uncertainty of a PSF."""

    kernel: Kernel  # (k, k), the mean
    variance: NDArray[np.float32]  # (64, 33), expected |H - E[H]|² at the `rfft2` frequencies of `GRID`
    error: float  # expected relative L2 distance of the true kernel from the mean
    width_error: float  # w, expected relative error of ln |H|, which grows as the squared width

    @classmethod
    def of_error(cls, kernel: Kernel, error: float, rings: NDArray[np.float64] | None = None) -> PsfPosterior:
        """A kernel of which the relative L2 error e is known: most likely its width is wrong.

        Var[H] = w² |H|² ln²|H|,  w² = e² sum |H|² / sum |H|² ln²|H|, as an error w of ln |H| makes. It is no
        more than the square of the error that is expected at a frequency, where its r.m.s. in eight `rings`
        up to .5 cycles/pixel is known; below the middle of the first it falls as |f|².
        """
        if not (math.isfinite(error) and error >= 0.0):
            raise InvalidInputError(f"psf_error must be finite and not negative, got {error}")
        if error == 0.0 or kernel.shape[0] > WIDEST:
            return cls(kernel, np.zeros((GRID[0], GRID[1] // 2 + 1), dtype=np.float32), error, 0.0)
        H = otf(kernel, GRID)
        power = np.maximum(H.real**2 + H.imag**2, _LEAST)
        shape = power * (0.5 * np.log(power)) ** 2
        times = np.full(power.shape, 2.0)  # how often each column of the half spectrum stands in the whole
        times[:, [0, -1]] = 1.0
        scale = error**2 * float((times * power).sum()) / max(float((times * shape).sum()), _LEAST)
        variance = scale * shape
        if rings is not None:
            f = np.hypot(fft.fftfreq(GRID[0])[:, None], fft.rfftfreq(GRID[1]))
            middles = (np.arange(len(rings)) + 0.5) / (2 * len(rings))
            known = np.interp(f, middles, rings) * np.minimum(f / middles[0], 1.0) ** 2
            variance = np.minimum(variance, known**2)
        return cls(kernel, variance.astype(np.float32), error, math.sqrt(scale))


@runtime_checkable
class PosteriorField(Protocol):
    """A posterior of the PSF for every place and channel."""

    def posterior_at(self, position: FieldPosition, channel: Channel) -> PsfPosterior:
        """Return what is known of the PSF at a field position, its kernel cut to its support."""
