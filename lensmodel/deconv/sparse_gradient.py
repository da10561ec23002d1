"""Noise-aware MAP restoration with a sparse-gradient prior, three colours together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.blur import BlurOperator, UniformBlur
from lensmodel.deconv.base import Restored, Sensor, uniform
from lensmodel.deconv.canvas import Canvas
from lensmodel.deconv.clipping import faded_to, spoilt
from lensmodel.deconv.engine import Engine, compiled
from lensmodel.deconv.local import signal_variance, smoothed
from lensmodel.deconv.shrinkage import Shrinkage
from lensmodel.deconv.wiener import wiener_canvas
from lensmodel.errors import InvalidInputError
from lensmodel.types import CHANNELS, Plane, Planes, StepHook, ignore_step

# Luma, and two chroma directions, orthonormal.
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
    local light and contrast (gradients of a scene scale with both); chroma is shrunk harder than luma,
    because edges of all colours coincide; and unmeasured or clipped pixels take the model's own
    prediction as data, Y~ = F x (clipped ones only where it is above the clip), which maximises
    the likelihood of what was measured. That guess converges slowly for lights far above the clip:
    pixels that got most of their blur count as unmeasured, and the correction fades out there.

    Parameters
    ----------
    weight : float
        kappa of luma; the strength relative to the noise found in the data.
    mosaic_weight : float
        The same where a mosaic was measured: the prior has to fill in two colours of three as well.
    chroma : float
        kappa of chroma over that of luma.
    alpha : float
        Exponent of the prior.
    steps : int
        Half-quadratic steps.
    coupling, growth : float
        First b, in units of one over the squared light, and its factor per step.
    engine : {"auto", "numpy"}
        "numpy" never uses compiled loops; the numbers are the same.

    References
    ----------
    .. [1] D. Krishnan, R. Fergus, "Fast image deconvolution using hyper-Laplacian priors",
       NIPS 2009, eq. 3 to 5.
    """

    weight: float = 2.0
    mosaic_weight: float = 4.0
    chroma: float = 2.5
    alpha: float = 0.67
    steps: int = 8
    coupling: float = 1.5
    growth: float = 3.0
    engine: Engine = "auto"

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
        light = np.maximum(blurred.mean(axis=(1, 2)), 1e-4).astype(np.float32)[:, None, None]
        canvas = Canvas(blurred.shape[1], blurred.shape[2], margin=max(blur.reach for blur in blurs))
        problem = self._problem(blurred, blurs, sensors, light, canvas)
        loops = compiled(self.engine) if len(blurred) == len(CHANNELS) else None
        x = problem.start if loops is None else problem.start.copy()
        if loops is None:
            x = _half_quadratic(problem, on_step)
        else:
            loops.half_quadratic(
                x,
                problem.y,
                problem.state,
                problem.K,
                problem.smooth,
                problem.noise,
                problem.scale,
                problem.factors,
                problem.couplings,
                problem.drift,
                problem.down,
                problem.across,
                problem.rotation,
                np.float32(problem.prox.jump),
                problem.prox.terms,
            )
            on_step(self.steps, self.steps)
        restored = np.ascontiguousarray(x[:, canvas.data[0], canvas.data[1]] * light)
        return faded_to(blurred, restored, blurred >= _clips(sensors), blurs)

    def _problem(
        self,
        blurred: Planes,
        blurs: Sequence[UniformBlur],
        sensors: Sequence[Sensor],
        light: NDArray[np.float32],
        canvas: Canvas,
    ) -> _Problem:
        planes = blurred / light
        var = np.stack([s.variance(smoothed(y)) for s, y in zip(sensors, blurred, strict=True)]) / light**2
        noise = np.maximum(var.mean(axis=(1, 2)), np.float32(1e-9))
        y = np.stack([canvas.fill(plane) for plane in planes])
        luma = planes.mean(axis=0)
        level = np.maximum(canvas.fill(smoothed(luma)), _DARK)
        relative = canvas.fill((var / noise[:, None, None]).mean(axis=0))
        prox = Shrinkage.of(self.alpha)
        calm = canvas.fill(_calm(luma, var.mean(axis=0) / len(planes), self.alpha))
        scale = prox.scale((relative * calm / level ** np.float32(self.alpha)).astype(np.float32))
        couplings = self.coupling * self.growth ** np.arange(self.steps)
        mosaic = any(sensor.measured is not None for sensor in sensors)
        weights = np.full(len(y), self.mosaic_weight if mosaic else self.weight, dtype=np.float64)
        weights[1:] *= self.chroma
        state = np.full(y.shape, _UNMEASURED, dtype=np.uint8)
        inside = (slice(None), *canvas.data)
        clipped = blurred >= _clips(sensors)
        state[inside] = np.where(clipped, _CLIPPED, np.where(spoilt(clipped, blurs), _UNMEASURED, _MEASURED))
        for plane, sensor in zip(state, sensors, strict=True):
            if sensor.measured is not None:
                plane[canvas.data][~sensor.measured] = _UNMEASURED
        start = np.stack(
            [
                wiener_canvas(a, blur, float(n), float(plane.var()))
                for a, blur, n, plane in zip(y, blurs, noise, planes, strict=True)
            ]
        )
        drift = blurs[0].drift

        def ramp(axis: int) -> NDArray[np.float32]:
            """Pixels from where the kernel is K; held at the ends of the data, beyond which lies no datum."""
            at = np.clip(np.arange(canvas.shape[axis]) - canvas.margin, 0, blurred.shape[1 + axis] - 1)
            return (at - (drift.origin[axis] if drift else 0.0)).astype(np.float32)

        return _Problem(
            start=start,
            y=y,
            state=state,
            K=np.stack([blur.spectrum(canvas.shape) for blur in blurs]),
            smooth=_gradient_power(canvas.shape),
            noise=noise.astype(np.float32),
            scale=scale,
            factors=prox.scale((weights[None, :] / couplings[:, None]).astype(np.float32)),
            couplings=couplings.astype(np.float32),
            drift=_drifts(blurs, canvas.shape, max(blurred.shape[1:]) / 2.0),
            down=ramp(0),
            across=ramp(1),
            rotation=_OPPONENT if len(y) == len(CHANNELS) else np.eye(len(y), dtype=np.float32),
            prox=prox,
        )


_MEASURED, _UNMEASURED, _CLIPPED = 0, 1, 2
_TYPICAL_CONTRAST = np.float32(0.02)  # variance over squared light of a scene for which kappa is `weight`
_BUSIEST, _CALMEST = 0.7, 50.0
_DARK = np.float32(0.02)  # share of a tile's mean light below which the prior follows it no further


@dataclass(frozen=True, slots=True, eq=False)
class _Problem:
    """Everything that the half-quadratic steps need, on the canvas; see `SparseGradient`."""

    start: Planes
    y: Planes
    state: NDArray[np.uint8]
    K: NDArray[np.complex64]
    smooth: NDArray[np.float32]
    noise: NDArray[np.float32]
    scale: NDArray[np.float32]
    factors: NDArray[np.float32]
    couplings: NDArray[np.float32]
    drift: NDArray[np.complex64]
    down: NDArray[np.float32]
    across: NDArray[np.float32]
    rotation: NDArray[np.float32]
    prox: Shrinkage


def _drifts(blurs: Sequence[UniformBlur], shape: tuple[int, int], reach: float) -> NDArray[np.complex64]:
    """Change of the transfer functions per pixel, `(channel, 2, rows, cols)`; empty where one has none.

    Each step inverts K alone and takes the change to the other side, as data. That converges only where
    the change is smaller than K, so it is limited to half of K at `reach` pixels from the middle.
    """
    found = []
    for blur in blurs:
        if blur.drift is None:
            return np.zeros((0, 2, 0, 0), dtype=np.complex64)
        rates = blur.drift.spectra(shape)
        change = np.float32(reach) * np.abs(rates).sum(axis=0)
        allowed = np.float32(0.5) * np.abs(blur.spectrum(shape))
        found.append(rates * np.minimum(allowed / np.maximum(change, np.float32(1e-9)), np.float32(1.0)))
    return np.stack(found).astype(np.complex64)


def _clips(sensors: Sequence[Sensor]) -> NDArray[np.float32]:
    return np.array([s.clip for s in sensors], dtype=np.float32)[:, None, None]


def _half_quadratic(p: _Problem, on_step: StepHook) -> Planes:
    """The steps in NumPy; `compiled.half_quadratic` is their twin."""
    shape = (p.y.shape[1], p.y.shape[2])
    power = np.abs(p.K) ** 2
    x = p.start
    X = fft.rfft2(x)
    for step, coupling in enumerate(p.couplings):
        pull = np.zeros_like(x)
        scales = p.factors[step][:, None, None] * p.scale
        for axis in (1, 2):
            slope = np.roll(x, -1, axis=axis) - x
            kept = p.prox(np.einsum("ij,jrc->irc", p.rotation, slope), scales)
            kept = np.einsum("ji,jrc->irc", p.rotation, kept)
            pull += np.roll(kept, 1, axis=axis) - kept
        predicted = p.K * X
        if p.drift.size:
            predicted += p.drift[:, 0] * fft.rfft2(x * p.down[:, None])
            predicted += p.drift[:, 1] * fft.rfft2(x * p.across)
        left = p.y - fft.irfft2(predicted, shape)
        measured = (p.state == _MEASURED) | ((p.state == _CLIPPED) & (left > 0.0))
        data = power * X + np.conj(p.K) * fft.rfft2(np.where(measured, left, np.float32(0.0)))
        strength = (coupling * p.noise)[:, None, None]
        X = (data + strength * fft.rfft2(pull)) / (power + strength * p.smooth)
        x = fft.irfft2(X, shape).astype(np.float32)
        on_step(step + 1, len(p.couplings))
    return x


def _calm(luma: NDArray[np.float32], noise: NDArray[np.float32], alpha: float) -> NDArray[np.float32]:
    """How much smoother than an average scene it is here: the factor on kappa.

    The maximum-likelihood kappa of a hyper-Laplacian is proportional to E|g|^-alpha; gradients
    scale with the local contrast, so it is (typical over local variance of the signal)^(alpha / 2).
    Without it the flat parts of a picture keep the noise that the inverse of a wide kernel amplifies.
    """
    signal = signal_variance(luma, noise)
    level = np.maximum(smoothed(luma), _DARK)
    calm = (_TYPICAL_CONTRAST * level**2 / signal) ** np.float32(alpha / 2)
    return np.asarray(np.clip(calm, _BUSIEST, _CALMEST), dtype=np.float32)


@lru_cache(maxsize=8)
def _gradient_power(shape: tuple[int, int]) -> NDArray[np.float32]:
    """sum_j |F_j|² of the two forward differences, plus a trace that keeps the quotient finite."""
    rows = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.fftfreq(shape[0]))
    cols = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.rfftfreq(shape[1]))
    return (rows[:, None] + cols[None, :]).astype(np.float32)
