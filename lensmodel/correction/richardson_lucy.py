"""Richardson-Lucy: accelerated, aware of clipped pixels; and the light of these that such steps find."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, Literal, TypeAlias, get_args

import numpy as np
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
    Mask,
    Number,
    Real,
    UniformBlur,
    Window,
    fast_shape,
    smooth,
    through,
)
from lensmodel.correction.deconvolver import Sensor

Acceleration: TypeAlias = Literal["fixed", "adaptive", "none"]
"""How far the estimate is extrapolated before a step, see `SaturationAwareRichardsonLucy`."""

_ACCELERATIONS: Final = get_args(Acceleration)
_ALPHA_MAX: Final = 0.9  # of the fixed extrapolation; above it the noise is accelerated as well
_REACH_FLOOR: Final = 0.05
"""Share of the largest F^T 1, the least to divide by (chosen: less lets noise explode, more darkens rims)."""
_LIGHT: Final = 0.9
"""Share of the clipping level above which a sharp pixel is a light: blur dims its rim a little (chosen)."""
_TINY: Final = np.float32(1e-6)  # saturations: least light to divide by (chosen: far below noise)
_LEAST_PREDICTED: Final = np.float32(0.1)  # of the datum: a step raises light tenfold at most (chosen)
_SOFT: Final = special.softmax(-(np.arange(-10, 11) ** 2) / 18.0).astype(np.float32)
"""Weights that soften the places of lights: a Gaussian of 3 pixels (chosen)."""
_STEEP: Final = np.exp(-4.0 * np.arange(-3, 4) ** 2).astype(np.float32)
"""A Gaussian so narrow that all light further than 3 pixels sums up to less than a pixel at that distance."""

_SHARPNESS: Final = 50.0  # a of the sensor response: it bends over a tenth of the clipping level (chosen)
_OVER: Final = np.linspace(-15.0, 25.0, 4097)  # a (z - t): to a millionth, R is z below and t above
_BEND: Final = np.stack(
    [1.0 + (_OVER - np.logaddexp(0.0, _OVER)) / _SHARPNESS, special.expit(-_OVER)], dtype=np.float32
)
"""R and R' there, over the clipping level: a logarithm and two exponentials for each pixel of a blown area
would take ten times as long as all transforms."""
_FIRST, _PER_LIGHT = np.float32(1.0 - 15.0 / _SHARPNESS), np.float32(_SHARPNESS * 4096 / 40.0)


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

    Light whose Poisson noise equals the read noise is added to the data and makes that noise nearly Poisson
    (D. L. Snyder et al., J. Opt. Soc. Am. A 12, 272-283, 1995); without it the dark parts diverge.
    """
    noise, clip = sensor.noise, np.float32(sensor.clip)
    base = np.float32(min(noise.read / noise.shot, 1.0) if noise.shot > 0.0 else 0.0)
    data: Plane = np.ascontiguousarray(np.maximum(blurred, 0.0) + base, dtype=np.float32)
    shape, (rows, cols), (high, wide) = fast_shape(latent.shape), latent.shape, data.shape
    top, left = (rows - high) // 2, (cols - wide) // 2
    K = blur.spectrum(shape)
    P, work, calm = np.empty_like(K), np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    inside, update = work[top : top + high], work[:rows, :cols]
    update[:] = latent
    latent, start = update.copy(), update.copy()
    share = (ONE / reach).astype(np.float32)
    change = np.zeros_like(latent)
    for step in range(1, steps + 1):
        through(work, P, K, FORWARD, 0, rows, top, top + high)
        _errors(inside, left, data, base, clip)
        found = _lights(start, np.float32(_LIGHT) * clip, top) if lights else None
        if found is not None:
            clean, soft = found
            calm[top : top + high] = inside
            calm[top : top + high, left : left + wide] *= clean
            through(calm, P, K, BACK, top, top + high, 0, rows)
        through(work, P, K, BACK, top, top + high, 0, rows)
        if found is not None:
            most = calm[:rows, :cols]
            update[:] = most + (update - most) * soft
        alpha = min(step / (step + 3), _ALPHA_MAX) if acceleration == "fixed" and step < steps else 0.0
        if acceleration == "adaptive":
            before = change
            change = np.maximum(start * np.maximum(ONE + update * share, ZERO), _TINY) - start
            norm = float(np.square(before).sum(dtype=np.float64))
            product = float((change * before).sum(dtype=np.float64))
            alpha = min(max(product / norm, 0.0), 1.0) if norm > 0.0 else 0.0
        _advance(start, latent, work, share, np.float32(alpha))
    return latent


def _lights(latent: Real, level: Number, reach: int) -> tuple[Mask, Real] | None:
    """Which data bright sharp pixels do not reach, and their own places softly; None where there are none."""
    bright = latent >= level
    if not bright.any():
        return None
    hard = (smooth(bright.astype(np.float32), _STEEP) > np.float32(math.exp(-37.0))).astype(np.float32)
    # a square of the operator's reach covers the kernel without knowing its shape
    near = smooth(hard, np.ones(2 * reach + 1, dtype=np.float32))
    rows, cols = latent.shape
    clean = near[reach : rows - reach, reach : cols - reach] == ZERO
    return clean, np.minimum(smooth(hard, _SOFT), ONE)


@jit
def _errors(light: Real, left: int, data: Real, base: Number, clip: Number) -> None:
    """Error of what rows of light predict, in place: ( data / (R + base) - 1 ) R'; zero beside the data."""
    rows, cols = data.shape
    recorded, slope = np.empty(cols, np.float32), np.empty(cols, np.float32)
    share, last = ONE / clip, np.float32(_BEND.shape[1] - 1)
    for i in range(rows):
        row = light[i, left : left + cols]
        brightest = ZERO
        for j in range(cols):
            recorded[j] = max(row[j], ZERO)
            slope[j] = ONE
            brightest = max(brightest, row[j])
        if brightest > _FIRST * clip:
            for j in range(cols):
                at = min((recorded[j] * share - _FIRST) * _PER_LIGHT, last)
                if at > ZERO:  # a NaN stays one
                    k = min(np.int32(at), np.int32(_BEND.shape[1] - 2))
                    part = at - np.float32(k)
                    recorded[j] = clip * (_BEND[0, k] + part * (_BEND[0, k + 1] - _BEND[0, k]))
                    slope[j] = _BEND[1, k] + part * (_BEND[1, k + 1] - _BEND[1, k])
        light[i] = ZERO
        for j in range(cols):
            predicted = max(recorded[j] + base, _LEAST_PREDICTED * data[i, j], _TINY)
            row[j] = (data[i, j] / predicted - ONE) * slope[j]


@jit
def _advance(start: Real, latent: Real, work: Real, share: Real, alpha: Number) -> None:
    """Make the step from `start` to `latent`, and extrapolate by `alpha` for the next one, on `work` too."""
    rows, cols = latent.shape
    for i in range(rows):
        for j in range(cols):
            light = max(start[i, j] * max(ONE + work[i, j] * share[i, j], ZERO), _TINY)
            start[i, j] = max(light + alpha * (light - latent[i, j]), _TINY)
            latent[i, j] = light
            work[i, j] = start[i, j]
        work[i, cols:] = ZERO


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
        colours = list(zip(tile, blurs, sensors, strict=True))
        if not any(plane.max() >= np.float32(sensor.clip) for plane, _, sensor in colours):
            return None
        rest, beyond, glow = np.stack([_estimated(*colour, steps) for colour in colours], axis=1)
        near = [slice(max(blur.kernel.shape[0] // 2 - 1, 0), blur.kernel.shape[0] // 2 + 2) for blur in blurs]
        spread = [1.0 - blur.kernel[part, part].sum() for blur, part in zip(blurs, near, strict=True)]
        return cls(rest, beyond, glow, np.array(spread, dtype=np.float32))

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
    dilated = ndimage.maximum_filter(np.pad(clipped, 1), 3)
    closed = ndimage.minimum_filter(dilated, 3)[1:-1, 1:-1] | clipped
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


def _estimated(plane: Real, blur: UniformBlur, sensor: Sensor, steps: int) -> tuple[Real, Real, Real]:
    """One colour of `Lights`: rest, light beyond saturation, glow."""
    rest, beyond, glow, spread = plane.copy(), np.zeros_like(plane), np.zeros_like(plane), positive(blur)
    clip, zero = np.float32(sensor.clip), np.float32(0.0)
    clipped = np.asarray(plane >= clip)
    for window, own in regions(compact(clipped, blur.spread), spread.reach):
        data, lost = np.ascontiguousarray(plane[window]), clipped[window]
        latent, reach = first_guess(data, spread)
        measured = np.minimum(spread.adjoint((~lost).astype(np.float32)), reach)
        full = reach.max()
        measured = np.where(measured < _UNSEEN * full, reach, np.maximum(measured, _LEAST_SEEN * full))
        latent = richardson_lucy_steps(latent, data, measured, spread, sensor, steps)
        below = np.minimum(latent, clip)
        excess = np.where(own, latent - below, zero)
        shown = spread.forward(excess)
        bound = np.maximum(data, zero) + _SIGMAS * np.sqrt(sensor.variance(data))
        if not (np.abs(shown) <= np.where(lost, np.float32(np.inf), _ABSURD * bound)).all():
            continue  # the steps ran away: it counts as light at saturation
        glow[window] += shown
        beyond[window] += spread.frame(excess)
        answered = lost & (spread.frame(own.astype(np.float32)) > zero)
        rest[window][answered] = np.maximum(spread.forward(below), zero)[answered]
    return rest - np.where(clipped, zero, glow), beyond, glow


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


def _extended(plane: Real, blur: UniformBlur, sensor: Sensor, steps: int) -> Real:
    """The data, extended by the reach; at the sides of the frame they are replaced by the latent light."""
    wide = blur.reach
    depth = _DEPTH * wide + _MORE
    wider = np.pad(plane, wide, mode="symmetric" if wide <= min(plane.shape) else "edge")
    unclipped = replace(sensor, clip=float("inf"), measured=None)
    top, bottom, left, right = sensor.edges
    # quarter turns that lead each side to the top
    for turn, is_border in ((3, left), (1, right), (0, top), (2, bottom)):
        if is_border:
            part = np.ascontiguousarray(np.rot90(np.rot90(plane, turn)[:depth], -turn))
            latent, reach = first_guess(part, blur)
            light = richardson_lucy_steps(latent, part, reach, blur, unclipped, steps)
            np.rot90(wider, turn)[: 2 * wide] = np.rot90(light, turn)[: 2 * wide]
    return wider
