"""Noise-aware MAP restoration with a sparse-gradient prior, three colours together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft, ndimage

from lensmodel.blur import BlurOperator, UniformBlur
from lensmodel.deconv.base import Restored, Sensor, uniform
from lensmodel.deconv.canvas import Canvas
from lensmodel.deconv.shrinkage import Shrinkage
from lensmodel.deconv.wiener import wiener_canvas
from lensmodel.errors import InvalidInputError
from lensmodel.types import Plane, Planes, StepHook, ignore_step

_OPPONENT = np.array(
    [
        [1 / np.sqrt(3)] * 3,
        [1 / np.sqrt(2), 0.0, -1 / np.sqrt(2)],
        [-1 / np.sqrt(6), 2 / np.sqrt(6), -1 / np.sqrt(6)],
    ],
    dtype=np.float32,
)


@dataclass(frozen=True, slots=True)
class SparseGradient:
    r"""Maximum a posteriori under Poisson-Gaussian noise and heavy-tailed gradients.

    With the channels c scaled to equal light and T the orthonormal luma-chroma rotation::

        min  sum_c |y_c - k_c * x_c|² / (2 var_c)  +  sum_{j,i} kappa_i |(T f_j * x)_i / level|^alpha

    solved by half-quadratic splitting [1]_ with auxiliary gradients w, whose coupling b grows::

        w = T' prox( T f_j * x ; kappa / b ),
        X_c = ( conj(K) Y~ + b var sum_j conj(F_j) W_j ) / ( |K|² + b var sum_j |F_j|² )

    Three departures from [1]_: the threshold follows the noise variance pixel by pixel, and the
    local light (gradients of a scene scale with its illumination); chroma is shrunk harder than luma,
    because edges of all colours coincide; and unmeasured or clipped pixels take the model's own
    prediction as data, Y~ = F x (clipped ones only where it is above the clip), which maximises
    the likelihood of what was measured.

    Parameters
    ----------
    weight : float
        kappa of luma; the strength relative to the noise found in the data.
    chroma : float
        kappa of chroma over that of luma.
    alpha : float
        Exponent of the prior.
    steps : int
        Half-quadratic steps.
    coupling, growth : float
        First b, in units of one over the squared light, and its factor per step.

    References
    ----------
    .. [1] D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors",
       NIPS 2009, eq. 3 to 5.
    """

    weight: float = 3.0
    chroma: float = 3.0
    alpha: float = 0.67
    steps: int = 7
    coupling: float = 4.0
    growth: float = 2.5

    def __post_init__(self) -> None:
        if not (self.weight > 0.0 and self.chroma > 0.0 and self.coupling > 0.0 and self.growth >= 1.0):
            raise InvalidInputError(f"weights of the prior must be positive, got {self}")

    def deconvolve(
        self, blurred: Plane, blur: BlurOperator, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        restored = self._solve(blurred[None], [uniform(blur, "standard")], [sensor], on_step)
        return Restored(restored[0], steps=self.steps)

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Planes:
        """Restore the colours together; see `ColourDeconvolver`."""
        return self._solve(blurred, blurs, sensors, ignore_step)

    def _solve(
        self,
        blurred: Planes,
        blurs: Sequence[UniformBlur],
        sensors: Sequence[Sensor],
        on_step: StepHook,
    ) -> Planes:
        channels = len(blurred)
        canvas = Canvas(blurred.shape[1], blurred.shape[2], margin=max(blur.reach for blur in blurs))
        shape = canvas.shape
        light = np.maximum(blurred.mean(axis=(1, 2)), 1e-4).astype(np.float32)
        planes = blurred / light[:, None, None]
        var = np.stack([s.variance(_smooth(y)) for s, y in zip(sensors, blurred, strict=True)])
        var = var / (light**2)[:, None, None]
        noise = np.maximum(var.mean(axis=(1, 2)), np.float32(1e-9))
        y = np.stack([canvas.fill(plane) for plane in planes])
        level = np.maximum(canvas.fill(_smooth(planes.mean(axis=0))), np.float32(0.02))
        relative = canvas.fill((var / noise[:, None, None]).mean(axis=0))
        weights = np.full(channels, self.weight * self.chroma, dtype=np.float32)
        weights[0] = self.weight
        rotation = _OPPONENT if channels == 3 else np.eye(channels, dtype=np.float32)
        prox = Shrinkage.of(self.alpha)
        base = relative / level ** np.float32(self.alpha)
        known = np.zeros(shape, dtype=bool)
        known[canvas.data] = True
        clip = np.array([s.clip for s in sensors], dtype=np.float32) / light
        clipped = np.stack([known & (plane >= limit) for plane, limit in zip(y, clip, strict=True)])
        K = np.stack([blur.spectrum(shape) for blur in blurs])
        power = np.abs(K) ** 2
        smooth = _gradient_power(shape)
        x = np.stack(
            [
                wiener_canvas(a, blur, float(n), float(p.var()))
                for a, blur, n, p in zip(y, blurs, noise, planes, strict=True)
            ]
        )
        X = fft.rfft2(x)
        b = self.coupling
        for step in range(1, self.steps + 1):
            predicted = fft.irfft2(K * X, shape)
            data = np.where(known, y, predicted)
            data = np.where(clipped, np.maximum(y, predicted), data)
            pull = np.zeros_like(x)
            scales = [prox.scale((base * (w / b)).astype(np.float32)) for w in weights]
            for axis in (1, 2):
                slope = np.roll(x, -1, axis=axis) - x
                mixed = np.einsum("ij,jrc->irc", rotation, slope)
                kept = np.stack([prox(v, s) for v, s in zip(mixed, scales, strict=True)])
                kept = np.einsum("ji,jrc->irc", rotation, kept)
                pull += np.roll(kept, 1, axis=axis) - kept
            strength = (b * noise)[:, None, None]
            X = (np.conj(K) * fft.rfft2(data) + strength * fft.rfft2(pull)) / (power + strength * smooth)
            x = fft.irfft2(X, shape).astype(np.float32)
            b *= self.growth
            on_step(step, self.steps)
        return np.ascontiguousarray(x[:, canvas.data[0], canvas.data[1]] * light[:, None, None])


def _smooth(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    return ndimage.gaussian_filter(plane, 3.0, mode="nearest")


def _gradient_power(shape: tuple[int, int]) -> NDArray[np.float32]:
    """sum_j |F_j|² of the two forward differences, plus a trace that keeps the quotient finite."""
    rows = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.fftfreq(shape[0]))
    cols = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.rfftfreq(shape[1]))
    return (rows[:, None] + cols[None, :]).astype(np.float32)
