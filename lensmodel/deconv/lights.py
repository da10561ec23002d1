"""Light beyond saturation: how much of it there is, and the photo as it would be without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.blur import UniformBlur
from lensmodel.deconv.base import Sensor
from lensmodel.deconv.engine import Engine
from lensmodel.deconv.richardson_lucy import climbed, first_guess
from lensmodel.types import Planes

_SHARPNESS: Final = 50.0  # of the sensor's bend at the clipping level, as in SaturationAwareRichardsonLucy
_LEAST_SEEN: Final = 0.02  # share of a point's light that counts as measured where less of it is
_DARKEST: Final = 0.9  # times what a kernel spreads: share of the darkest light nearby that must be left
_DOUBT: Final = np.float32(0.25)  # share of the glow that may be none
_GLARE: Final = np.float32(0.5)  # share of glow in the photo's light from which on the bound holds in full
_NO_GLARE: Final = np.float32(0.02)  # of that: rounding errors of transforms are no glow


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

        How bright a clipped light is, only its glow on the pixels around it tells. Richardson-Lucy
        steps find out, with clipped pixels as lower bounds, R and R' as in
        `SaturationAwareRichardsonLucy`, and divided by what of a point's light was measured::

            x <- x ( 1 + F^T e / F^T 1[y < t] ),     e = ( y / R(F x) - 1 ) R'(F x)

        Divided by F^T 1 instead, lights of which little is measured take several times the steps.
        Positive and unrestrained, x is a poor picture, so only what lies above t is taken from it.
        """
        if not any(
            plane.max() >= np.float32(sensor.clip) for plane, sensor in zip(tile, sensors, strict=True)
        ):
            return None
        clips = [blown(plane, sensor) for plane, sensor in zip(tile, sensors, strict=True)]
        rest, beyond, glow = tile.copy(), np.zeros_like(tile), np.zeros_like(tile)
        for c, (clipped, blur, sensor) in enumerate(zip(clips, blurs, sensors, strict=True)):
            if clipped.any():
                rows, cols = (_around(clipped, axis, 2 * blur.reach) for axis in (0, 1))
                here = (c, rows, cols)
                rest[here], beyond[here], glow[here] = _split(
                    tile[here], clipped[rows, cols], blur, sensor, steps, engine
                )
        return cls(rest, beyond, glow, np.array([_spread(blur) for blur in blurs], dtype=np.float32))

    def put_back(self, photo: Planes, restored: Planes) -> Planes:
        """Add the light to what was made of the rest.

        Where most of what a pixel got was glow, an error of it is large beside the scene, and the more
        the lens spreads the more of it comes back as a dark ring. So the result stays above a share of
        the darkest light nearby there.
        """
        near = ndimage.maximum_filter(self.glow, (1, 5, 5), mode="nearest")
        likely = np.maximum(self.rest, np.float32(0.0)) + _DOUBT * self.glow
        darkest = ndimage.minimum_filter(likely, (1, 5, 5), mode="nearest")
        glare = np.minimum(near / (_GLARE * np.maximum(photo, np.float32(1e-6))), np.float32(1.0))
        depth = (np.float32(_DARKEST) * self.spread)[:, None, None]
        held = np.maximum(restored, depth * glare * darkest)
        return np.asarray(np.where(glare > _NO_GLARE, held, restored) + self.beyond, dtype=np.float32)


def blown(plane: NDArray[np.float32], sensor: Sensor) -> NDArray[np.bool_]:
    """Pixels of which only a lower bound is known."""
    return np.asarray(plane >= np.float32(sensor.clip))


def _spread(blur: UniformBlur) -> float:
    """Share of a kernel outside its middle 3 x 3 pixels."""
    middle = blur.kernel.shape[0] // 2
    near = slice(max(middle - 1, 0), middle + 2)
    return 1.0 - float(blur.kernel[near, near].sum())


def _around(marked: NDArray[np.bool_], axis: int, reach: int) -> slice:
    """From `reach` before the first mark along an axis to `reach` after the last."""
    at = np.flatnonzero(marked.any(axis=1 - axis))
    return slice(max(int(at[0]) - reach, 0), int(at[-1]) + reach + 1)


def _split(
    plane: NDArray[np.float32],
    clipped: NDArray[np.bool_],
    blur: UniformBlur,
    sensor: Sensor,
    steps: int,
    engine: Engine,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """Rest, light beyond saturation and its glow, of one colour."""
    latent, reach = first_guess(plane, blur)
    seen = np.minimum(blur.adjoint((~clipped).astype(np.float32)), reach)
    seen = np.maximum(seen, np.float32(_LEAST_SEEN * float(reach.max())))
    latent = climbed(
        latent,
        plane,
        seen,
        blur,
        sensor,
        steps=steps,
        sharpness=_SHARPNESS,
        engine=engine,
    )
    beyond = np.maximum(latent - np.float32(sensor.clip), 0.0)
    # What shines too far off to reach a clipped pixel is no concern of the tile's other side.
    for axis in (0, 1):
        marked = np.flatnonzero(clipped.any(axis=1 - axis))
        lines = np.moveaxis(beyond, axis, 0)
        lines[: int(marked[0])] = 0.0
        lines[int(marked[-1]) + 2 * blur.reach + 1 :] = 0.0
    glow = blur.forward(beyond)
    filled = np.where(clipped, np.maximum(blur.forward(latent), 0.0), plane)
    return filled - glow, np.ascontiguousarray(blur.frame(beyond)), glow
