"""The one limit on a correction: light and colour of the photo nearby, widened by what its blur hides."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.jit import jit
from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.clipped import compact, positive
from lensmodel.correction.compiled.common import Number
from lensmodel.correction.deconvolver import Sensor

Real = NDArray[np.float32]
Mask = NDArray[np.bool_]

_REACH: Final = 2
"""Radius in pixels of the window whose light bounds a pixel (chosen: within one pixel only the blur of a thin
line is seen and not its surroundings; further away lies another object)."""
_MOST: Final = (
    12  # pixels of a blur's reach beyond which levels beside an edge belong to other things (chosen)
)
_NEAREST, _NEXT = 2, 1
"""Radii beside clipped light for the least and the most (chosen: specks in a dark glow are seen before all
else, and darker twigs are not)."""
_BRIGHTER: Final = 4.0
"""Brightness of broad white areas, in units of saturation: lamps, sunlit paint and white skies (chosen)."""
_EVEN: Final = 5
"""Side of the window in which glare is compared with light (chosen: pixel by pixel, noise would decide)."""
_PLATEAU: Final = 3
"""Pixels beyond the blur's reach that hold the level beside an edge (chosen: about as many as its width)."""
_SURE: Final = 0.25
"""Error of a kernel at which a result may leave the photo's range by the width of that range (chosen: the
least that costs no gain behind a lens that is known to a quarter)."""
_EDGE, _UNSURE = 0.06, 0.1
"""Share of the range by which a result may leave the level beside an edge, and error of the kernel up to
which more is allowed (chosen: half of what shows as a halo; the other half is left to grain)."""
_EXACT: Final = 0.02
"""Least error of a kernel that is reckoned with: none is known better over a whole tile (chosen)."""
_LEVEL: Final = 0.1
"""Share of the range within which pixels belong to the level beside an edge (chosen: far more than noise)."""
_LINE_SHARE, _EDGE_SHARE = 0.12, 0.25
"""Share of a window that lies at the level of a line, and of an edge (chosen: a line narrower than its blur
is as bright as its middle over a tenth of a window, an edge over a quarter at least)."""
_FREE: Final = 1e6  # stands for no bound where infinity would make differences undefined
_DARKEST: Final = 0.5
"""Share of the darkest light nearby that remains where the kernel is unsure (chosen: one stop)."""
_HUE_REACH: Final = 3
"""Radius of the window whose colours a pixel may have: as far as lateral colour moves them."""
_PURER: Final = 0.03
"""By how much a colour's share of the light may leave the range nearby (chosen: colours that blur has washed
out get purer, and three times this shows in a light grey)."""
_COLOURLESS: Final = 0.05
"""Share of the brightest light nearby that is added as grey: what is far darker shows no colour beside it
(chosen)."""
_SIGMAS: Final = 3.0
"""Standard deviations of the noise in the dark that are added as grey as well (chosen: below, noise decides
which colour is the largest)."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a photographer lets a correction do.

    Parameters
    ----------
    halo : float or None
        How far each colour of the result may leave the photo's range within 2 pixels, as a share of it: 0 not
        at all, infinity without bound. None derives it from the kernels and their expected errors.
    texture : float
        0 to 1: how much of what the correction leaves unexplained is added back: faint texture and grain.
    denoise : float
        0 to 1: how much of that is removed where it looks like noise alone.

    Raises
    ------
    InvalidInputError
        If `halo` is negative, or another value lies outside 0..1.
    """

    halo: float | None = None
    texture: float = 1.0
    denoise: float = 0.0

    def __post_init__(self) -> None:
        if not (self.halo is None or self.halo >= 0.0):
            raise InvalidInputError(f"halo must not be negative, got {self.halo}")
        if not (0.0 <= self.texture <= 1.0 and 0.0 <= self.denoise <= 1.0):
            raise InvalidInputError(f"texture and denoise must lie in 0..1, got {self}")

    @property
    def described(self) -> str:
        """The settings, for the tag of a corrected photo; empty for the defaults."""
        halo = "" if self.halo is None else f", halo {self.halo:g}"
        texture = f", texture {self.texture:g}" if self.texture < 1.0 else ""
        return halo + texture + (f", denoised {self.denoise:g}" if self.denoise > 0.0 else "")


def limited(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
    halo: float | None = None,
) -> Planes:
    r"""Hold a result within what the photo can have hidden.

    Light, the mean of the colours as it is seen (the power 1 / 2.2), stays within the photo's range [l, h]
    within 2 pixels, widened by a span. With e the error of the kernel, p the peak of its line integral, that
    is the contrast that a thin line keeps, and [L, H] the range in the reach of the blur::

        on a line     from h to h + (1 / p - 1) (h - L), from l to l - (1 / p - 1) (H - l) of linear light, by
                      no more than (.25 / e)² (h - l)
        at an edge    .06 max( (.1 / e)², 1 ) (H - L)

    It is an edge where a quarter of the window lies at the level that is exceeded. Within reach of lamps, of
    white areas, and of all clipped light where e is .1 or more, each colour stays above the photo's least
    within 2 pixels and below its most within 1. Beside areas of which one colour clipped, it stays within
    the photo's range in the blur's reach, widened by .06 or what the blur hides of a line. Broad clipped
    areas stay as they are, and so does, where e is .1, what may be glare of white ones, four times as bright
    as saturation. Colour, the shares of red, green and blue in the light, is drawn towards
    the photo's own at the same place until the shares and their differences lie in the photo's range within
    3 pixels; the light stays the same.

    Parameters
    ----------
    photo, restored : Planes, shape (3, rows, cols)
        A tile with its halo, and its correction.
    blurs, sensors : sequence
        By colour.
    errors : sequence of float
        Expected relative L2 errors of the kernels.
    halo : float or None
        A share s that the photographer chose; None derives it.

    Returns
    -------
    Planes, float32
    """
    error = max(*errors, _EXACT)
    hidden, sure, edge = widening(blurs, error) if halo is None else (min(halo, _FREE),) * 3
    reach = max(blur.spread for blur in blurs)
    dark = math.hypot(*(sensor.noise.sigma_at(0.0) for sensor in sensors))
    held = np.array(restored, dtype=np.float32, order="C")
    photo = np.ascontiguousarray(photo, dtype=np.float32)
    clip = np.array([min(sensor.clip, _FREE) for sensor in sensors], dtype=np.float32)
    clipped = photo >= clip[:, None, None]
    broad = np.stack([plane & ~compact(plane, reach) for plane in clipped]) if clipped.any() else clipped
    white = broad.sum(axis=0) > 1
    if white.any():
        doubt = np.float32(_BRIGHTER * min(error / _UNSURE, 1.0))
        held += np.minimum(doubt * glare_share(photo, white, clip, blurs), 1.0) * (photo - held)
    _limit(
        photo,
        held,
        clip,
        broad,
        min(reach, _MOST) + _PLATEAU,
        error >= _UNSURE,
        np.float32(hidden),
        np.float32(sure),
        np.float32(edge),
        np.float32(_DARKEST * min(error / _SURE, 1.0) if halo is None else 0.0),
        np.float32(_SIGMAS * dark + 1e-6),
    )
    if halo is not None and halo < _FREE:
        low, high = np.empty_like(photo), np.empty_like(photo)
        for c in range(len(photo)):
            extremes(photo[c], photo[c], _REACH, low[c], high[c])
        room = np.float32(halo) * (high - low)
        np.clip(held, low - room, high + room, out=held)
    return held


def glare_share(photo: Planes, white: Mask, clip: Real, blurs: Sequence[UniformBlur]) -> Real:
    """Share of each pixel's light that the areas `white` give it, were they as bright as saturation."""
    share = np.zeros(white.shape, np.float32)
    for plane, level, blur in zip(photo, clip, map(positive, blurs), strict=True):
        light = level * np.pad(white.astype(np.float32), blur.reach, mode="edge")
        spread, lit = (ndimage.uniform_filter(p, _EVEN, mode="nearest") for p in (blur.forward(light), plane))
        np.maximum(share, spread / np.maximum(lit, np.float32(1e-6)), out=share)
    return np.minimum(share, np.float32(1.0))


def widening(blurs: Sequence[UniformBlur], error: float) -> tuple[float, float, float]:
    """Shares of the far and the near range by which a line may leave it, and of the far one at an edge."""
    hidden = max(1.0 / blur.line_peak - 1.0 for blur in blurs)
    return hidden, (_SURE / error) ** 2, _EDGE * max((_UNSURE / error) ** 2, 1.0)


@jit
def extremes(below: Real, above: Real, reach: int, low: Real, high: Real) -> None:
    """Least light of one plane and largest of another in the square around each pixel; rims repeat."""
    rows, cols = below.shape
    least, most = np.empty(cols + 2 * reach, np.float32), np.empty(cols + 2 * reach, np.float32)
    for i in range(rows):
        line, top = low[i], high[i]
        line[:] = below[i]
        top[:] = above[i]
        for k in range(max(i - reach, 0), min(i + reach + 1, rows)):
            for j in range(cols):
                line[j] = min(line[j], below[k, j])
                top[j] = max(top[j], above[k, j])
        least[reach : reach + cols] = line
        most[reach : reach + cols] = top
        for j in range(reach):
            least[j], most[j] = line[0], top[0]
            least[reach + cols + j], most[reach + cols + j] = line[cols - 1], top[cols - 1]
        for k in range(2 * reach + 1):
            for j in range(cols):
                line[j] = min(line[j], least[j + k])
                top[j] = max(top[j], most[j + k])


@jit
def _mean3(plane: Real, out: Real) -> None:
    """Mean over 3 x 3 pixels; rims repeat."""
    rows, cols = plane.shape
    line = np.empty(cols, np.float32)
    ninth = np.float32(1.0 / 9.0)
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(cols):
            line[j] = (plane[above, j] + plane[i, j] + plane[below, j]) * ninth
        for j in range(1, cols - 1):
            out[i, j] = line[j - 1] + line[j] + line[j + 1]
        out[i, 0] = line[0] + line[0] + line[1]
        out[i, cols - 1] = line[cols - 2] + line[cols - 1] + line[cols - 1]


@jit
def _seen(light: Number) -> Number:
    return np.float32(max(light, np.float32(0.0)) ** np.float32(1.0 / 2.2))


@jit
def _span(
    level: Real,
    i: int,
    j: int,
    reach: int,
    light: Number,
    near: Number,
    above: bool,
    shares: tuple[float, float, float],
) -> Number:
    """By how much light as it is seen may leave the photo's range here: on a line, at an edge, or between."""
    rows, cols = level.shape
    bottom, top, number, total = level[i, j], level[i, j], 0, 0
    for a in range(max(i - reach, 0), min(i + reach + 1, rows)):
        for b in range(max(j - reach, 0), min(j + reach + 1, cols)):
            bottom, top = min(bottom, level[a, b]), max(top, level[a, b])
    if above:
        deep = _seen(light + shares[0] * max(light - bottom, np.float32(0.0))) - _seen(light)
    else:
        deep = _seen(light) - _seen(light - shares[0] * max(top - light, np.float32(0.0)))
    bottom, top = _seen(bottom), _seen(top)
    far = top - bottom
    mark = top - np.float32(_LEVEL) * far if above else bottom + np.float32(_LEVEL) * far
    mark = mark ** np.float32(2.2)
    for a in range(max(i - reach, 0), min(i + reach + 1, rows)):
        for b in range(max(j - reach, 0), min(j + reach + 1, cols)):
            total += 1
            number += level[a, b] >= mark if above else level[a, b] <= mark
    t = (np.float32(number) / np.float32(total) - np.float32(_LINE_SHARE)) / np.float32(
        _EDGE_SHARE - _LINE_SHARE
    )
    t = min(max(t, np.float32(0.0)), np.float32(1.0))
    line = min(deep, shares[1] * near)
    return line + t * (min(shares[2] * far, line) - line)


@jit
def _limit(  # noqa: C901, PLR0912, PLR0915 - one pass over the tile
    y: Real,
    x: Real,
    clip: Real,
    broad: Mask,
    wide: int,
    unsure: bool,
    hidden: Number,
    sure: Number,
    edge: Number,
    darkest: Number,
    dark: Number,
) -> None:
    """Limit `x` in place; see `limited`."""
    rows, cols = y.shape[1:]
    zero, one, third = np.float32(0.0), np.float32(1.0), np.float32(1.0 / 3.0)
    light, level = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    low, high = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    number = np.zeros((rows, cols), np.float32)  # clipped colours
    lamp, tinted = np.zeros((rows, cols), np.float32), np.zeros((rows, cols), np.float32)
    anything = coloured = False
    slack = min(hidden, np.float32(_EDGE))
    for i in range(rows):
        for j in range(cols):
            light[i, j] = third * (y[0, i, j] + y[1, i, j] + y[2, i, j])
            for c in range(3):
                if y[c, i, j] >= clip[c]:
                    number[i, j] += one
                    if unsure or not broad[c, i, j] or number[i, j] > one:
                        lamp[i, j] = one
                        anything = True
            if number[i, j] == one and lamp[i, j] == zero:
                tinted[i, j] = one
                coloured = True
    _mean3(light, level)
    near, around, unused = np.zeros_like(number), np.zeros_like(number), np.empty_like(number)
    shape, wider = (3 if anything else 0, rows, cols), (3 if coloured else 0, rows, cols)
    dimmest, brightest = np.empty(shape, np.float32), np.empty(shape, np.float32)
    bottom, top = np.empty(wider, np.float32), np.empty(wider, np.float32)
    if coloured:
        extremes(tinted, tinted, wide, unused, around)
        beyond = wide - _PLATEAU - 1  # the reach of the blur
        for c in range(3):
            extremes(y[c], y[c], beyond, bottom[c], top[c])
    if anything:
        extremes(lamp, lamp, wide, unused, near)
        for c in range(3):
            extremes(y[c], y[c], _NEAREST, dimmest[c], unused)
            extremes(y[c], y[c], _NEXT, unused, brightest[c])
    extremes(light, light, _REACH, low, high)
    for i in range(rows):
        for j in range(cols):
            least, most = low[i, j], high[i, j]
            for c in range(3):
                if broad[c, i, j]:
                    x[c, i, j] = y[c, i, j]
            if near[i, j] > zero:
                for c in range(3):
                    if not broad[c, i, j]:
                        x[c, i, j] = min(max(x[c, i, j], dimmest[c, i, j]), brightest[c, i, j])
                continue
            if around[i, j] > zero:
                for c in range(3):
                    room = slack * (top[c, i, j] - bottom[c, i, j])
                    x[c, i, j] = min(max(x[c, i, j], bottom[c, i, j] - room), top[c, i, j] + room)
            now = third * (max(x[0, i, j], zero) + max(x[1, i, j], zero) + max(x[2, i, j], zero))
            if least <= now <= most:
                continue
            above = now > most
            light_here, near_range = (most if above else least), _seen(most) - _seen(least)
            span = _span(level, i, j, wide, light_here, near_range, above, (hidden, sure, edge))
            if above:
                bound = (_seen(most) + span) ** np.float32(2.2)
                bound = min(now, bound)
            else:
                bound = max(_seen(least) - span, zero) ** np.float32(2.2)
                bound = max(now, bound, darkest * least)
            if bound != now:
                if now > np.float32(1e-9):
                    for c in range(3):
                        x[c, i, j] = max(x[c, i, j], zero) * (bound / now)
                else:
                    share = bound / max(light[i, j], np.float32(1e-9))
                    for c in range(3):
                        x[c, i, j] = y[c, i, j] * share
    _hold_colour(y, x, clip, number, light, dark)


@jit
def _shares(planes: Real, floor: Real, i: int, out: Real) -> None:
    """Each colour's share of a row's light, and the differences of shares: six half planes of a hull."""
    zero, third = np.float32(0.0), np.float32(1.0 / 3.0)
    for j in range(planes.shape[2]):
        r, g, b = max(planes[0, i, j], zero), max(planes[1, i, j], zero), max(planes[2, i, j], zero)
        grey = third * floor[j]
        total = np.float32(1.0) / (r + g + b + floor[j])
        r, g, b = (r + grey) * total, (g + grey) * total, (b + grey) * total
        out[0, j], out[1, j], out[2, j] = r, g, b
        out[3, j], out[4, j], out[5, j] = r - g, g - b, b - r


@jit
def _hold_colour(  # noqa: C901, PLR0912, PLR0915 - one pass over the tile
    y: Real, x: Real, clip: Real, number: Real, light: Real, dark: Number
) -> None:
    """Draw the colours of `x` into the range of those of `y` nearby, in place."""
    rows, cols = light.shape
    zero, one, purer = np.float32(0.0), np.float32(1.0), np.float32(_PURER)
    low, high = np.empty((6, rows, cols), np.float32), np.empty((6, rows, cols), np.float32)
    axes = np.empty((6, rows, cols), np.float32)
    floors, least = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    extremes(light, light, _HUE_REACH, least, floors)
    row = np.empty((6, cols), np.float32)
    lost = False
    for i in range(rows):
        for j in range(cols):
            floors[i, j] = max(dark, np.float32(3.0 * _COLOURLESS) * floors[i, j])
            lost |= number[i, j] > one
        _shares(y, floors[i], i, row)
        axes[:, i] = row
    above = axes.copy() if lost else axes
    if lost:  # of two clipped colours the hue is not known
        for i in range(rows):
            for j in range(cols):
                if number[i, j] > one:
                    axes[:, i, j] = np.float32(np.inf)
                    above[:, i, j] = np.float32(-np.inf)
    for k in range(6):
        extremes(axes[k], above[k], _HUE_REACH, low[k], high[k])
    made = np.empty((6, cols), np.float32)
    for i in range(rows):
        _shares(x, floors[i], i, made)
        _shares(y, floors[i], i, row)
        for j in range(cols):
            if number[i, j] > one:
                still = True
                for c in range(3):
                    if y[c, i, j] >= clip[c] and x[c, i, j] < clip[c]:
                        still = False
                if still:
                    continue
                if low[0, i, j] > high[0, i, j]:  # white all around
                    for c in range(3):
                        x[c, i, j] = max(x[c, i, j], y[c, i, j])
                    continue
                total = zero
                for c in range(3):
                    row[c, j] = np.float32(0.5) * (low[c, i, j] + high[c, i, j])
                    total += row[c, j]
                r, g, b = row[0, j] / total, row[1, j] / total, row[2, j] / total
                row[0, j], row[1, j], row[2, j] = r, g, b
                row[3, j], row[4, j], row[5, j] = r - g, g - b, b - r
            t = one
            for k in range(6):
                step = made[k, j] - row[k, j]
                if step > zero:
                    room = high[k, i, j] + purer - row[k, j]
                    if step > room:
                        t = min(t, room / step)
                elif step < zero:
                    room = row[k, j] - low[k, i, j] + purer
                    if -step > room:
                        t = min(t, room / -step)
            if t < one:
                total = max(x[0, i, j], zero) + max(x[1, i, j], zero) + max(x[2, i, j], zero) + floors[i, j]
                for c in range(3):
                    share = row[c, j] + max(t, zero) * (made[c, j] - row[c, j])
                    x[c, i, j] = share * total - floors[i, j] * np.float32(1.0 / 3.0)
