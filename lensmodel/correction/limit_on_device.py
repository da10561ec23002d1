"""The limit on another device, for tiles without clipped light; `limit` has it compiled, and says what it is.

Both share these numbers, and differ by the rounding of single precision.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lensmodel.correction.devices import Array, Device
from lensmodel.correction.limit import (
    COLOURLESS,
    EDGE_SHARE,
    HUE_REACH,
    LEVEL,
    LINE_SHARE,
    OWN_COLOURLESS,
    PURER,
    REACH,
    TINY,
)


def held_on_device(
    device: Device,
    photo: NDArray[np.float32],
    made: NDArray[np.float32],
    free: NDArray[np.bool_],
    wide: int,
    shares: tuple[float, float],
    darkest: float,
    dark: float,
    known: float,
) -> NDArray[np.float32]:
    """Hold light, but where it is `free`, and colour of a result; see `limit.limited`."""
    xp, y, x = device.xp, device.send(photo), device.send(made)
    light = xp.mean(y, axis=0)
    seen = xp.sqrt(xp.clip(light, 0.0, None))
    least, most = _around(xp, xp.minimum, seen, REACH), _around(xp, xp.maximum, seen, REACH)
    x = _light_held(xp, y, x, light, (least, most), device.send(free), wide, shares, darkest)
    return device.fetch(_colour_held(xp, y, x, _around(xp, xp.maximum, most, HUE_REACH - REACH), dark, known))


def _light_held(
    xp: Any,  # noqa: ANN401 - a module of functions
    y: Array,
    x: Array,
    light: Array,
    near: tuple[Array, Array],
    free: Array,
    wide: int,
    shares: tuple[float, float],
    darkest: float,
) -> Array:
    (least, most), (room, edge) = near, shares
    bottom, top, below, above = _levels(xp, light, wide)
    now = xp.sqrt(xp.sum(xp.clip(x, 0.0, None), axis=0) / 3.0)
    line = room * (most - least)
    at_edge = xp.minimum(edge * (top - bottom), line) - line
    up, down = line + above * at_edge, line + below * at_edge
    low = xp.maximum(least - down, darkest**0.5 * least)
    bound = xp.minimum(xp.maximum(now, low), most + up)
    share = xp.where(free, xp.ones_like(now), (bound / xp.clip(now, TINY, None)) ** 2)
    lost = (now < TINY) & (share > 0.0) & ~free
    return xp.where(lost, y * (bound**2 / xp.clip(light, 1e-9, None)), x * share)


def _levels(xp: Any, light: Array, wide: int) -> tuple[Array, ...]:  # noqa: ANN401 - a module of functions
    """Levels around each pixel, as seen, and how much of an edge each makes; see `limit._levels`."""
    total = sum(_shifted(xp, _shifted(xp, light, i, -2), j, -1) for i in (-1, 0, 1) for j in (-1, 0, 1))
    seen = xp.sqrt(xp.clip(total[::2, ::2] / 9.0, 0.0, None))
    reach = (wide + 1) // 2
    bottom, top = _around(xp, xp.minimum, seen, reach), _around(xp, xp.maximum, seen, reach)
    room = LEVEL * (top - bottom)
    steps = range(-reach, reach + 1)
    dark, bright = xp.zeros_like(seen), xp.zeros_like(seen)
    for i in steps:
        row = _shifted(xp, seen, i, -2)
        for j in steps:
            value = _shifted(xp, row, j, -1)
            dark = dark + xp.astype(value <= bottom + room, seen.dtype)
            bright = bright + xp.astype(value >= top - room, seen.dtype)
    size = len(steps) ** 2
    edges = (
        xp.clip((count / size - LINE_SHARE) / (EDGE_SHARE - LINE_SHARE), 0.0, 1.0) for count in (dark, bright)
    )
    return tuple(_doubled(xp, plane, light.shape) for plane in (bottom, top, *edges))


def _colour_held(xp: Any, y: Array, x: Array, brightest: Array, dark: float, known: float) -> Array:  # noqa: ANN401 - same
    lending, floor = (
        xp.clip(3.0 * share * brightest**2, dark, None)
        for share in (COLOURLESS, min(OWN_COLOURLESS * known, COLOURLESS))
    )

    def shares_of(planes: Array, floor: Array) -> tuple[Array, Array, Array]:
        light = xp.clip(planes, 0.0, None)
        total = xp.sum(light, axis=0) + floor
        shares = (light + floor / 3.0) / total
        return shares, shares - xp.roll(shares, -1, axis=0), total

    (own, here, _), (made, there, total) = shares_of(y, floor), shares_of(x, floor)
    _, lent, _ = shares_of(y, lending)
    low, high = (_around(xp, of, lent, HUE_REACH) for of in (xp.minimum, xp.maximum))
    step = there - here
    room = xp.clip(xp.where(step > 0.0, high - here, here - low), 0.0, None)
    share = xp.clip(xp.min((room + PURER * known) / xp.clip(xp.abs(step), 1e-6, None), axis=0), 0.0, 1.0)
    return xp.where(share < 1.0, (own + share * (made - own)) * total - floor / 3.0, x)


def _shifted(xp: Any, plane: Array, by: int, axis: int) -> Array:  # noqa: ANN401 - same
    """The pixel `by` further along an axis; rims repeat."""
    size = plane.shape[axis]
    at = np.clip(np.arange(size) + by, 0, size - 1)
    return xp.take(plane, xp.asarray(at, device=plane.device), axis=axis)


def _around(xp: Any, of: Any, plane: Array, reach: int) -> Array:  # noqa: ANN401 - same
    """Least or largest pixel within `reach`."""
    for axis in (-2, -1):
        found = plane
        for by in range(-reach, reach + 1):
            found = of(found, _shifted(xp, plane, by, axis))
        plane = found
    return plane


def _doubled(xp: Any, blocks: Array, shape: tuple[int, ...]) -> Array:  # noqa: ANN401 - same
    """Give each 2 x 2 pixels the figure of their block."""
    return xp.repeat(xp.repeat(blocks, 2, axis=-2), 2, axis=-1)[..., : shape[-2], : shape[-1]]
