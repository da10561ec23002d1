"""One-pass Wiener filter with the spectrum of natural images."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import fft

from lensmodel.core.types import Plane, StepHook, ignore_step
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Restored, Sensor
from lensmodel.correction.scene_power import wiener_spectrum
from lensmodel.correction.tiles.canvas import Canvas


@dataclass(frozen=True, slots=True)
class Wiener:
    """Linear minimum-mean-square-error filter for a natural image in white noise.

    See `wiener_spectrum`.
    """

    caution: float = 1.0  # factor on the noise variance; above 1 the result is smoother

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        canvas = Canvas(blurred.shape[0], blurred.shape[1], blur.reach)
        noise = self.caution * float(sensor.variance(blurred).mean())
        K = blur.spectrum(canvas.shape)
        spectrum = wiener_spectrum(canvas.fill(blurred), K, noise, float(blurred.var()))
        latent = np.asarray(fft.irfft2(spectrum, canvas.shape), dtype=np.float32)
        on_step(1, 1)
        return Restored(np.ascontiguousarray(canvas.cut(latent)), steps=1)
