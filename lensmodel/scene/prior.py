"""What is known of a scene's power spectrum before it is seen: one polynomial, two statistics of it.

In the bins of a spectrum, with L = ln(f / 0.1) and the angle t of the frequency, a scene's log power is

    s(f, t) = a + z1 L + z2 L^2 + z3 cos 2t + z4 sin 2t + z5 cos 4t + z6 sin 4t + z7 L cos 2t + z8 L sin 2t
                + z9 cos 6t + z10 sin 6t + z11 cos 8t + z12 sin 8t + z13 L cos 4t + z14 L sin 4t + b

with a roughness that the polynomial does not follow. Natural images fall off with about the square of the
frequency (D. J. Field, JOSA A 4, 1987), what people build has few directions, each of them a narrow ridge.
Both steps that look for blur in spectra read this, each its own statistic:

* `WINDOWS`, for a kernel estimated from patches (`estimation.spectra`): how sharp windows of photographs
  differ from each other. The coefficients up to z8 are never solved for: their covariance is part of that of
  the residuals. The amplitude is free. One window says little, since a steep scene looks like a blurred one;
  from window to window the scene changes and the blur stays.
* `PATCHES`, for a lens fitted to all its photos (`model.wavefront.from_spectra`): how developed patches
  spread behind lenses that are known. All coefficients are unknowns of each patch with priors of their own;
  red and blue differ a little from green; all patches of one photo share a part of slope and curvature,
  since one motif and one focus are theirs. The mosaic has its part in b, by the angle to the sensor's axes,
  and in the noise.

They are no two opinions about one number: a window is part of a finished photograph, one colour and nothing
around it; a patch was chosen in a developed mosaic, with its share of noise, three colours and its photo.
What is the same is here once: bins, polynomial, the scatter of noise, and when a residual is an outlier.

The numbers lie in `data/fitted.json`, with the commands that measure them in the README beside it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.files import fitted
from lensmodel.core.spectrum import RINGS, SECTORS, bin_frequencies

Floats = NDArray[np.float64]

FIRST_WINDOW_RING: Final = 2
"""Rings of a window's spectrum below hold too few frequencies of a 64 px tile."""

WINDOW_BINS: Final = (RINGS - FIRST_WINDOW_RING) * SECTORS
"""Bins of a window that count; one ring more than of a patch, whose angles count too."""

BORROWED_RINGS: Final = 3
"""Outermost rings of a patch that say nothing of red and blue: demosaicing takes them from green."""

LEAST_POWER: Final = 1e-15
"""Power of a bin: keeps its logarithm finite, far below any noise."""

LARGEST_RESIDUAL: Final = 3.0
"""Of a natural logarithm: beyond it no fit is linear (chosen)."""

TAILS: Final = 6.0
"""Degrees of freedom of Student's t of a bin: scenes have stripes that no polynomial follows (chosen)."""

_WINDOW_TERMS = 9  # of the polynomial: few windows do not tell more of themselves (chosen)
_NO_SAY = 1e3  # scatter of a bin that takes no part, natural logarithms: far beyond any


def polynomial(modulus: Floats, angle: Floats) -> Floats:
    """Values of the polynomial's terms.

    Parameters
    ----------
    modulus, angle : ndarray of float64, shape (n,)
        Frequencies, cycles/pixel and radians; see `core.spectrum.bin_frequencies`.

    Returns
    -------
    ndarray of float64, shape (n, 15)
        1 and the factors of z1 to z14.
    """
    L = np.log(modulus / 0.1)
    return np.stack(
        [
            *(np.ones(len(L)), L, L**2, np.cos(2 * angle), np.sin(2 * angle)),
            *(np.cos(4 * angle), np.sin(4 * angle), L * np.cos(2 * angle), L * np.sin(2 * angle)),
            *(np.cos(6 * angle), np.sin(6 * angle), np.cos(8 * angle), np.sin(8 * angle)),
            *(L * np.cos(4 * angle), L * np.sin(4 * angle)),
        ],
        axis=1,
    )


WINDOW_SHAPES: Final = np.ascontiguousarray(
    polynomial(*bin_frequencies(FIRST_WINDOW_RING))[:, :_WINDOW_TERMS]
)
"""Values of the first terms in the bins of a window, shape (WINDOW_BINS, 9)."""

PATCH_SHAPES: Final = polynomial(*bin_frequencies())
"""Values of all terms in the bins of a patch, shape (BINS, 15)."""

ORBITS: Final = np.array((0, 2, 1, 1, 2, 0) * 2)
"""Which sectors are alike on a square lattice, shape (SECTORS,): at its axes 0, diagonals 1, between 2."""


@dataclass(frozen=True, slots=True, eq=False)
class WindowPrior:
    """How sharp windows spread; natural logarithms of power.

    Parameters
    ----------
    usual : ndarray, shape (WINDOW_BINS,)
        Of a usual scene, but for its amplitude.
    spread : ndarray, shape (9, 9)
        Covariance of the coefficients; no bound on the amplitude, whose row and column are zero.
    roughness : ndarray, shape (WINDOW_BINS,)
        Standard deviation of what the polynomial leaves.
    """

    usual: Floats
    spread: Floats
    roughness: Floats

    @classmethod
    @lru_cache(maxsize=1)
    def load(cls) -> WindowPrior:
        """Read what `lensmodel.lab.training.make_scene_spectra` printed."""
        return cls.of({name: np.array(values) for name, values in _NUMBERS["window"].items()})

    @classmethod
    def of(cls, measured: Mapping[str, Floats]) -> WindowPrior:
        """Make one of what was measured.

        Parameters
        ----------
        measured : mapping of str to ndarray of float64
            `usual`, (9,), medians of the coefficients; `spread`, (9, 9), their covariance; `bias` and
            `roughness`, (12,), of the rings.
        """
        usual = WINDOW_SHAPES[:, 1:] @ measured["usual"][1:] + by_ring(measured["bias"])
        return cls(usual, measured["spread"], by_ring(measured["roughness"]))


@dataclass(frozen=True, slots=True, eq=False)
class PatchPrior:
    """How developed patches spread behind lenses that are known; natural logarithms of power.

    Parameters
    ----------
    usual, spread : ndarray, shape (15,)
        Means and standard deviations of the polynomial's coefficients.
    amplitude, floor : tuple of float
        Mean and standard deviation of each channel's amplitude, and of what fills the zeros of |OTF|^2.
    channel_spread, photo_spread : ndarray, shape (2,)
        Of slope and curvature: of a channel about those of its patch, and what a photo's patches share.
    bias : ndarray, shape (BINS,)
        Mean about the polynomial and ln |OTF|^2.
    with_power : ndarray, shape (BINS,)
        What is seen beyond that behind `Transfer`, per |OTF|^4.
    roughness : ndarray, shape (BINS,)
        Standard deviation of what the polynomial leaves, the same in all channels.
    borrowed : ndarray, shape (BINS,)
        Scatter of red and blue where their detail is green's.
    noise_green, noise_other : ndarray, shape (BINS,)
        Share of the white noise that demosaicing leaves.
    """

    usual: Floats
    spread: Floats
    amplitude: tuple[float, float]
    floor: tuple[float, float]
    channel_spread: Floats
    photo_spread: Floats
    bias: Floats
    with_power: Floats
    roughness: Floats
    borrowed: Floats
    noise_green: Floats
    noise_other: Floats

    @classmethod
    def of(cls, numbers: Mapping[str, Any]) -> PatchPrior:
        """Take the entries of `patch` in `data/fitted.json`."""
        return cls(
            usual=np.array(numbers["usual"]),
            spread=np.array(numbers["spread"]),
            amplitude=(numbers["amplitude"][0], numbers["amplitude"][1]),
            floor=(numbers["floor"][0], numbers["floor"][1]),
            channel_spread=np.array(numbers["channel_spread"]),
            photo_spread=np.array(numbers["photo_spread"]),
            bias=by_ring(numbers["bias"]) + _by_angle(numbers["pattern"]),
            with_power=_by_angle(numbers["with_power"]),
            roughness=by_ring(numbers["roughness"]),
            borrowed=by_ring([*numbers["borrowed"], *[_NO_SAY] * BORROWED_RINGS]),
            noise_green=by_ring(numbers["noise_green"]),
            noise_other=by_ring(numbers["noise_other"]),
        )


def by_ring(values: Sequence[float] | Floats) -> Floats:
    """Values of rings in all their bins, shape (rings,) to (rings * SECTORS,)."""
    return np.repeat(np.asarray(values, dtype=np.float64), SECTORS)


def _by_angle(values: Sequence[Sequence[float]]) -> Floats:
    """Values of rings by the angle to the sensor's axes, shape (rings, 3), in all their bins."""
    return np.asarray(values, dtype=np.float64)[:, ORBITS].ravel()


_NUMBERS = fitted("scene")
_SCATTER: Final[Mapping[str, float]] = _NUMBERS["scatter"]

WINDOW_SCATTER: Final = _SCATTER["window"]
"""Standard deviation of a bin's log power about its mean in a window without noise."""

CHANNEL_SCATTER: Final = _SCATTER["channel"]
"""The same of one channel of a patch about what its channels share: wider, so that none outvotes another."""

NOISE_SCATTER: Final = _SCATTER["noise"]
"""The same of noise alone, in either."""

PATCHES: Final = PatchPrior.of(_NUMBERS["patch"])
"""How developed patches spread."""
