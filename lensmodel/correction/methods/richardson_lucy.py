"""Richardson-Lucy: plain, accelerated, and aware of clipped pixels."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import Plane, StepHook, ignore_step
from lensmodel.correction.blur import UniformBlur, fast_shape
from lensmodel.correction.compiled.richardson_lucy import richardson_lucy
from lensmodel.correction.deconvolver import TINY, Restored, Sensor

Acceleration: TypeAlias = Literal["fixed", "adaptive", "none"]
"""How far the estimate is extrapolated before a step, see `SaturationAwareRichardsonLucy`."""

ACCELERATIONS: Final = get_args(Acceleration)

ALPHA_MAX = 0.9
"""Cap of the fixed extrapolation; above it the noise is accelerated as well."""

SHARPNESS = 50.0
"""a of the sensor response, per clipping level: how sharply it bends where it clips (chosen: the bend is then
a tenth of the level wide; a sharper one gives steps no slope to follow, a softer one bends what the sensor
records in proportion)."""


@dataclass(frozen=True, slots=True)
class RichardsonLucy:
    """Richardson-Lucy iteration, the maximum-likelihood ascent for Poisson noise [1]_.

    Each step multiplies the estimate by the back-projected ratio of data to prediction::

        x <- x / (F^T 1) * F^T ( (y + b) / (F x + b) )

    The background b = read / shot variance makes read noise nearly Poisson [2]_; without it the
    dark parts diverge.

    Parameters
    ----------
    iterations : int
        Number of steps; the only regulariser. Noise grows with it.

    References
    ----------
    .. [1] W. H. Richardson, "Bayesian-based iterative method of image restoration",
       J. Opt. Soc. Am. 62, 55-59, 1972.
    .. [2] D. L. Snyder, C. W. Helstrom, A. D. Lanterman, M. Faisal, R. L. White, "Compensation for
       readout noise in CCD images", J. Opt. Soc. Am. A 12, 272-283, 1995.
    """

    iterations: int = 15

    def __post_init__(self) -> None:
        _check(self.iterations)

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        base = background(sensor)
        data = np.maximum(blurred, 0.0) + base
        latent, reach = first_guess(blurred, blur)
        for step in range(1, self.iterations + 1):
            # Written with the error instead of the ratio: at the rim, where F^T 1 is small and
            # floored, a perfect prediction must leave the estimate alone.
            error = data / np.maximum(blur.forward(latent) + base, TINY) - 1.0
            latent = latent * np.maximum(1.0 + blur.adjoint(error) / reach, 0.0)
            on_step(step, self.iterations)
        return Restored(np.ascontiguousarray(blur.frame(latent)), steps=self.iterations)


@dataclass(frozen=True, slots=True)
class SaturationAwareRichardsonLucy:
    """Richardson-Lucy for a sensor that clips, without rings around lights [1]_, accelerated [2]_.

    The sensor answers with a smooth minimum of light and clipping level t::

        R(z) = z - log(1 + exp(a (z - t))) / a,     R'(z) = 1 / (1 + exp(a (z - t)))
        e    = ( (y + b) / (R(F x) + b) - 1 ) R'(F x)

    so a clipped pixel pulls the model up to t and no further. Sharp pixels S that shine above
    0.9 t are poorly known, and blurred pixels that they reach are left out of the update of all others::

        u_U = 1 + F^T(e V),   u_S = 1 + F^T e,   x <- x max( u_U + (u_S - u_U) w, 0 )

    with V = 0 wherever a pixel of S reaches and w the softened S. Before each step the estimate
    is extrapolated, y_k = x_k + alpha_k (x_k - x_{k-1}), by one of two schedules::

        fixed      alpha_k = (k - 1) / (k + 2), at most 0.9
        adaptive   alpha_k = <g_{k-1}, g_{k-2}> / <g_{k-2}, g_{k-2}>, within 0..1,   g_k = x_{k+1} - y_k

    The second is that of Biggs and Andrews [2]_. It measures alpha tile by tile, so the result
    depends a little on where the tiles lie.

    Parameters
    ----------
    iterations : int
        Number of steps.
    sharpness : float
        a, per clipping level.
    acceleration : {"fixed", "adaptive", "none"}
        How to extrapolate, or not at all.
    warped : bool
        Whether lateral colour is to be removed by resampling before: see `WarpableMethod`.

    References
    ----------
    .. [1] O. Whyte, J. Sivic, A. Zisserman, "Deblurring shaken and partially saturated images",
       IJCV 110, 185-201, 2014, eq. 13 to 19.
    .. [2] D. S. C. Biggs, M. Andrews, "Acceleration of iterative image restoration algorithms",
       Applied Optics 36, 1766-1775, 1997.
    """

    iterations: int = 25
    sharpness: float = SHARPNESS
    acceleration: Acceleration = "fixed"
    warped: bool = False

    def __post_init__(self) -> None:
        _check(self.iterations)
        if self.acceleration not in ACCELERATIONS:
            raise InvalidInputError(
                f"acceleration must be one of {', '.join(ACCELERATIONS)}, got {self.acceleration!r}"
            )

    def deconvolve(
        self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor, on_step: StepHook = ignore_step
    ) -> Restored:
        """Deconvolve one plane; see `Deconvolver`."""
        latent, reach = first_guess(blurred, blur)
        lights = bool(blurred.max() >= _LIGHT * sensor.clip)
        latent = richardson_lucy_steps(
            latent,
            blurred,
            reach,
            blur,
            sensor,
            steps=self.iterations,
            sharpness=self.sharpness,
            acceleration=self.acceleration,
            lights=lights,
            on_step=on_step,
        )
        return Restored(np.ascontiguousarray(blur.frame(latent)), steps=self.iterations)


_REACH_FLOOR = 0.05
"""Least F^T 1, as a share of its largest value: see `first_guess` (chosen: a pixel with less of its light
in the frame would be divided by little, and noise would explode; with more, the rim would be too dark)."""
_LIGHT = 0.9
"""Share of the clipping level above which a sharp pixel counts as a light (chosen: blur leaves the rim of a
light a little below the level; much lower, ordinary bright places would be treated as lights)."""


def richardson_lucy_steps(
    latent: Plane,
    blurred: Plane,
    reach: Plane,
    blur: UniformBlur,
    sensor: Sensor,
    *,
    steps: int,
    sharpness: float = SHARPNESS,
    acceleration: Acceleration = "fixed",
    lights: bool = False,
    on_step: StepHook = ignore_step,
) -> Plane:
    """Take the steps of `SaturationAwareRichardsonLucy`.

    Parameters
    ----------
    latent : Plane
        Start, wider than the data by the reach of the blur.
    blurred : Plane
        The data.
    reach : Plane
        Normaliser of each pixel of the latent plane.
    blur, sensor, steps, sharpness, acceleration, on_step
        As in `SaturationAwareRichardsonLucy`.
    lights : bool
        Whether to keep what is poorly known about lights out of the update of all other pixels.
    """
    base = background(sensor)
    data: Plane = np.ascontiguousarray(np.maximum(blurred, 0.0) + base, dtype=np.float32)
    count = np.arange(1, steps + 1)
    fixed = np.minimum((count - 1) / (count + 2), ALPHA_MAX) * (acceleration == "fixed")
    alphas, adaptive = fixed.astype(np.float32), acceleration == "adaptive"
    shape = fast_shape(latent.shape)
    latent = np.array(latent, dtype=np.float32, order="C")
    richardson_lucy(
        latent,
        data,
        reach.astype(np.float32),
        blur.spectrum(shape),
        np.float32(base),
        np.float32(sensor.clip),
        *_bend(sharpness),
        alphas,
        adaptive,
        shape[1],
        lights,
    )
    on_step(steps, steps)
    return latent


@lru_cache(maxsize=8)
def _bend(sharpness: float) -> tuple[NDArray[np.float32], np.float32, np.float32]:
    """R and R' of `response` at even steps of light over clipping level, and the first and last step.

    Below that range R equals the light and above it the clipping level, to a millionth.
    """
    first, last = max(1.0 - 15.0 / sharpness, 0.0), 1.0 + 25.0 / sharpness
    light = np.linspace(first, last, 4097)
    return np.stack(response(light.astype(np.float32), 1.0, sharpness)), np.float32(first), np.float32(last)


def background(sensor: Sensor) -> float:
    """Read variance over shot variance: the light whose Poisson noise equals the read noise."""
    if sensor.noise.shot <= 0.0:
        return 0.0
    return min(sensor.noise.read / sensor.noise.shot, 1.0)


def first_guess(blurred: Plane, blur: UniformBlur) -> tuple[Plane, Plane]:
    """Back-projected data as a start, and the normaliser F^T 1.

    F^T 1 falls below 1 where part of the light fell outside the frame. It is floored: latent
    pixels that hardly touch the data must not explode; they start from the nearest data.
    """
    light = np.maximum(blurred, TINY)
    reach = blur.covered(blurred.shape)
    floor = _REACH_FLOOR * float(reach.max())
    wide = (reach.shape[0] - blurred.shape[0]) // 2
    start = np.where(
        reach > floor, blur.adjoint(light) / np.maximum(reach, floor), np.pad(light, wide, mode="edge")
    )
    return np.maximum(start, TINY).astype(np.float32), np.maximum(reach, floor)


def response(light: Plane, clip: float, sharpness: float) -> tuple[Plane, Plane]:
    """Sensor response R and its slope R' for linear light; see `SaturationAwareRichardsonLucy`."""
    if not np.isfinite(clip):
        return light, np.ones_like(light)
    over = sharpness * (light / clip - 1.0)
    recorded = clip * (light / clip - np.logaddexp(0.0, over) / sharpness)
    slope = 0.5 * (1.0 - np.tanh(0.5 * over))  # the logistic function without overflow
    return recorded.astype(np.float32), slope.astype(np.float32)


def _check(iterations: int) -> None:
    if not 1 <= iterations <= 500:
        raise InvalidInputError(f"iterations must lie in 1..500, got {iterations}")
