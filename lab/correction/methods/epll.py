"""Deconvolution under a mixture of Gaussians over small windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lab.correction.methods.mixture import shipped_mixture
from lensmodel.core.types import Plane, StepHook, ignore_step
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Restored, Sensor
from lensmodel.correction.tiles.canvas import Canvas

_WHITE = 0.9  # of the photographs that the mixture was fitted to, see `lab.cases`


@dataclass(frozen=True, slots=True)
class EpllDeconvolver:
    """Expected patch log likelihood [1]_ of a whole plane, with the mixture of the benchmark.

    `PatchMixture.restored` on a canvas that reaches beyond the frame, the plane scaled as the photographs
    were that the mixture was fitted to. The judge `lab.blind.judge` takes a patch in their own light,
    padded by mirror images. Slow: minutes per megapixel.

    References
    ----------
    .. [1] D. Zoran and Y. Weiss, "From learning models of natural image patches to whole image
       restoration", ICCV 2011, eq. (4) to (6).
    """

    betas: tuple[float, ...] = (50.0, 100.0, 200.0, 400.0, 800.0, 1600.0, 3200.0)  # couplings of the steps
    stride: int = 3  # one window in `stride`² is used, on a grid moved each time

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        light = max(float(np.percentile(blurred, 99.5)), 1e-3) / _WHITE
        canvas = Canvas(blurred.shape[0], blurred.shape[1], max(blur.reach, 4))
        y = canvas.fill(np.asarray(blurred / np.float32(light), dtype=np.float32))
        K = blur.spectrum(canvas.shape)
        weight = light * light / max(float(sensor.variance(blurred).mean()), 1e-9)
        x = shipped_mixture().restored(y, K, weight, self.betas, self.stride, on_step)
        restored = np.ascontiguousarray(canvas.cut(x) * np.float32(light))
        return Restored(restored, steps=len(self.betas))
