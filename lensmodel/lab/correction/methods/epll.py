"""Deconvolution under a mixture of Gaussians over small windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from lensmodel.core.types import Plane, StepHook, ignore_step
from lensmodel.correction.blur import BlurOperator
from lensmodel.correction.deconvolver import Restored, Sensor, uniform
from lensmodel.correction.tiles.canvas import Canvas
from lensmodel.lab.correction.methods.half_quadratic import half_quadratic
from lensmodel.lab.correction.methods.mixture import shipped_mixture

_WHITE = 0.9  # of the photographs that the mixture was fitted to, see `lensmodel.lab.cases`


@dataclass(frozen=True, slots=True)
class Epll:
    """Expected patch log likelihood [1]_, by half-quadratic splitting, with the mixture of the benchmark.

    For growing beta: clean all windows under the mixture for noise of variance 1/beta, average
    them to z, then solve ``(|K|²/var + beta) X = conj(K) Y/var + beta Z``. The plane is scaled as the
    photographs were that the mixture was fitted to. Slow: minutes per megapixel.

    Parameters
    ----------
    betas : tuple of float
        Couplings of the steps.
    stride : int
        One window in `stride`² is used, on a grid moved each time.

    References
    ----------
    .. [1] D. Zoran and Y. Weiss, "From learning models of natural image patches to whole image
       restoration", ICCV 2011, eq. (4) to (6).
    """

    betas: tuple[float, ...] = (50.0, 100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0)
    stride: int = 3

    def deconvolve(
        self, blurred: Plane, blur: BlurOperator, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        kernel = uniform(blur, "epll")
        light = max(float(np.percentile(blurred, 99.5)), 1e-3) / _WHITE
        canvas = Canvas(blurred.shape[0], blurred.shape[1], max(kernel.reach, 4))
        y = canvas.fill(np.asarray(blurred / np.float32(light), dtype=np.float32))
        K = kernel.spectrum(canvas.shape)
        weight = light * light / max(float(sensor.variance(blurred).mean()), 1e-9)
        data, power = weight * np.conj(K) * fft.rfft2(y), weight * np.abs(K) ** 2
        target = shipped_mixture().spectrum_of_cleaned(self.betas, self.stride)
        x = half_quadratic(y, data, power, self.betas, target, on_step)
        restored = np.ascontiguousarray(canvas.cut(x) * np.float32(light))
        return Restored(restored, steps=len(self.betas))
