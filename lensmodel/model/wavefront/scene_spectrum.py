"""What is known of a scene's own spectrum, so that the rest of a photographed one is the lens's.

In the bins of a patch, with L = ln(f / 0.1) and the angle t of the frequency, a scene's log power is

    s(f, t) = a + z1 L + z2 L^2 + z3 cos 2t + z4 sin 2t + z5 cos 4t + z6 sin 4t + z7 L cos 2t + z8 L sin 2t
                + z9 cos 6t + z10 sin 6t + z11 cos 8t + z12 sin 8t + z13 L cos 4t + z14 L sin 4t

with normal priors on z: natural images fall off with about the square of the frequency (D. J. Field,
JOSA A 4, 1987), what people build has few directions, each of them a narrow ridge. Red and blue differ a
little from green; all patches of one photo share a part of their slope and curvature, since one motif and
one focus are theirs. What is seen is

    ln(exp(s + b + d |OTF|^4) (|OTF|^2 + exp(w)) + n)

with the power n of the noise, and a roughness that the polynomial does not follow, which is the same in
all channels. What the polynomial misses on average is b. It hangs on the angle to the sensor's axes: bins
of few frequencies hold others than their middles say, what people build has more edges along the axes, and
a mosaic is interpolated. What `Transfer` misses behind sharp lenses is d: it leaves out aliases beyond 0.75
cycles/pixel. Without b and d, sharp lenses came out half as wide again as they are. The floor exp(w) is the
patch's own: the blur changes within it, so that no zero of the OTF is seen as one. The same floor for all
patches makes lenses of even blur likelier than the true ones.

The numbers lie in `data/scene_spectrum.json`, with the command that measures them beside it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.spectrum import SECTORS, PatchSpectrum
from lensmodel.core.types import Channel
from lensmodel.optics.transfer import BINS, BORROWED_RINGS, FIRST_RING, bin_frequencies

Floats = NDArray[np.float64]

_MODULUS, _ANGLE = bin_frequencies()
_L = np.log(_MODULUS / 0.1)  # L of the docstring

SHAPES: Final = np.stack(
    [
        *(np.ones(BINS), _L, _L**2, np.cos(2 * _ANGLE), np.sin(2 * _ANGLE)),
        *(np.cos(4 * _ANGLE), np.sin(4 * _ANGLE), _L * np.cos(2 * _ANGLE), _L * np.sin(2 * _ANGLE)),
        *(np.cos(6 * _ANGLE), np.sin(6 * _ANGLE), np.cos(8 * _ANGLE), np.sin(8 * _ANGLE)),
        *(_L * np.cos(4 * _ANGLE), _L * np.sin(4 * _ANGLE)),
    ],
    axis=1,
)
"""Values of the polynomial's terms in the bins, shape (BINS, 15)."""

_FITTED = json.loads((Path(__file__).parent / "data" / "scene_spectrum.json").read_text(encoding="utf-8"))
"""What was fitted to photographs behind known lenses; `data/README.md` says what each entry is."""

_USUAL, _SPREAD = _FITTED["usual"], _FITTED["spread"]
_AMPLITUDE, _CHANNEL_SPREAD, _FLOOR = (_FITTED[name] for name in ("amplitude", "channel_spread", "floor"))

PHOTO_SPREAD: Final = np.array(_FITTED["photo_spread"])
"""Standard deviations of what all patches of a photo share: slope and curvature."""

_ROUGHNESS, _OWN, _NOISY = (_FITTED[name] for name in ("roughness", "own_scatter", "noisy_scatter"))
_BORROWED = _FITTED["borrowed"] + [1e3] * BORROWED_RINGS  # rings that only green tells of have no say
_NOISE_GREEN, _NOISE_OTHER = _FITTED["noise_green"], _FITTED["noise_other"]
_SMALLEST = 1e-15  # power of a bin: keeps its logarithm finite, far below any noise


def _rings(values: list[float]) -> Floats:
    return np.repeat(np.asarray(values, dtype=np.float64), SECTORS)


ORBITS: Final = np.array((0, 2, 1, 1, 2, 0) * 2)
"""Which sectors are alike on a square lattice, shape (SECTORS,): at its axes 0, diagonals 1, between 2."""


def _angles(values: list[list[float]]) -> Floats:
    return np.asarray(values, dtype=np.float64)[:, ORBITS].ravel()


BIAS: Final = _rings(_FITTED["bias"]) + _angles(_FITTED["pattern"])
"""Mean of the log power about the polynomial and ln |OTF|^2, shape (BINS,)."""

WITH_POWER: Final = _angles(_FITTED["with_power"])
"""What is seen beyond that behind `Transfer`, per |OTF|^4, shape (BINS,)."""


@dataclass(frozen=True, slots=True, eq=False)
class SceneView:
    """The spectra of one patch in its channels, ready to be fitted.

    Parameters
    ----------
    channels : tuple of Channel
    log_power : ndarray, shape (BINS, c)
        Of what was seen, noise included.
    noise : ndarray, shape (BINS, c)
        Power of the noise.
    precision : ndarray, shape (BINS, c, c)
        Inverse covariance of the log powers of a bin about the model.
    shapes : ndarray, shape (BINS, c, z)
        Derivatives of the scene's log power by the patch's own unknowns; 0 by the last, the logarithm w of
        the floor, which is no part of the scene.
    usual, vote : ndarray, shape (z,)
        Their prior means and inverse variances.
    """

    channels: tuple[Channel, ...]
    log_power: Floats
    noise: Floats
    precision: Floats
    shapes: Floats
    usual: Floats
    vote: Floats

    @classmethod
    def of(cls, spectra: dict[Channel, PatchSpectrum]) -> SceneView:
        """Take the spectra of a patch."""
        channels = tuple(spectra)
        count = len(channels)
        power = np.stack([s.power[FIRST_RING:].astype(np.float64).ravel() for s in spectra.values()], 1)
        power = np.maximum(power, _SMALLEST)
        noise = np.stack(
            [s.noise * _rings(_NOISE_GREEN if c == "g" else _NOISE_OTHER) for c, s in spectra.items()],
            axis=1,
        )
        seen = np.clip(1.0 - _of_ring(noise) / _of_ring(power), 0.0, 1.0)
        covariance = (_rings(_ROUGHNESS) ** 2)[:, None, None] * seen[:, :, None] * seen[:, None, :]
        for k, channel in enumerate(channels):
            covariance[:, k, k] += _OWN**2 + (_NOISY * (1.0 - seen[:, k])) ** 2
            if channel != "g":
                covariance[:, k, k] += _rings(_BORROWED) ** 2
        own = SHAPES[:, :3]
        shapes = np.zeros((BINS, count, SHAPES.shape[1] + 3 * count + 1))
        shapes[:, :, : SHAPES.shape[1]] = SHAPES[:, None, :]
        for k in range(count):
            at = SHAPES.shape[1] + 3 * k
            shapes[:, k, at : at + 3] = own
        usual = np.concatenate([_USUAL, np.tile([_AMPLITUDE[0], 0.0, 0.0], count), _FLOOR[:1]])
        spread = np.concatenate([_SPREAD, np.tile([_AMPLITUDE[1], *_CHANNEL_SPREAD], count), _FLOOR[1:]])
        return cls(
            channels,
            np.log(power),
            noise,
            np.asarray(np.linalg.inv(covariance), dtype=np.float64),
            shapes,
            usual,
            1.0 / spread**2,
        )

    def with_floor(self, usual: float, spread: float) -> SceneView:
        """Return the same with another prior of the floor's logarithm."""
        means, vote = self.usual.copy(), self.vote.copy()
        means[-1], vote[-1] = usual, spread**-2
        return replace(self, usual=means, vote=vote)


def _of_ring(values: Floats) -> Floats:
    """Mean of each ring in all its bins."""
    rings = values.reshape(-1, SECTORS, values.shape[1]).mean(axis=1)
    return np.repeat(rings, SECTORS, axis=0)
