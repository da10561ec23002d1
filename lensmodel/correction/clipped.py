"""Clipped light: how much of it there was, and the photo as it would be without it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.psf import as_kernel
from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.methods.richardson_lucy import first_guess, richardson_lucy_steps

Real = NDArray[np.float32]
Mask = NDArray[np.bool_]
Window = tuple[slice, slice]

LEAST_CLIPPED: Final = 0.98
"""Share of the clipping level from which light may have clipped: demosaicing leaves it a little below, and
sensors do not clip at one level (chosen)."""
_LEAST_SEEN: Final = 0.02
"""Least share of a point's light that counts as measured (chosen: a step divides by it, so that with less a
few pixels of noise would make a light of any strength; with more, broad lights would come up too slowly)."""
_UNSEEN: Final = 1e-3
"""Share of a point's light below which it is unknown (chosen: no more than the kernel's far wings, which are
known no better)."""
_SIGMAS: Final = np.float32(3.0)
"""Standard deviations of noise by which glow may exceed the photo (chosen: noise alone exceeds it in one
pixel of 700; with less, chance would dim the lights; with more, their glow would leave holes)."""
_ABSURD: Final = np.float32(2.0)
"""Times that bound beyond which the glow is no answer (chosen: steps that converge leave less)."""

_DARKEST: Final = 0.9
"""Least share of the darkest light nearby that remains, times what a kernel spreads (chosen: 1 would allow no
dark detail in a glow at all, much less the dark ring that it is there to prevent)."""
_DUBIOUS: Final = np.float32(0.25)
"""Share of the glow that may be scene light instead (chosen: 0 lets an error of the glow make a black ring, 1
would leave all glow in place)."""
_GLARE, _NO_GLARE = np.float32(0.5), np.float32(0.02)
"""Share of glow in the photo's light at and above which the bound holds in full (chosen: from there on more
of a pixel is subtracted than is left), and share of that below which it is rounding errors of transforms."""


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
    """Windows of a tile in which lights are estimated together.

    Each is the data to use, and the light that only this window estimates, `reach` wider on each side.
    """
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
    """The same blur, its shift by parts of a pixel in the kernel, so that no light becomes negative.

    A shift that acts as a phase belongs to a kernel with negative lobes, behind which Richardson-Lucy steps
    run away.
    """
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
    """Return the estimated light and its glow, dimmed where the glow far exceeds a bound; none if that fails.

    Steps may run away: just below clipping the response hardly rises.
    """
    glow = blur.forward(excess)
    absurd = ~(np.abs(glow) <= _ABSURD * bound)
    if absurd.any():
        share = np.where(absurd, bound / np.where(absurd, np.abs(glow), np.float32(1.0)), np.float32(1.0))
        excess = excess * ndimage.minimum_filter(np.pad(share, blur.reach, mode="edge"), 2 * blur.reach + 1)
        glow = blur.forward(excess)
        if not (np.abs(glow) <= _ABSURD * bound).all():
            return np.zeros_like(excess), np.zeros_like(glow)
    return excess, glow
