"""Noise-aware MAP restoration with a sparse-gradient prior, three colours together."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import CHANNELS, Plane, Planes, StepHook, ignore_step
from lensmodel.correction.blur import UniformBlur, transfers
from lensmodel.correction.clipped import Lights
from lensmodel.correction.compiled.grain import spread_grain
from lensmodel.correction.compiled.half_quadratic import half_quadratic
from lensmodel.correction.compiled.tile import fill
from lensmodel.correction.deconvolver import Restored, Sensor, Solution
from lensmodel.correction.methods.shrinkage import Shrinkage
from lensmodel.correction.scene_power import prior
from lensmodel.correction.tiles.beyond_frame import fill_outside
from lensmodel.correction.tiles.canvas import Canvas, seam
from lensmodel.correction.tiles.local_statistics import BlockMeans, signal_variance, smoothed, spread_blocks
from lensmodel.correction.tiles.mosaic import refilled

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
    because edges of all colours coincide; and unmeasured pixels take the model's own prediction as
    data, Y~ = F x, which maximises the likelihood of what was measured. Such a guess converges too
    slowly for lights above the clipping level: see `Lights`, which removes them first.

    Parameters
    ----------
    weight : float
        kappa of luma; the strength relative to the noise found in the data. Where the data say little
        about the gradients, it is lowered to as little as 0.4 of that.
    mosaic_weight : float
        kappa of luma for a mosaic, where the prior must also fill in two colours of three.
    chroma : float
        kappa of chroma over that of luma.
    alpha : float
        Exponent of the prior.
    steps : int
        Half-quadratic steps.
    coupling, growth : float
        First b, in units of one over the squared light, and its factor per step.
        What a kernel's change within the tile adds is recomputed in the first step and half way.
    light_steps : int
        Steps that estimate the light of clipped pixels, and that from beyond the frame.

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
    light_steps: int = 20

    def __post_init__(self) -> None:
        if not (self.weight > 0.0 and self.chroma > 0.0 and self.coupling > 0.0 and self.growth >= 1.0):
            raise InvalidInputError(f"weights of the prior must be positive, got {self}")

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        # as three equal colours, each of which adds its datum but not its gradients to the sum
        alike = replace(
            self,
            **{
                name: getattr(self, name) * len(CHANNELS) ** (1.0 - self.alpha / 2.0)
                for name in ("weight", "mosaic_weight")
            },
        )
        solved = alike.deconvolve_planes(np.stack([blurred] * 3), [blur] * 3, [sensor] * 3)
        on_step(self.steps, self.steps)
        return Restored(solved.planes[0], steps=self.steps)

    def deconvolve_planes(
        self, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
    ) -> Solution:
        """Restore the colours together; see `ColourDeconvolver`."""
        lights = Lights.of(blurred, blurs, sensors, self.light_steps)
        rest, glow = (blurred, None) if lights is None else (lights.rest, lights.glow)
        light = np.maximum(rest.mean(axis=(1, 2)), 1e-4).astype(np.float32)
        canvas = Canvas.around(blurred, blurs, sensors)
        problem = self._problem(rest, blurs, sensors, light, canvas, glow)
        x, explained = _solved(problem)
        inner = (slice(None), *canvas.data)
        restored = x[inner] * light[:, None, None]
        left = rest - explained[inner] * light[:, None, None]
        unexplained = self._unexplained(blurred, left, sensors, light)
        return Solution(restored if lights is None else lights.put_back(blurred, restored), unexplained)

    @staticmethod
    def _unexplained(
        blurred: Planes, left: Planes, sensors: Sequence[Sensor], light: NDArray[np.float32]
    ) -> Planes:
        """What the prior took: the residual of each colour, or, of a mosaic, its grain in light of no colour.

        In a mosaic each pixel measures one colour k; L is the mean light, n the noise of a colour over it,
        and w weighs colours as they are seen. Of the measured residual e, the means S over 5 x 5 pixels are
        coarse grain and detail, their chroma as far as it exceeds its noise (a share q). Fine grain is that
        which one sees in the photo: of the demosaiced residual d, in light of no colour, within a few
        standard deviations of the noise, f = sum w_k ( d_k - mean d_k ) / L_k. Where more than noise is in
        it, t = 0, demosaicing made detail of its own, and the measured residual counts for all colours.
        Either is never more than the grain of a colour, or grain would be coloured::

            s = sum w_k S_k / L_k,    m² = sum w_k n_k²
            r_c / L_c = s + q ( S_c / L_c - s )
                          + t min(1, n_c / m) f + (1 - t) min(1, n_c / n_k) ( e_k - S_k ) / L_k
        """
        clip = np.array([min(s.clip, 1e9) for s in sensors], dtype=np.float32)
        clipped = blurred >= clip[:, None, None]
        left[clipped] = 0.0
        if all(sensor.measured is None for sensor in sensors):
            return left
        known = ~clipped
        for c, sensor in enumerate(sensors):
            if sensor.measured is not None:
                known[c] &= sensor.measured
        noise = np.array([[s.noise.shot, s.noise.read] for s in sensors], dtype=np.float32)
        out = np.empty_like(blurred)
        spread_grain(blurred, left, known, clip, noise, light, out)
        return out

    def _problem(
        self,
        blurred: Planes,
        blurs: Sequence[UniformBlur],
        sensors: Sequence[Sensor],
        light: NDArray[np.float32],
        canvas: Canvas,
        glow: Planes | None,
    ) -> SparseProblem:
        blocks = BlockMeans.of(blurred, light)
        recorded = blocks if glow is None else BlockMeans.of(blurred + glow, light)
        var = np.stack(
            [
                s.noise.variance(smoothed(b * bright)) / bright**2
                for s, b, bright in zip(sensors, recorded.planes, light, strict=True)
            ]
        ).astype(np.float32)
        noise = np.maximum(var.mean(axis=(1, 2)), np.float32(1e-9))
        level = smoothed(blocks.luma)
        relative = (var / noise[:, None, None]).mean(axis=0)
        prox = Shrinkage.of(self.alpha, _RAMP)
        calm = _calm(blocks, level, var.mean(axis=0) / len(blurred), self.alpha)
        threshold = relative * calm / np.maximum(level, _DARK) ** np.float32(self.alpha)
        couplings = self.coupling * self.growth ** np.arange(self.steps)
        known = _known(sensors, canvas)
        drift = blurs[0].drift
        K, rates = transfers(blurs, canvas.shape, max(blurred.shape[1:]) / 2.0)
        variance = (blurred.reshape(len(blurred), -1).var(axis=1) / light**2).astype(np.float32)
        weight, middle = self.weight, len(blurred) // 2
        if any(sensor.measured is not None for sensor in sensors):
            weight = self.mosaic_weight
        elif glow is None:  # beside removed lights the rest is no natural scene: the prior keeps its weight
            weight *= _reliance(_determined_share(K[middle], canvas.shape, noise[middle], variance[middle]))
        weights = np.full(len(blurred), weight)
        weights[1:] *= self.chroma
        y = np.empty((len(blurred), *canvas.shape), dtype=np.float32)
        fill(
            blurred,
            np.float32(1.0) / light,
            canvas.margin,
            seam(canvas.rows, canvas.shape[0]),
            seam(canvas.cols, canvas.shape[1]),
            y,
        )
        if not all(sensor.surrounded for sensor in sensors):
            fill_outside(y, blurred, light, K, blurs, sensors, canvas, self.light_steps)
        if any(sensor.measured is not None for sensor in sensors) and len(blurred) == len(CHANNELS):
            refilled(y, K, noise, variance, sensors, canvas)

        def ramp(axis: int) -> NDArray[np.float32]:
            """Distance in pixels from where the kernel is K; constant beyond the ends of the data."""
            at = np.clip(np.arange(canvas.shape[axis]) - canvas.margin, 0, blurred.shape[1 + axis] - 1)
            return (at - (drift.origin[axis] if drift else 0.0)).astype(np.float32)

        return SparseProblem(
            y=y,
            variance=variance,
            known=known,
            K=K,
            smooth=_gradient_power(canvas.shape),
            noise=noise.astype(np.float32),
            scale=spread_blocks(prox.scale(threshold), canvas),
            factors=prox.scale((weights[None, :] / couplings[:, None]).astype(np.float32)),
            couplings=couplings.astype(np.float32),
            turns=np.isin(np.arange(self.steps), (0, self.steps // 2)),
            drift=rates,
            down=ramp(0),
            across=ramp(1),
            rotation=_OPPONENT if len(y) == len(CHANNELS) else np.eye(len(y), dtype=np.float32),
            prox=prox,
        )


_RAMP = 0.1
"""Of the jump of the shrinkage, see `Shrinkage` (chosen: with none, rounding decides what is kept; a wide one
is no longer the prior's own answer)."""
_TYPICAL_CONTRAST = np.float32(0.02)
"""Variance over squared light of a scene for which kappa is `weight` (chosen: detail of a seventh of the
light. It only sets the unit of `weight`; see `_BUSIEST`, `_CALMEST` for how far others lie)."""
_SCENE = 0.2
"""Least variance over squared light of a cell when its determined share is asked for (chosen: that of a scene
with objects of all brightnesses; with less, flat cells would count as undetermined, and the prior would leave
them their noise)."""
# See `_reliance` (chosen on lenses of development seeds: measured once, no command repeats it)
_OPEN, _SLOPE, _LEAST = 0.25, 0.87, 0.4
# Range of the weight of the prior between texture and flat places (chosen on the same lenses, as those)
_BUSIEST, _CALMEST = 0.7, 50.0
_DARK = np.float32(0.02)
"""Share of a tile's mean light below which the prior stops following it (chosen: with none, all detail of
black would be smoothed away; with more, shadows keep noise that lighter places lose)."""


@dataclass(frozen=True, slots=True, eq=False)
class SparseProblem:
    """Everything that the half-quadratic steps need, on the canvas; see `SparseGradient`."""

    y: Planes
    variance: NDArray[np.float32]
    known: NDArray[np.bool_]
    K: NDArray[np.complex64]
    smooth: NDArray[np.float32]
    noise: NDArray[np.float32]
    scale: NDArray[np.float32]
    factors: NDArray[np.float32]
    couplings: NDArray[np.float32]
    turns: NDArray[np.bool_]
    drift: NDArray[np.complex64]
    down: NDArray[np.float32]
    across: NDArray[np.float32]
    rotation: NDArray[np.float32]
    prox: Shrinkage


def _determined_share(
    K: NDArray[np.complex64], shape: tuple[int, int], noise: np.float32, variance: np.float32
) -> float:
    """Share of the power of a natural scene's gradients that the data determine: sum |F|² S W / sum |F|² S.

    S is the scene's spectrum (in a flat cell, that of an average scene), and
    W = |K|² S / (|K|² S + noise) the share of it that Wiener's filter keeps.
    """
    prior_power = prior(shape)[1]
    blurred_prior = prior_power * (K.real**2 + K.imag**2)
    signal = max(float(variance - noise), _SCENE)
    level = np.float32(
        float(noise) * float(blurred_prior.sum(dtype=np.float64)) / (signal * shape[0] * shape[1])
    )
    gradients = prior_power * _gradient_power(shape)
    return float((gradients * (blurred_prior / (blurred_prior + level))).sum() / gradients.sum())


def _reliance(share: float) -> float:
    """Factor on kappa where the data determine this share of the gradients.

    The most probable picture is not the mean of the probable ones: gradients that the data leave open
    all come out as zero, so where the blur is wide and the noise strong the prior must weigh less.
    """
    return float(np.clip(_OPEN + _SLOPE * share, _LEAST, 1.0))


def _known(sensors: Sequence[Sensor], canvas: Canvas) -> NDArray[np.bool_]:
    """Where the canvas holds data.

    A margin that will be cut off counts as data: its faded pixels are as good as any guess,
    and where everything is known the steps need no prediction.
    """
    known = np.full((len(sensors), *canvas.shape), all(s.surrounded for s in sensors), dtype=np.bool_)
    for plane, sensor in zip(known, sensors, strict=True):
        plane[canvas.data] = True if sensor.measured is None else sensor.measured
    return known


def _solved(p: SparseProblem) -> tuple[Planes, Planes]:
    """The planes on the canvas, and what they make of the data, blurred again."""
    decay, prior_power = prior((p.y.shape[1], p.y.shape[2]))
    x, explained = np.empty_like(p.y), np.empty_like(p.y)
    half_quadratic(
        x,
        p.y,
        p.known,
        bool(p.known.all()),
        p.K,
        p.smooth,
        decay,
        prior_power,
        p.noise,
        p.variance,
        p.scale,
        p.factors,
        p.couplings,
        p.turns,
        p.drift,
        p.down,
        p.across,
        p.rotation,
        np.float32(p.prox.edge),
        np.float32(p.prox.steepness),
        p.prox.terms,
        explained,
    )
    return x, explained


def _calm(
    blocks: BlockMeans, level: NDArray[np.float32], noise: NDArray[np.float32], alpha: float
) -> NDArray[np.float32]:
    """How much smoother than an average scene each block is: the factor on kappa.

    The maximum-likelihood kappa of a hyper-Laplacian is proportional to E|g|^-alpha; gradients
    scale with the local contrast, so it is (typical over local variance of the signal)^(alpha / 2).
    Without it the flat parts of a picture keep the noise that the inverse of a wide kernel amplifies.
    """
    signal = signal_variance(blocks, noise)
    calm = (_TYPICAL_CONTRAST * np.maximum(level, _DARK) ** 2 / signal) ** np.float32(alpha / 2)
    return np.asarray(np.clip(calm, _BUSIEST, _CALMEST), dtype=np.float32)


@lru_cache(maxsize=8)
def _gradient_power(shape: tuple[int, int]) -> NDArray[np.float32]:
    """sum_j |F_j|² of the two forward differences."""
    rows = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.fftfreq(shape[0]))
    cols = 2.0 - 2.0 * np.cos(2.0 * np.pi * fft.rfftfreq(shape[1]))
    return (rows[:, None] + cols[None, :]).astype(np.float32)
