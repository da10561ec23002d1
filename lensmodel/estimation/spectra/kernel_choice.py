"""Which of several kernels is likeliest by the spectra of the patches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.psf import resized
from lensmodel.core.types import Kernel, NoiseModel, Plane
from lensmodel.estimation.spectra.local_spectra import LocalSpectra, local_power
from lensmodel.estimation.spectra.scene_spectra import SceneSpectra, log_power
from lensmodel.scene.prior import TAILS

_SIDE = 47  # pixels: holds the widest kernel that a patch's spectra tell of (chosen)
_ROUNDS = 8  # of Gauss and Newton: later ones change no figure that kernels are compared by (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class SpectralLikelihood:
    """Spectra of the patches, whole and in small tiles, and how much either counts.

    Parameters
    ----------
    whole : SceneSpectra
    local : LocalSpectra
    temper : float
        Share of the likelihood of whole spectra that counts (chosen): neighbouring bins err alike.
    parts : float
        The same of local spectra (chosen): tiles overlap, and no mixture is perfect.
    """

    whole: SceneSpectra
    local: LocalSpectra
    temper: float = 0.5
    parts: float = 0.07

    @classmethod
    def of(cls, kept: Sequence[tuple[Plane, NoiseModel]]) -> SpectralLikelihood:
        """Measure patches."""
        return cls(SceneSpectra.of(kept), LocalSpectra.of(kept))

    def cost(self, kernel: Kernel) -> float:
        """What speaks against a kernel; only differences between kernels mean anything."""
        cut = np.asarray(resized(kernel, _SIDE))
        local = self.local.likelihood(local_power(cut))
        return self.temper * self._misfit(cut) - self.parts * local

    def _misfit(self, kernel: NDArray[np.float64]) -> float:
        """Sum of the t-likelihoods of all residuals, with the amplitudes of the scenes that fit best."""
        blur, none = log_power(kernel, np.zeros((0, *kernel.shape)))
        amplitudes = self.whole.begin(blur)
        left, change = self.whole.residuals(blur, none, amplitudes)
        for _ in range(_ROUNDS):
            amplitudes = amplitudes - (change * left[:, None]).sum(axis=0) / (change**2).sum(axis=0)
            left, change = self.whole.residuals(blur, none, amplitudes)
        return (TAILS + 1.0) * float(np.log1p(left**2 / TAILS).sum())
