"""Deconvolution with a hyper-Laplacian prior, as published."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lab.correction.methods.half_quadratic import growing, half_quadratic
from lensmodel.core.types import Plane, StepHook, ignore_step
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Restored, Sensor
from lensmodel.correction.methods.shrinkage import Shrinkage
from lensmodel.correction.tiles.canvas import Canvas


@dataclass(frozen=True, slots=True)
class KrishnanFergus:
    """Half-quadratic solution of min lambda/2 |k * x - y|² + sum_j |f_j * x|^alpha [1]_.

    lambda follows the noise: 0.2 / var, which is the published 2000 at one percent.

    References
    ----------
    .. [1] D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors",
       NIPS 2009, algorithm 1.
    """

    alpha: float = 2.0 / 3.0  # exponent of the prior

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        canvas = Canvas(blurred.shape[0], blurred.shape[1], blur.reach)
        data = canvas.fill(blurred)
        shape = canvas.shape
        K = blur.spectrum(shape)
        fidelity = 0.2 / max(float(sensor.variance(blurred).mean()), 1e-9)
        rows = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.fftfreq(shape[0]))
        cols = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.rfftfreq(shape[1]))
        slopes = (rows[:, None] + cols[None, :]).astype(np.float32)
        pulled, power = np.conj(K) * fft.rfft2(data), np.abs(K) ** 2
        prox = Shrinkage.of(self.alpha)
        betas = growing(1.0, 256.0, 2.0 * math.sqrt(2.0))

        def led_back(x: NDArray[np.float32], turn: int) -> NDArray[np.complex64]:
            total = np.zeros(shape, dtype=np.float32)
            for axis in (0, 1):
                slope = np.roll(x, -1, axis=axis) - x
                kept = prox(slope, float(prox.scale(1.0 / betas[turn])))
                total += np.roll(kept, 1, axis=axis) - kept
            return np.asarray(fft.rfft2(total))

        couplings = [np.float32(beta / fidelity) for beta in betas]
        latent = half_quadratic(data, pulled, power, couplings, led_back, on_step, curvature=slopes)
        return Restored(np.ascontiguousarray(canvas.cut(latent)), steps=len(betas))
