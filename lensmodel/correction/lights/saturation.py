"""Light beyond saturation: how much there is, and the photo as it would be without it."""

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
from lensmodel.correction.blur.compiled_uniform import CompiledBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.engine import Engine, compiled
from lensmodel.correction.lights.clipped import ClippedRegion, regions, span_around
from lensmodel.correction.methods.richardson_lucy import climbed, first_guess

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
_ENERGY: Final = 0.98
"""Share of a kernel's light within its reach: of a light at saturation, a fiftieth falls further out and is
hardly seen (chosen)."""
_DARKEST: Final = 0.9
"""Least share of the darkest light nearby that remains, times what a kernel spreads (chosen: 1 would allow no
dark detail in a glow at all, much less the dark ring that it is there to prevent)."""
_DUBIOUS: Final = np.float32(0.25)
"""Share of the glow that may be scene light instead (chosen: 0 lets an error of the glow make a black ring, 1
would leave all glow in place)."""
_GLARE: Final = np.float32(0.5)
"""Share of glow in the photo's light at and above which the bound holds in full (chosen: from there on more
of a pixel is subtracted than is left)."""
_NO_GLARE: Final = np.float32(0.02)  # of `_GLARE`: less is rounding errors of transforms


@dataclass(frozen=True, slots=True, eq=False)
class Lights:
    """What shines beyond saturation in a tile.

    Parameters
    ----------
    rest : Planes
        The tile without the glow; clipped pixels hold what the light below saturation makes of them.
    beyond : Planes
        Sharp light above the clipping level.
    glow : Planes
        The same as the lens spreads it.
    spread : ndarray, shape (channels,)
        Share of a point's light that falls beyond its neighbours.
    """

    rest: Planes
    beyond: Planes
    glow: Planes
    spread: NDArray[np.float32]

    @classmethod
    def of(
        cls,
        tile: Planes,
        blurs: Sequence[UniformBlur],
        sensors: Sequence[Sensor],
        steps: int,
        engine: Engine,
    ) -> Lights | None:
        """Find the light above the clipping level of each colour; None where nothing is clipped.

        Only its glow on the pixels around it shows how bright a clipped light is. Richardson-Lucy steps
        estimate that, with clipped pixels as lower bounds, R and R' as in `SaturationAwareRichardsonLucy`,
        and divided by the share of a point's light that was measured::

            x <- x ( 1 + F^T e / F^T 1[y < t] ),     e = ( y / R(F x) - 1 ) R'(F x)

        Divided by F^T 1 instead, lights of which little was measured take several times the steps; those of
        which nothing was measured do use F^T 1, or they would grow without end. This is done only for lights
        that the lens may have spread (`compact`), around clipped pixels near measured ones
        (`lensmodel.correction.lights.clipped.regions`). Broad clipped areas count as light at saturation.
        Positive and unregularised, x is a poor picture, so only what lies above t is taken from it.
        """
        if not any(
            plane.max() >= np.float32(sensor.clip) for plane, sensor in zip(tile, sensors, strict=True)
        ):
            return None
        rest, beyond, glow = tile.copy(), np.zeros_like(tile), np.zeros_like(tile)
        loops = compiled(engine)
        for c, (plane, blur, sensor) in enumerate(zip(tile, blurs, sensors, strict=True)):
            clipped = blown(plane, sensor)
            quick = CompiledBlur.of(positive(blur), loops)
            for region in regions(compact(clipped, far(blur)), blur.reach):
                _estimate(region, plane, clipped, quick, sensor, steps, engine, (rest[c], beyond[c], glow[c]))
            rest[c] -= np.where(clipped, np.float32(0.0), glow[c])
        return cls(rest, beyond, glow, np.array([_spread(blur) for blur in blurs], dtype=np.float32))

    def put_back(self, photo: Planes, restored: Planes) -> Planes:
        """Add the light to the restored rest.

        Where most of a pixel's light was glow, an error of the glow is large compared with the scene, and
        the more the lens spreads, the more of it comes back as a dark ring. So there the result stays above
        a share of the darkest light nearby.
        """
        result = restored + self.beyond
        shining: NDArray[np.bool_] = np.asarray(self.glow.any(axis=0))
        if not shining.any():
            return np.asarray(result, dtype=np.float32)
        # No more of the tile than the filters of 5 pixels need.
        rows, cols = (span_around(shining, axis, 4) for axis in (0, 1))
        box = (slice(None), rows, cols)
        glow = self.glow[box]
        near = ndimage.maximum_filter(glow, (1, 5, 5), mode="nearest")
        scene = np.maximum(self.rest[box], np.float32(0.0)) + _DUBIOUS * glow
        darkest = ndimage.minimum_filter(scene, (1, 5, 5), mode="nearest")
        glare = np.minimum(near / (_GLARE * np.maximum(photo[box], np.float32(1e-6))), np.float32(1.0))
        depth = (np.float32(_DARKEST) * self.spread)[:, None, None]
        held = np.maximum(restored[box], depth * glare * darkest)
        result[box] = np.where(glare > _NO_GLARE, held, restored[box]) + self.beyond[box]
        return np.asarray(result, dtype=np.float32)


def blown(plane: NDArray[np.float32], sensor: Sensor) -> NDArray[np.bool_]:
    """Pixels of which only a lower bound is known."""
    return np.asarray(plane >= np.float32(sensor.clip))


def compact(clipped: NDArray[np.bool_], reach: int) -> NDArray[np.bool_]:
    """Clipped pixels of areas that a lamp may have made through a kernel of this reach.

    An area with a clipped pixel further than the reach from all measured ones is broad: nothing shows how
    bright it is inside.
    """
    if not clipped.any():
        return clipped
    known = clipped
    clipped = closed(clipped)
    depth = ndimage.distance_transform_cdt(np.pad(clipped, 1), "chessboard")[1:-1, 1:-1]
    labels, count = ndimage.label(clipped, structure=np.ones((3, 3), dtype=np.int8))
    deepest = ndimage.maximum(depth, labels, np.arange(count + 1))
    broad = np.asarray(deepest) > reach
    broad[0] = True
    return np.asarray(known & ~broad[labels])


def closed(clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Clipped pixels and those between them, which demosaicing left hardly below saturation."""
    return np.asarray(ndimage.binary_closing(np.pad(clipped, 1), np.ones((3, 3)))[1:-1, 1:-1] | clipped)


def far(blur: UniformBlur) -> int:
    """Radius in pixels that holds nearly all light of a kernel and its shift, and a pixel more."""
    half = blur.kernel.shape[0] // 2
    rows, cols = np.mgrid[-half : half + 1, -half : half + 1]
    light = np.bincount(np.maximum(np.abs(rows), np.abs(cols)).ravel(), blur.kernel.ravel()).cumsum()
    inner = int(np.searchsorted(light, _ENERGY * light[-1]))
    return max(inner, 1) + int(np.ceil(max(abs(blur.offset[0]), abs(blur.offset[1])))) + 1


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
    region: ClippedRegion,
    plane: NDArray[np.float32],
    clipped: NDArray[np.bool_],
    blur: UniformBlur,
    sensor: Sensor,
    steps: int,
    engine: Engine,
    into: tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]],
) -> None:
    """Estimate the light of one region of one colour; update `into`: rest, light beyond saturation, glow."""
    rest, beyond, glow = into
    window = region.data
    data, lost = plane[window], clipped[window]
    latent, reach = first_guess(data, blur)
    measured = np.minimum(blur.adjoint((~lost).astype(np.float32)), reach)
    full = float(reach.max())
    measured = np.where(
        measured < _UNSEEN * full, reach, np.maximum(measured, np.float32(_LEAST_SEEN * full))
    )
    latent = climbed(latent, data, measured, blur, sensor, steps=steps, engine=engine)
    clip = np.float32(sensor.clip)
    below_clip = np.minimum(latent, clip)
    # Light too far off to reach a clipped pixel, or nearer to those of another region, is ignored.
    excess = np.zeros_like(latent)
    excess[region.own] = (latent - below_clip)[region.own]
    bound = np.maximum(data, np.float32(0.0)) + _SIGMAS * np.sqrt(sensor.variance(data))
    excess, region_glow = _believable(excess, np.where(lost, np.float32(np.inf), bound), blur)
    glow[window] += region_glow
    beyond[window] += blur.frame(excess)
    own_clipped = np.zeros_like(lost)
    own_clipped[region.answers] = lost[region.answers]
    rest[window][own_clipped] = np.maximum(blur.forward(below_clip), np.float32(0.0))[own_clipped]


def _believable(
    excess: NDArray[np.float32], bound: NDArray[np.float32], blur: UniformBlur
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the estimated light and its glow, dimmed where the glow far exceeds a bound.

    If it still does then, both are zero. Steps may run away: just below clipping the response
    hardly rises, and the transfer function of next to no blur, moved by a part of a pixel, belongs to no
    positive kernel.
    """

    def absurd(glow: NDArray[np.float32]) -> NDArray[np.bool_]:
        return np.asarray(~(np.abs(glow) <= _ABSURD * bound))

    glow = blur.forward(excess)
    too_much = absurd(glow)
    if not too_much.any():
        return excess, glow
    share = np.where(too_much, bound / np.where(too_much, np.abs(glow), np.float32(1.0)), np.float32(1.0))
    excess = excess * ndimage.minimum_filter(np.pad(share, blur.reach, mode="edge"), 2 * blur.reach + 1)
    glow = blur.forward(excess)
    return (np.zeros_like(excess), np.zeros_like(glow)) if absurd(glow).any() else (excess, glow)
