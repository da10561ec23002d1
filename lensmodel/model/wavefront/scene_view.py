"""The spectra of one patch beside what is known of scenes, ready for a fit of the lens.

What is seen of a scene of log power s (`scene.prior`, whose bias b is apart here) is

    ln(exp(s + b + d |OTF|^4) (|OTF|^2 + exp(w)) + n)

with the power n of the noise. What the polynomial misses on average is b. It hangs on the angle to the
sensor's axes: bins of few frequencies hold others than their middles say, what people build has more edges
along the axes, and a mosaic is interpolated. What `Transfer` misses behind sharp lenses is d: it leaves out
aliases beyond 0.75 cycles/pixel. Without b and d, sharp lenses came out half as wide again as they are. The
floor exp(w) is the patch's own: the blur changes within it, so that no zero of the OTF is seen as one. The
same floor for all patches makes lenses of even blur likelier than the true ones.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.spectrum import SECTORS, PatchSpectrum
from lensmodel.core.types import Channel
from lensmodel.optics.transfer import BINS, FIRST_RING
from lensmodel.scene.prior import CHANNEL_SCATTER, LEAST_POWER, NOISE_SCATTER, PATCH_SHAPES, PATCHES

Floats = NDArray[np.float64]


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
        power = np.maximum(power, LEAST_POWER)
        noise = np.stack(
            [
                s.noise * (PATCHES.noise_green if c == "g" else PATCHES.noise_other)
                for c, s in spectra.items()
            ],
            axis=1,
        )
        seen = np.clip(1.0 - _of_ring(noise) / _of_ring(power), 0.0, 1.0)
        covariance = (PATCHES.roughness**2)[:, None, None] * seen[:, :, None] * seen[:, None, :]
        for k, channel in enumerate(channels):
            covariance[:, k, k] += CHANNEL_SCATTER**2 + (NOISE_SCATTER * (1.0 - seen[:, k])) ** 2
            if channel != "g":
                covariance[:, k, k] += PATCHES.borrowed**2
        terms = PATCH_SHAPES.shape[1]
        own = PATCH_SHAPES[:, :3]
        shapes = np.zeros((BINS, count, terms + 3 * count + 1))
        shapes[:, :, :terms] = PATCH_SHAPES[:, None, :]
        for k in range(count):
            at = terms + 3 * k
            shapes[:, k, at : at + 3] = own
        amplitude, floor = PATCHES.amplitude, PATCHES.floor
        usual = np.concatenate([PATCHES.usual, np.tile([amplitude[0], 0.0, 0.0], count), floor[:1]])
        by_channel = np.tile([amplitude[1], *PATCHES.channel_spread], count)
        spread = np.concatenate([PATCHES.spread, by_channel, floor[1:]])
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
