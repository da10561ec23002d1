"""What a scene's power looks like through the window of a tile."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

Floats = NDArray[np.float64]

# Exponent of a scene's power, about 2 (D. J. Field, JOSA A 4, 1987); chosen within 2.0 to 2.6
_SCENE_FALL = 2.3


@dataclass(frozen=True, slots=True, eq=False)
class Leakage:
    """The Hann window of a tile in front of the usual scene.

    The window mixes each frequency with its neighbours, weights 1/6, 2/3, 1/6 of the power along either axis
    (F. J. Harris, Proc. IEEE 66, 1978), and the lower ones count for more, since scenes fall off.

    Parameters
    ----------
    side : int
        Of the tile, pixels.
    fall : ndarray of float64, shape (side, side // 2 + 1)
        Power of the usual scene on the grid of `rfft2`.
    """

    side: int
    fall: Floats

    @classmethod
    def of(cls, side: int) -> Leakage:
        """Lay out the usual scene."""
        modulus = np.hypot(fft.fftfreq(side)[:, None], fft.rfftfreq(side))
        return cls(side, 1.0 / np.maximum(modulus, 1.0 / side) ** _SCENE_FALL)

    def seen(self, power: Floats) -> Floats:
        """Power of the usual scene, times another, as the tile shows it.

        Parameters
        ----------
        power : ndarray of float64, shape (..., side, side // 2 + 1)
            On the grid of `rfft2`.

        Returns
        -------
        ndarray of float64, of the same shape
        """
        scene = power * self.fall
        mirrored = scene[..., -np.arange(self.side), :]
        wide = np.concatenate([mirrored[..., 1:2], scene, mirrored[..., -2:-1]], axis=-1)
        mixed = (np.roll(wide, 1, -2) + np.roll(wide, -1, -2)) / 6.0 + wide * (2.0 / 3.0)
        return np.asarray((mixed[..., :-2] + mixed[..., 2:]) / 6.0 + mixed[..., 1:-1] * (2.0 / 3.0))
