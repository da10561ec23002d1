"""Richardson-Lucy: accelerated, aware of clipped pixels; and the light of these that such steps find."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, special

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Plane, Planes
from lensmodel.correction.blur import (
    BACK,
    FORWARD,
    ONE,
    ZERO,
    Canvas,
    Complex,
    Number,
    Real,
    UniformBlur,
    fast_shape,
    smooth,
    through,
)
from lensmodel.correction.deconvolver import Sensor

Acceleration: TypeAlias = Literal["fixed", "adaptive", "none"]
"""How far the estimate is extrapolated before a step, see `SaturationAwareRichardsonLucy`."""

_Response: TypeAlias = tuple[Real, Number, Number]

_ACCELERATIONS: Final = get_args(Acceleration)
_ALPHA_MAX: Final = 0.9  # of the fixed extrapolation; above it the noise is accelerated as well
_SHARPNESS: Final = 50.0  # a of the sensor response: it bends over a tenth of the clipping level (chosen)
_REACH_FLOOR: Final = 0.05
"""Share of the largest F^T 1, the least to divide by (chosen: less lets noise explode, more darkens rims)."""
_LIGHT: Final = 0.9
"""Share of the clipping level above which a sharp pixel is a light: blur dims its rim a little (chosen)."""
_TINY: Final = np.float32(1e-6)  # saturations: least light to divide by (chosen: far below noise)
_LEAST_PREDICTED: Final = np.float32(0.1)  # of the datum: a step raises light tenfold at most (chosen)
_SOFT: Final = special.softmax(-(np.arange(-10, 11) ** 2) / 18.0).astype(np.float32)
"""Weights that soften the places of lights: a Gaussian of 3 pixels (chosen)."""


@dataclass(frozen=True, slots=True)
class SaturationAwareRichardsonLucy:
    """Richardson-Lucy for a sensor that clips, without rings around lights, accelerated.

    The maximum-likelihood ascent for Poisson noise of W. H. Richardson, J. Opt. Soc. Am. 62, 55-59, 1972.

    After O. Whyte, J. Sivic, A. Zisserman, "Deblurring shaken and partially saturated images", IJCV 110,
    185-201, 2014, eq. 13 to 19. The sensor answers with a smooth minimum of light and clipping level t::

        R(z) = z - log(1 + exp(a (z - t))) / a,     R'(z) = 1 / (1 + exp(a (z - t)))
        e    = ( (y + b) / (R(F x) + b) - 1 ) R'(F x)

    so a clipped pixel pulls the model up to t and no further. Sharp pixels S that shine above
    0.9 t are poorly known, and blurred pixels that they reach are left out of the update of all others::

        u_U = 1 + F^T(e V),   u_S = 1 + F^T e,   x <- x max( u_U + (u_S - u_U) w, 0 )

    with V = 0 wherever a pixel of S reaches and w the softened S. Before each step the estimate
    is extrapolated, y_k = x_k + alpha_k (x_k - x_{k-1}), by one of two schedules::

        fixed      alpha_k = (k - 1) / (k + 2), at most 0.9
        adaptive   alpha_k = <g_{k-1}, g_{k-2}> / <g_{k-2}, g_{k-2}>, within 0..1,   g_k = x_{k+1} - y_k

    The second is that of D. S. C. Biggs and M. Andrews, "Acceleration of iterative image restoration
    algorithms", Applied Optics 36, 1766-1775, 1997. It measures alpha tile by tile, so the result depends a
    little on where the tiles lie.
    """

    iterations: int = 25
    acceleration: Acceleration = "fixed"
    warped: bool = False  # whether lateral colour is removed by resampling before, not as part of the kernels

    def __post_init__(self) -> None:
        if not 1 <= self.iterations <= 500:
            raise InvalidInputError(f"iterations must lie in 1..500, got {self.iterations}")
        if self.acceleration not in _ACCELERATIONS:
            raise InvalidInputError(
                f"acceleration must be one of {', '.join(_ACCELERATIONS)}, got {self.acceleration!r}"
            )

    def deconvolve(self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor) -> Plane:
        """Deconvolve one plane; see `Deconvolver`."""
        latent, reach = first_guess(blurred, blur)
        lights = bool(blurred.max() >= _LIGHT * sensor.clip)
        return blur.frame(
            richardson_lucy_steps(
                latent, blurred, reach, blur, sensor, self.iterations, self.acceleration, lights=lights
            )
        )


def first_guess(blurred: Plane, blur: UniformBlur) -> tuple[Plane, Plane]:
    """Back-projected data as a start, and the normaliser F^T 1, floored where little light met the frame."""
    light = np.maximum(blurred, _TINY)
    reach = blur.adjoint(np.ones_like(blurred, dtype=np.float32))
    floor = _REACH_FLOOR * float(reach.max())
    wide = (reach.shape[0] - blurred.shape[0]) // 2
    start = np.where(
        reach > floor, blur.adjoint(light) / np.maximum(reach, floor), np.pad(light, wide, mode="edge")
    )
    return np.maximum(start, _TINY).astype(np.float32), np.maximum(reach, floor)


def richardson_lucy_steps(
    latent: Plane,
    blurred: Plane,
    reach: Plane,
    blur: UniformBlur,
    sensor: Sensor,
    steps: int,
    acceleration: Acceleration = "fixed",
    *,
    lights: bool = False,
) -> Plane:
    """Take steps of `SaturationAwareRichardsonLucy` from `latent`, each pixel normalised by `reach`.

    `lights` says whether to keep what is poorly known about lights out of the update of all other pixels.
    """
    base = _background(sensor)
    data: Plane = np.ascontiguousarray(np.maximum(blurred, 0.0) + base, dtype=np.float32)
    count = np.arange(1, steps + 1)
    fixed = np.minimum((count - 1) / (count + 2), _ALPHA_MAX) * (acceleration == "fixed")
    shape = fast_shape(latent.shape)
    latent = np.array(latent, dtype=np.float32, order="C")
    _steps(
        latent,
        data,
        reach.astype(np.float32),
        blur.spectrum(shape),
        np.float32(base),
        np.float32(sensor.clip),
        _response(),
        fixed.astype(np.float32),
        acceleration == "adaptive",
        shape[1],
        lights,
    )
    return latent


def _background(sensor: Sensor) -> float:
    """Read variance over shot variance: the light whose Poisson noise equals the read noise.

    It makes read noise nearly Poisson (D. L. Snyder et al., J. Opt. Soc. Am. A 12, 272-283, 1995); without it
    the dark parts diverge.
    """
    if sensor.noise.shot <= 0.0:
        return 0.0
    return min(sensor.noise.read / sensor.noise.shot, 1.0)


@lru_cache(maxsize=1)
def _response() -> _Response:
    """R and R' at even steps of light over clipping level, and the first and last step.

    Below that range R equals the light and above it the clipping level, to a millionth.
    """
    first, last = 1.0 - 15.0 / _SHARPNESS, 1.0 + 25.0 / _SHARPNESS
    light = np.linspace(first, last, 4097).astype(np.float32)
    over = _SHARPNESS * (light - 1.0)
    recorded = light - np.logaddexp(0.0, over) / _SHARPNESS
    slope = 0.5 * (1.0 - np.tanh(0.5 * over))  # the logistic function without overflow
    return np.stack([recorded, slope]).astype(np.float32), np.float32(first), np.float32(last)


@jit
def _lights(  # noqa: C901, PLR0912 - a few passes over one small tile
    latent: Real, level: Number, reach: int, clean: Real, soft: Real
) -> bool:
    """Find bright sharp pixels: mark what they reach as unclean, and their own places softly.

    Returns whether there are any. `clean` has the size of the data, `soft` that of the latent plane.
    """
    rows, cols = latent.shape
    hard = np.zeros((rows, cols), np.float32)
    any_light = False
    for i in range(rows):
        for j in range(cols):
            if latent[i, j] >= level:
                any_light = True
                for di in range(-3, 4):
                    for dj in range(-3, 4):
                        a, b = i + di, j + dj
                        if di * di + dj * dj <= 9 and 0 <= a < rows and 0 <= b < cols:
                            hard[a, b] = ONE
    if not any_light:
        return False
    # A square of the operator's reach covers the kernel without knowing its shape. One pass each
    # way that remembers the last mark costs the same for any reach.
    across = clean.shape[1]
    wide = np.zeros((rows, across), np.uint8)
    for i in range(rows):
        last = -4 * reach - 4
        for j in range(cols):
            if hard[i, j] > ZERO:
                last = j
            if j >= 2 * reach and j - last <= 2 * reach:
                wide[i, j - 2 * reach] = 1
    for b in range(across):
        last = -4 * reach - 4
        for i in range(rows):
            if wide[i, b]:
                last = i
            if i >= 2 * reach:
                clean[i - 2 * reach, b] = ZERO if i - last <= 2 * reach else ONE
    smooth(hard, _SOFT, soft, wrapped=False)
    soft[:] = np.minimum(soft, ONE)
    return True


@jit
def _errors(light: Real, data: Real, base: Number, clip: Number, response: _Response) -> None:
    """Error of what a row of light predicts, in place: ( data / (R + base) - 1 ) R'.

    Below the `response` the sensor records the light itself, above it `clip`. A logarithm and two
    exponentials for each pixel of a blown area would take ten times as long as all transforms.
    """
    bend, first, last = response
    brightest = ZERO
    for j in range(light.size):
        brightest = max(brightest, light[j])
    if brightest <= first * clip:  # no branch in the loop: several pixels at a time
        for j in range(light.size):
            light[j] = data[j] / max(max(light[j], ZERO) + base, _LEAST_PREDICTED * data[j], _TINY) - ONE
        return
    top = np.float32(bend.shape[1] - 1)
    share, steps = ONE / clip, top / (last - first)
    for j in range(light.size):
        predicted = max(light[j], ZERO)
        at = min((predicted * share - first) * steps, top)
        if not at > ZERO:  # a NaN stays one
            light[j] = data[j] / max(predicted + base, _LEAST_PREDICTED * data[j], _TINY) - ONE
        else:
            k = min(np.int32(at), np.int32(bend.shape[1] - 2))
            part = at - np.float32(k)
            recorded = clip * (bend[0, k] + part * (bend[0, k + 1] - bend[0, k]))
            slope = bend[1, k] + part * (bend[1, k + 1] - bend[1, k])
            light[j] = (data[j] / max(recorded + base, _LEAST_PREDICTED * data[j], _TINY) - ONE) * slope


@jit
def _measured_alpha(start: Real, work: Real, share: Real, change: Real) -> Number:
    """Measure alpha of Biggs and Andrews; `change` holds that of the step before, then that of this one."""
    rows, cols = start.shape
    norm = 0.0
    product = 0.0
    for i in range(rows):
        row_product, row_norm = np.float64(0.0), np.float64(0.0)
        for j in range(cols):
            light = max(start[i, j] * max(ONE + work[i, j] * share[i, j], ZERO), _TINY)
            now, before = light - start[i, j], change[i, j]
            row_product += now * before
            row_norm += before * before
            change[i, j] = now
        product += row_product
        norm += row_norm
    if not norm > 0.0:
        return ZERO
    return np.float32(min(max(product / norm, 0.0), 1.0))


@jit
def _steps(  # noqa: C901 - one pass over memory per loop
    latent: Real,
    data: Real,
    reach: Real,
    K: Complex,
    base: Number,
    clip: Number,
    response: _Response,
    alphas: Real,
    adaptive: bool,
    width: int,
    lights: bool,
) -> None:
    """Accelerated saturation-aware steps; `latent` is start and result.

    The transforms live on the grid of `K`, `width` columns wide; the latent plane lies in its
    first corner, the data in the middle of the latent plane. With `adaptive` the extrapolation of each
    step is measured on the changes of the two before it, and `alphas` only gives their number.
    """
    rows, cols = latent.shape
    high, wide = data.shape
    top, left = (rows - high) // 2, (cols - wide) // 2
    bottom, right = top + high, left + wide
    steps = alphas.shape[0]
    P = np.empty(K.shape, np.complex64)
    work = np.zeros((K.shape[0], width), np.float32)
    calm = np.zeros_like(work) if lights else work
    start = latent.copy()
    work[:rows, :cols] = latent
    share = ONE / reach
    clean = np.empty_like(data)
    soft = np.empty_like(latent)
    change = np.zeros_like(latent) if adaptive else soft
    for step in range(steps):
        through(work, P, K, FORWARD, 0, rows, top, bottom)
        for i in range(high):
            _errors(work[top + i, left:right], data[i], base, clip, response)
            work[top + i, :left] = ZERO
            work[top + i, right:] = ZERO
        split = lights and _lights(start, np.float32(_LIGHT) * clip, top, clean, soft)
        if split:
            for i in range(high):
                calm[top + i] = ZERO
                for j in range(wide):
                    calm[i + top, j + left] = work[i + top, j + left] * clean[i, j]
            through(calm, P, K, BACK, top, bottom, 0, rows)
        through(work, P, K, BACK, top, bottom, 0, rows)
        if split:
            for i in range(rows):
                for j in range(cols):
                    work[i, j] = calm[i, j] + (work[i, j] - calm[i, j]) * soft[i, j]
        alpha = alphas[step + 1] if step + 1 < steps else ZERO
        if adaptive:
            alpha = _measured_alpha(start, work, share, change)
        for i in range(rows):
            for j in range(cols):
                light = max(start[i, j] * max(ONE + work[i, j] * share[i, j], ZERO), _TINY)
                ahead = max(light + alpha * (light - latent[i, j]), _TINY)
                latent[i, j] = light
                start[i, j] = ahead
                work[i, j] = ahead
            work[i, cols:] = ZERO


Mask = NDArray[np.bool_]
Window = tuple[slice, slice]

LEAST_CLIPPED: Final = 0.98  # of the clipping level: demosaicing leaves clipped light a little below (chosen)
_LEAST_SEEN: Final = 0.02
"""Least share of a point's light to divide by (chosen: with less, noise makes lights of any strength)."""
_UNSEEN: Final = 1e-3  # of a point's light: below it is unknown (chosen: the kernel's far wings)
_SIGMAS: Final = np.float32(3.0)
"""Standard deviations by which glow may exceed the photo (chosen: with less, chance dims lights)."""
_ABSURD: Final = np.float32(2.0)
"""Times that bound beyond which the glow is no answer (chosen: steps that converge leave less)."""

_DARKEST: Final = 0.9  # share of the darkest light nearby that remains, times what a kernel spreads (chosen)
_DUBIOUS: Final = np.float32(0.25)
"""Share of the glow that may be scene light (chosen: 0 lets an error make a black ring)."""
_GLARE, _NO_GLARE = np.float32(0.5), np.float32(0.02)  # glow in the light: bound in full, and none (chosen)


@dataclass(frozen=True, slots=True, eq=False)
class Lights:
    """What shines beyond saturation in a tile."""

    # the tile without the glow; clipped pixels hold what the light below saturation makes of them
    rest: Planes
    beyond: Planes  # sharp light above the clipping level
    glow: Planes  # the same as the lens spreads it
    spread: Real  # (channels,), share of a point's light that falls beyond its neighbours

    @classmethod
    def of(
        cls, tile: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor], steps: int
    ) -> Lights | None:
        """Find the light above the clipping level of each colour; None where nothing is clipped.

        Only its glow on the pixels around it shows how bright a clipped light is. Richardson-Lucy steps
        estimate that, with clipped pixels as lower bounds, R and R' as in `SaturationAwareRichardsonLucy`,
        and divided by the share of a point's light that was measured::

            x <- x ( 1 + F^T e / F^T 1[y < t] ),     e = ( y / R(F x) - 1 ) R'(F x)

        Divided by F^T 1 instead, lights of which little was measured take several times the steps; those of
        which nothing was measured do use F^T 1, or they would grow without end. This is done only for lights
        that the lens may have spread (`compact`); broad clipped areas count as light at saturation. Positive
        and unregularised, x is a poor picture, so only what lies above t is taken from it.
        """
        if not any(
            plane.max() >= np.float32(sensor.clip) for plane, sensor in zip(tile, sensors, strict=True)
        ):
            return None
        rest, beyond, glow = tile.copy(), np.zeros_like(tile), np.zeros_like(tile)
        for c, (plane, blur, sensor) in enumerate(zip(tile, blurs, sensors, strict=True)):
            clipped = np.asarray(plane >= np.float32(sensor.clip))
            spread = positive(blur)
            for window, own in regions(compact(clipped, blur.spread), spread.reach):
                _estimate(window, own, plane, clipped, spread, sensor, steps, (rest[c], beyond[c], glow[c]))
            rest[c] -= np.where(clipped, np.float32(0.0), glow[c])
        return cls(rest, beyond, glow, np.array([_spread(blur) for blur in blurs], dtype=np.float32))

    def put_back(self, photo: Planes, restored: Planes) -> Planes:
        """Add the light to the restored rest.

        Where most of a pixel's light was glow, an error of the glow is large compared with the scene, and
        the more the lens spreads, the more of it comes back as a dark ring. So there the result stays above
        a share of the darkest light nearby.
        """
        if not self.glow.any():
            return np.asarray(restored + self.beyond, dtype=np.float32)
        near = ndimage.maximum_filter(self.glow, (1, 5, 5), mode="nearest")
        scene = np.maximum(self.rest, np.float32(0.0)) + _DUBIOUS * self.glow
        darkest = ndimage.minimum_filter(scene, (1, 5, 5), mode="nearest")
        glare = np.minimum(near / (_GLARE * np.maximum(photo, np.float32(1e-6))), np.float32(1.0))
        depth = (np.float32(_DARKEST) * self.spread)[:, None, None]
        held = np.where(glare > _NO_GLARE, np.maximum(restored, depth * glare * darkest), restored)
        return np.asarray(held + self.beyond, dtype=np.float32)


def regions(lights: Mask, reach: int) -> list[tuple[Window, Mask]]:
    """Windows of a tile to estimate lights in, each with the light that it alone does, `reach` wider."""
    if not lights.any():
        return []
    near = ndimage.maximum_filter(np.pad(lights, reach), 2 * reach + 1)
    labels, count = ndimage.label(near)
    found = []
    for number, box in enumerate(ndimage.find_objects(labels, count), start=1):
        window = tuple(
            slice(max(part.start - 2 * reach, 0), min(part.stop, extent))
            for part, extent in zip(box, lights.shape, strict=True)
        )
        wide = tuple(slice(part.start, part.stop + 2 * reach) for part in window)
        found.append(((window[0], window[1]), np.asarray(labels[wide] == number)))
    return found


def compact(clipped: Mask, reach: int) -> Mask:
    """Clipped pixels of areas that a lamp may have made through a kernel of this reach.

    An area with a clipped pixel further than the reach from all measured ones is broad: nothing shows how
    bright it is inside.
    """
    if not clipped.any():
        return clipped
    # demosaicing leaves pixels between clipped ones hardly below saturation
    closed = ndimage.binary_closing(np.pad(clipped, 1), np.ones((3, 3)))[1:-1, 1:-1] | clipped
    depth = ndimage.distance_transform_cdt(np.pad(closed, 1), "chessboard")[1:-1, 1:-1]
    labels, count = ndimage.label(closed, structure=np.ones((3, 3), dtype=np.int8))
    broad = np.zeros(count + 1, dtype=np.bool_)
    broad[0] = True
    broad[labels[depth > reach]] = True
    return np.asarray(clipped & ~broad[labels])


def positive(blur: UniformBlur) -> UniformBlur:
    """The same blur, its shift in a kernel without negative lobes, behind which the steps would run away."""
    if blur.offset == (0.0, 0.0):
        return blur
    wide = blur.reach - blur.kernel.shape[0] // 2
    moved = ndimage.shift(np.pad(blur.kernel, wide), blur.offset, order=1)
    return UniformBlur(as_kernel(np.maximum(moved, 0.0)))


def _spread(blur: UniformBlur) -> float:
    """Share of a kernel outside its middle 3 x 3 pixels."""
    middle = blur.kernel.shape[0] // 2
    near = slice(max(middle - 1, 0), middle + 2)
    return 1.0 - float(blur.kernel[near, near].sum())


def _estimate(
    window: Window,
    own: Mask,
    plane: Real,
    clipped: Mask,
    blur: UniformBlur,
    sensor: Sensor,
    steps: int,
    into: tuple[Real, Real, Real],
) -> None:
    """Estimate the light of one region of one colour; update `into`: rest, light beyond saturation, glow."""
    rest, beyond, glow = into
    data, lost = np.ascontiguousarray(plane[window]), clipped[window]
    latent, reach = first_guess(data, blur)
    measured = np.minimum(blur.adjoint((~lost).astype(np.float32)), reach)
    full = float(reach.max())
    measured = np.where(
        measured < _UNSEEN * full, reach, np.maximum(measured, np.float32(_LEAST_SEEN * full))
    )
    latent = richardson_lucy_steps(latent, data, measured, blur, sensor, steps=steps)
    below = np.minimum(latent, np.float32(sensor.clip))
    excess = np.where(own, latent - below, np.float32(0.0))
    bound = np.maximum(data, np.float32(0.0)) + _SIGMAS * np.sqrt(sensor.variance(data))
    excess, spread = _believable(excess, np.where(lost, np.float32(np.inf), bound), blur)
    glow[window] += spread
    beyond[window] += blur.frame(excess)
    answered = lost & np.asarray(blur.frame(own.astype(np.float32)), dtype=np.bool_)
    rest[window][answered] = np.maximum(blur.forward(below), np.float32(0.0))[answered]


def _believable(excess: Real, bound: Real, blur: UniformBlur) -> tuple[Real, Real]:
    """Return the estimated light and its glow, dimmed where steps ran away; none if that fails."""
    glow = blur.forward(excess)
    absurd = ~(np.abs(glow) <= _ABSURD * bound)
    if absurd.any():
        share = np.where(absurd, bound / np.where(absurd, np.abs(glow), np.float32(1.0)), np.float32(1.0))
        excess = excess * ndimage.minimum_filter(np.pad(share, blur.reach, mode="edge"), 2 * blur.reach + 1)
        glow = blur.forward(excess)
        if not (np.abs(glow) <= _ABSURD * bound).all():
            return np.zeros_like(excess), np.zeros_like(glow)
    return excess, glow


_DEPTH, _MORE = 4, 8  # reaches of the blur, and pixels: strip that predicts what lies beyond a side (chosen)


def fill_canvas(
    canvas: Canvas,
    tile: Planes,
    light: Real,
    K: Complex,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    steps: int,
) -> Planes:
    """Place a tile, none of it beyond saturation and divided by the `light` of each colour, on its canvas.

    What lies beyond the sides of the frame does not fade. A mirror image of the frame is a poor guess of
    that: its errors come back as ripples inside, stronger the less noise there is. `steps` of Richardson-Lucy
    on a strip of the data estimate the light on both sides of the border, each point divided by the share of
    its light that was measured; that light, blurred by K, is what a larger sensor would have recorded.
    """
    y = canvas.filled(tile, light)
    if all(sensor.surrounded for sensor in sensors):
        return y
    outside = np.ones(canvas.shape, dtype=np.bool_)
    outside[canvas.data] = False
    for c, (plane, blur, sensor) in enumerate(zip(tile, blurs, sensors, strict=True)):
        if blur.reach == 0:
            continue
        latent = _extended(plane, blur, sensor, steps)
        recorded = canvas.filled(latent[None], light[c : c + 1], blur.reach)[0]
        through(recorded, np.empty_like(K[c]), K[c], True, 0, len(recorded), 0, len(recorded))
        np.copyto(y[c], recorded, where=outside)
    return y


def _extended(
    plane: NDArray[np.float32], blur: UniformBlur, sensor: Sensor, steps: int
) -> NDArray[np.float32]:
    """The data, extended by the reach; at the sides of the frame they are replaced by the latent light."""
    wide = blur.reach
    depth, both = _DEPTH * wide + _MORE, 2 * wide
    wider = np.pad(plane, wide, mode="symmetric" if wide <= min(plane.shape) else "edge")
    unclipped = replace(sensor, clip=float("inf"), measured=None)

    def light_of(part: NDArray[np.float32]) -> NDArray[np.float32]:
        part = np.ascontiguousarray(part)
        latent, reach = first_guess(part, blur)
        return richardson_lucy_steps(latent, part, reach, blur, unclipped, steps=steps)

    top, bottom, left, right = sensor.edges
    if left:
        wider[:, :both] = light_of(plane[:, :depth])[:, :both]
    if right:
        wider[:, -both:] = light_of(plane[:, -depth:])[:, -both:]
    if top:
        wider[:both] = light_of(plane[:depth])[:both]
    if bottom:
        wider[-both:] = light_of(plane[-depth:])[-both:]
    return wider
