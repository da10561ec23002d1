"""The one limit on a correction: light and colour of the photo nearby, widened by what its blur hides.

And what a JPEG can hold of a correction: its finest detail is coarse, its chroma often of half resolution.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.types import CHANNELS, Planes
from lensmodel.correction.blur import ONE, ZERO, Number, Real, UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.richardson_lucy import LEAST_CLIPPED, compact
from lensmodel.photo import LinearPhoto
from lensmodel.photo.colour import curves_of, inverse

Mask = NDArray[np.bool_]

_REACH: Final = 2
"""Radius in pixels of the window whose light bounds a pixel (chosen: within one pixel only the blur of a thin
line is seen and not its surroundings; further away lies another object)."""
_LEVEL: Final = 0.1
"""Share of the range within which pixels belong to the level beside an edge (chosen: far more than noise)."""
_LINE_SHARE, _EDGE_SHARE = 0.12, 0.25
"""Share of a window that lies at the level of a line, and of an edge (chosen: a line narrower than its blur
is as bright as its middle over a tenth of a window, an edge over a quarter at least)."""
_HUE_REACH: Final = 2
"""Radius of the window whose colours a pixel may have (chosen: with 3, more blocks of foliage lose)."""
_PURER: Final = 0.01
"""By how much a colour's share of the light may leave the range nearby where the kernel is unsure (chosen:
colours that blur has washed out get purer; with twice as much, a block more of foliage loses half a decibel,
with none cars get dots). The surer, the more, as for lines: else a true kernel gains up to 1.2 dB less."""
_COLOURLESS: Final = 0.05
"""Share of the brightest light nearby that is added as grey to what lends its colour: what is far darker
shows none beside it (chosen)."""
_OWN_COLOURLESS: Final = 0.02
"""The same for the pixel itself where the kernel is unsure (chosen: with more, black letters get green)."""
_TINY: Final = 1e-5  # light, as seen, below which there is none
_MOST: Final = 12  # pixels of a blur's reach beyond which levels beside an edge are of other things (chosen)
_LAMP: Final = 2.0
"""Solved light, in units of saturation, from which a pixel counts as a lamp although the photo did not clip
(chosen: edges overshoot by less, lamps that the blur has dimmed are brighter)."""
_PLATEAU: Final = 3
"""Pixels beyond the blur's reach that hold the level beside an edge (chosen: about as many as its width)."""
_SURE: Final = 0.24
"""Error of a kernel at which a result may leave the photo's range by the width of that range (chosen: the
least that costs no gain behind a lens that is known to a quarter)."""
_MOST_ROOM: Final = 4.0
"""Ranges by which a line may leave the photo's where the kernel is known well (chosen: the least with which
dark lines behind exact kernels come back)."""
_EDGE, _UNSURE = 0.06, 0.1
"""Share of the range by which a result may leave the level beside an edge, and error of the kernel up to
which more is allowed (chosen: half of what shows as a halo; the other half is left to grain)."""
_EXACT: Final = 0.02
"""Least error of a kernel that is reckoned with: none is known better over a whole tile (chosen)."""
_FREE: Final = 1e6  # stands for no bound where infinity would make differences undefined
_DARKEST: Final = 0.5
"""Share of the darkest light nearby that remains where the kernel is unsure (chosen: one stop)."""
_AXES: Final = 3  # differences of two colours' shares of the light: six half planes of a hull
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

    Light, the mean of the colours as it is seen (its square root), stays within the photo's range [l, h]
    within 2 pixels, widened by a span, with e the error of the kernel and [L, H] the range in the reach of
    the blur::

        on a line     min( (.24 / e)², 4 ) (h - l)
        at an edge    .06 max( (.1 / e)², 1 ) (H - L), and no more than that

    It is an edge where a quarter of the window lies at the level that is exceeded. What clips, and lamps,
    which were solved to be twice as bright as saturation, have rules of their own: around them, in the reach
    of the blur and some more, each colour stays below the photo's most within 1 pixel and above its least
    within 3, of lamps and white areas within 2; near white areas it gets no brighter. Broad clipped areas
    stay as they are, white ones in all colours, and what is white all around gets no darker. Colour, the
    shares of red, green and blue in the light, is drawn towards the photo's own at the same place until
    their differences lie, but for .01 (up to .04 where the kernel is known), in the photo's range within 2
    pixels; the light stays. At last each colour, as seen, leaves its own range within 2 pixels by no more
    than the span of a line, at least by the width of that range and around lamps by no more: where a colour
    has next to no light, its noise shows.

    `halo` is the share of the range that a photographer chose for line and edge.
    """
    error = max(*errors, _EXACT)
    room, edge = widening(error) if halo is None else (min(halo, _FREE),) * 2
    known = max(widening(error)[0], 1.0)
    reach = max(blur.spread for blur in blurs)
    dark = math.hypot(*(sensor.noise.sigma_at(0.0) for sensor in sensors))
    held = np.array(restored, dtype=np.float32, order="C")
    photo = np.ascontiguousarray(photo, dtype=np.float32)
    wide, shape = min(reach, _MOST) + _PLATEAU, photo.shape[1:]
    near, number = np.zeros(shape, dtype=np.bool_), np.empty((0, 0), dtype=np.float32)
    clip = np.array([min(sensor.clip, _FREE) for sensor in sensors], dtype=np.float32)
    clipped = photo >= clip[:, None, None]
    solved = (held > np.float32(_LAMP) * clip[:, None, None]).any(axis=0)
    if clipped.any() or solved.any():
        broad = np.stack([plane & ~compact(plane, reach) for plane in clipped])
        white = broad.sum(axis=0) > 1
        number = clipped.sum(axis=0, dtype=np.float32)
        kinds = np.maximum(np.minimum(number, 1.0), np.float32(2.0) * ((number > 1.0) | solved))
        glow = wide + max(blur.reach for blur in blurs)  # and what a cut kernel leaves
        inside = (photo >= np.float32(LEAST_CLIPPED) * clip[:, None, None]).all(axis=0)
        inside = ndimage.binary_erosion(inside, np.ones((3, 3)), border_value=1)
        held[:, inside] = np.maximum(held[:, inside], photo[:, inside])
        _beside_lamps(photo, held, broad | white, kinds, white.astype(np.float32), glow, near)
    darkest = np.float32(_DARKEST * min(error / _SURE, 1.0) if halo is None else 0.0)
    most = np.empty(shape, dtype=np.float32)
    _hold_light(photo, held, near, wide, (np.float32(room), np.float32(edge)), darkest, most)
    _hold_colour(photo, held, most, number, clip, np.float32(_SIGMAS * dark + 1e-6), np.float32(known))
    if halo is None:
        own = np.where(near, np.float32(1.0), np.float32(known))
        for plane, made, sensor in zip(photo, held, sensors, strict=True):
            _hold_own(plane, made, own, np.float32(_SIGMAS * sensor.noise.sigma_at(0.0)))
    elif halo < _FREE:
        low, high = np.empty_like(photo), np.empty_like(photo)
        for c in range(len(photo)):
            extremes(photo[c], photo[c], _REACH, low[c], high[c])
        more = np.float32(halo) * (high - low)
        np.clip(held, low - more, high + more, out=held)
    return held


def widening(error: float) -> tuple[float, float]:
    """Shares of the near range by which a line may leave it, and of the far one by which an edge may."""
    return min((_SURE / error) ** 2, _MOST_ROOM), _EDGE * max((_UNSURE / error) ** 2, 1.0)


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
    line, ninth = np.empty(cols, np.float32), np.float32(1.0 / 9.0)
    for i in range(rows):
        above, below = max(i - 1, 0), min(i + 1, rows - 1)
        for j in range(cols):
            line[j] = (plane[above, j] + plane[i, j] + plane[below, j]) * ninth
        for j in range(1, cols - 1):
            out[i, j] = line[j - 1] + line[j] + line[j + 1]
        out[i, 0] = line[0] + line[0] + line[min(1, cols - 1)]
        out[i, cols - 1] = line[max(cols - 2, 0)] + line[cols - 1] + line[cols - 1]


@jit
def _levels(light: Real, reach: int) -> Real:
    """Levels around every second pixel of every second row, as seen, and how much of an edge each makes.

    The first two are the least and most light within `reach` pixels; the others are 1 where a quarter of that
    window lies at this level, 0 where it is a line.
    """
    rows, cols = (light.shape[0] + 1) // 2, (light.shape[1] + 1) // 2
    wide = (reach + 1) // 2
    levels = np.empty((4, rows, cols), np.float32)
    bottom, top, below, above = levels[0], levels[1], levels[2], levels[3]
    level, seen = np.empty_like(light), np.empty((rows, cols), np.float32)
    _mean3(light, level)
    for i in range(rows):
        for j in range(cols):
            seen[i, j] = np.sqrt(max(level[2 * i, 2 * j], ZERO))
    extremes(seen, seen, wide, bottom, top)
    padded = np.empty((rows + 2 * wide, cols + 2 * wide), np.float32)
    for i in range(rows + 2 * wide):
        line = seen[min(max(i - wide, 0), rows - 1)]
        padded[i, wide : wide + cols] = line
        padded[i, :wide] = line[0]
        padded[i, wide + cols :] = line[cols - 1]
    low, high = np.empty(cols, np.float32), np.empty(cols, np.float32)
    dark, bright = np.empty(cols, np.int32), np.empty(cols, np.int32)
    all_of_it = np.float32((2 * wide + 1) ** 2)
    for i in range(rows):
        for j in range(cols):
            room = np.float32(_LEVEL) * (top[i, j] - bottom[i, j])
            low[j], high[j] = bottom[i, j] + room, top[i, j] - room
        dark[:] = 0
        bright[:] = 0
        for k in range(2 * wide + 1):
            for l in range(2 * wide + 1):
                for j in range(cols):
                    value = padded[i + k, j + l]
                    dark[j] += np.int32(value <= low[j])
                    bright[j] += np.int32(value >= high[j])
        start = np.float32(_LINE_SHARE) * all_of_it
        scale = np.float32(1.0 / (_EDGE_SHARE - _LINE_SHARE)) / all_of_it
        for j in range(cols):
            below[i, j] = min(max((np.float32(dark[j]) - start) * scale, ZERO), ONE)
            above[i, j] = min(max((np.float32(bright[j]) - start) * scale, ZERO), ONE)
    return levels


@jit
def _hold_light(
    y: Real, x: Real, free: Mask, wide: int, shares: tuple[Number, Number], darkest: Number, most: Real
) -> None:
    """Hold the light of `x` within that of `y` nearby, widened, in place, but where it is `free`.

    `most` receives the brightest light within 2 pixels, as seen.
    """
    rows, cols = most.shape
    third, tiny = np.float32(1.0 / 3.0), np.float32(_TINY)
    room, edge = shares
    floor = np.sqrt(darkest)
    light, seen = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            light[i, j] = third * (y[0, i, j] + y[1, i, j] + y[2, i, j])
            seen[i, j] = np.sqrt(max(light[i, j], ZERO))
    least = np.empty((rows, cols), np.float32)
    extremes(seen, seen, _REACH, least, most)
    levels, near = _levels(light, wide), np.empty((4, cols), np.float32)
    bottom, top, below, above = near[0], near[1], near[2], near[3]
    for i in range(rows):
        for k in range(4):
            for j in range(cols):
                near[k, j] = levels[k, i // 2, j // 2]
        for j in range(cols):
            low, high = least[i, j], most[i, j]
            now = np.sqrt(third * (max(x[0, i, j], ZERO) + max(x[1, i, j], ZERO) + max(x[2, i, j], ZERO)))
            line, at_edge = room * (high - low), edge * (top[j] - bottom[j])
            up = line + above[j] * (min(at_edge, line) - line)
            down = line + below[j] * (min(at_edge, line) - line)
            bound = min(max(now, low - down, floor * low), high + up)
            share = bound / max(now, tiny)
            share = ONE if free[i, j] else share * share
            lost = now < tiny and share > ZERO and not free[i, j]
            fill = bound * bound / max(light[i, j], np.float32(1e-9))
            x[0, i, j] = y[0, i, j] * fill if lost else x[0, i, j] * share
            x[1, i, j] = y[1, i, j] * fill if lost else x[1, i, j] * share
            x[2, i, j] = y[2, i, j] * fill if lost else x[2, i, j] * share


@jit
def _hold_own(y: Real, x: Real, room: Real, dark: Number) -> None:
    """Hold one colour within its own range within 2 pixels, widened, in place."""
    rows, cols = y.shape
    seen = np.empty((rows, cols), np.float32)
    low, high = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            seen[i, j] = np.sqrt(max(y[i, j], ZERO) + dark)
    extremes(seen, seen, _REACH, low, high)
    for i in range(rows):
        for j in range(cols):
            more = room[i, j] * (high[i, j] - low[i, j])
            least, most = max(low[i, j] - more, ZERO), high[i, j] + more
            x[i, j] = min(max(x[i, j], least * least - dark), most * most - dark)


@jit
def _beside_lamps(y: Real, x: Real, fixed: Mask, kinds: Real, white: Real, glow: int, near: Mask) -> None:
    """Hold each colour around clipped light and lamps within that of the photo, in place; mark where that is.

    Specks in a dark glow are seen before all else, and darker twigs are not: so the most is that within 1
    pixel, the least that within 2 or 3. `kinds` is 2 for lamps and for what clips in more than one colour,
    and 1 for other clipped light.
    """
    rows, cols = kinds.shape
    unused, darker = np.empty_like(kinds), np.empty_like(kinds)
    kind, glare = np.empty_like(kinds), np.empty_like(kinds)
    least, dimmest, brightest = np.empty_like(kinds), np.empty_like(kinds), np.empty_like(kinds)
    extremes(kinds, kinds, glow, unused, kind)
    extremes(white, white, glow // 2, unused, glare)
    for c in range(3):
        extremes(y[c], y[c], 1, darker, brightest)
        extremes(darker, y[c], 1, dimmest, unused)  # within 2
        extremes(dimmest, y[c], 1, least, unused)  # within 3
        for i in range(rows):
            for j in range(cols):
                near[i, j] = kind[i, j] > ZERO
                low = dimmest[i, j] if kind[i, j] > ONE else least[i, j]
                high = y[c, i, j] if glare[i, j] > ZERO else brightest[i, j]
                if fixed[c, i, j]:
                    x[c, i, j] = y[c, i, j]
                elif near[i, j]:
                    x[c, i, j] = min(max(x[c, i, j], low), high)


@jit
def _axes(planes: Real, floor: Real, i: int, shares: Real, axes: Real) -> None:
    """Each colour's share of a row's light, and its coordinates, whose ranges are half planes of a hull."""
    third = np.float32(1.0 / 3.0)
    for j in range(floor.size):
        r, g, b = max(planes[0, i, j], ZERO), max(planes[1, i, j], ZERO), max(planes[2, i, j], ZERO)
        grey = third * floor[j]
        total = ONE / (r + g + b + floor[j])
        r, g, b = (r + grey) * total, (g + grey) * total, (b + grey) * total
        shares[0, j], shares[1, j], shares[2, j] = r, g, b
        axes[0, j], axes[1, j], axes[2, j] = r - g, g - b, b - r


@jit
def _hold_colour(  # noqa: C901, PLR0912 - one pass over the tile, row by row
    y: Real, x: Real, most: Real, number: Real, clip: Real, dark: Number, known: Number
) -> None:
    """Draw the colours of `x` into the range of those of `y` nearby, in place.

    `most` is the brightest light within 2 pixels, as seen.
    """
    rows, cols = most.shape
    purer = np.float32(_PURER) * known
    grey_share = min(np.float32(_OWN_COLOURLESS / _COLOURLESS) * known, ONE)
    lost = number.size > 0  # whether anything clips: of two clipped colours the hue is not known
    reach, side = _HUE_REACH, 2 * _HUE_REACH + 1
    least, floors = np.empty((rows, cols), np.float32), np.empty((rows, cols), np.float32)
    extremes(most, most, reach - _REACH, least, floors)
    own, made = np.empty((3, cols), np.float32), np.empty((3, cols), np.float32)
    here, there = np.empty((_AXES, cols), np.float32), np.empty((_AXES, cols), np.float32)
    # ranges along rows, of the rows that the next one needs: all rows at once do not fit into a cache
    lows, highs = np.empty((side, _AXES, cols), np.float32), np.empty((side, _AXES, cols), np.float32)
    low, high = np.empty((_AXES, cols), np.float32), np.empty((_AXES, cols), np.float32)
    padded = np.empty((2, cols + 2 * reach), np.float32)
    share, kept = np.empty(cols, np.float32), np.zeros(cols, np.bool_)
    for ahead in range(rows + reach):
        if ahead < rows:
            for j in range(cols):
                floors[ahead, j] = max(
                    dark, np.float32(3.0 * _COLOURLESS) * floors[ahead, j] * floors[ahead, j]
                )
            _axes(y, floors[ahead], ahead, own, here)
            for k in range(_AXES):
                _along(here[k], number, ahead, padded, lows[ahead % side, k], highs[ahead % side, k])
        i = ahead - reach
        if i < 0:
            continue
        low[:] = lows[i % side]
        high[:] = highs[i % side]
        for row in range(max(i - reach, 0), min(i + reach + 1, rows)):
            for k in range(_AXES):
                for j in range(cols):
                    low[k, j] = min(low[k, j], lows[row % side, k, j])
                    high[k, j] = max(high[k, j], highs[row % side, k, j])
        for j in range(cols):
            floors[i, j] = max(dark, grey_share * floors[i, j])
        _axes(x, floors[i], i, made, there)
        _axes(y, floors[i], i, own, here)
        if lost:
            _of_white(y, x, number, clip, i, low, high, own, here, kept)
        share[:] = ONE
        for k in range(_AXES):
            for j in range(cols):
                step = there[k, j] - here[k, j]
                room = high[k, j] - here[k, j] if step > ZERO else here[k, j] - low[k, j]
                share[j] = min(share[j], (max(room, ZERO) + purer) / max(abs(step), np.float32(1e-6)))
        for j in range(cols):
            t = ONE if kept[j] else max(share[j], ZERO)
            floor, grey = floors[i, j], floors[i, j] * np.float32(1.0 / 3.0)
            total = max(x[0, i, j], ZERO) + max(x[1, i, j], ZERO) + max(x[2, i, j], ZERO) + floor
            r = (own[0, j] + t * (made[0, j] - own[0, j])) * total - grey
            g = (own[1, j] + t * (made[1, j] - own[1, j])) * total - grey
            b = (own[2, j] + t * (made[2, j] - own[2, j])) * total - grey
            x[0, i, j] = r if t < ONE else x[0, i, j]
            x[1, i, j] = g if t < ONE else x[1, i, j]
            x[2, i, j] = b if t < ONE else x[2, i, j]


@jit
def _along(line: Real, number: Real, i: int, padded: Real, low: Real, high: Real) -> None:
    """Range of a coordinate along a row; pixels of two clipped colours do not count."""
    reach, cols = _HUE_REACH, line.size
    padded[0, reach : reach + cols] = line
    padded[1, reach : reach + cols] = line
    if number.size > 0:
        for j in range(cols):
            if number[i, j] > ONE:
                padded[0, reach + j], padded[1, reach + j] = np.float32(np.inf), np.float32(-np.inf)
    for j in range(reach):
        for k in range(2):
            padded[k, j], padded[k, reach + cols + j] = padded[k, reach], padded[k, reach + cols - 1]
    low[:] = padded[0, :cols]
    high[:] = padded[1, :cols]
    for k in range(1, 2 * reach + 1):
        for j in range(cols):
            low[j] = min(low[j], padded[0, j + k])
            high[j] = max(high[j], padded[1, j + k])


@jit
def _of_white(
    y: Real,
    x: Real,
    number: Real,
    clip: Real,
    i: int,
    low: Real,
    high: Real,
    own: Real,
    axes: Real,
    kept: Mask,
) -> None:
    """Give pixels of a row that lost their hue to clipping that of their surroundings to be drawn to."""
    for j in range(number.shape[1]):
        kept[j] = False
        if number[i, j] <= ONE:
            continue
        kept[j] = True
        for c in range(3):
            if y[c, i, j] >= clip[c] and x[c, i, j] < clip[c]:
                kept[j] = False
        if kept[j]:
            continue
        if low[0, j] > high[0, j]:  # white all around
            kept[j] = True
            for c in range(3):
                x[c, i, j] = max(x[c, i, j], y[c, i, j])
            continue
        for k in range(_AXES):
            axes[k, j] = np.float32(0.5) * (low[k, j] + high[k, j])
        red, green = axes[0, j], axes[1, j]  # over green, and over blue
        own[0, j] = np.float32(1.0 / 3.0) * (ONE + np.float32(2.0) * red + green)
        own[1, j] = own[0, j] - red
        own[2, j] = own[1, j] - green


_LUMA: Final = np.array([0.299, 0.587, 0.114], dtype=np.float32)
"""Weights of r, g, b in luma: ITU-R BT.601, as JFIF 1.02 requires."""

_PAIRED: Final = np.array([1.0, 4.0, 6.0, 4.0, 1.0], dtype=np.float32) / np.float32(16.0)
"""Response to one pixel when pairs of pixels are stored as their mean and interpolated linearly: the mean
over the two places that it can have in its pair."""

_FINEST: Final = np.array([1.0, -6.0, 15.0, 44.0, 15.0, -6.0, 1.0], dtype=np.float32) / np.float32(64.0)
"""1 - sin^6(pi f) along an axis: 0.88 of a correction stays at 0.25 cycles/pixel, 0.50 at 0.35, none at 0.5.

The highest coefficients of a block are rounded to about twice the steps of the middle ones, a camera's
denoising takes what is left of them, and a blur's transfer function is smallest there: of a period of two
pixels a correction makes the rounding of one coefficient, seen as a comb."""


Tables = tuple[NDArray[np.float32], ...]


@dataclass(frozen=True, slots=True, eq=False)
class StoredColour:
    """How a file stores colour."""

    step: tuple[int, int]  # rows and columns of pixels that share one value of chroma; powers of two
    curves: Tables  # linear light of 65536 evenly spaced file values, by channel
    tables: Tables  # the inverses, of `photo.colour.inverse`

    @classmethod
    def of(cls, step: tuple[int, int], curves: Sequence[NDArray[np.float32]]) -> StoredColour:
        """Make one from the curves of a file."""
        if len(curves) != len(CHANNELS) or any(size < 1 or size & (size - 1) for size in step):
            raise InvalidInputError(
                f"chroma needs three curves and steps that are powers of two, got {len(curves)} and {step}"
            )
        return cls(step, tuple(curves), tuple(inverse(curve) for curve in curves))

    @classmethod
    def of_photo(cls, photo: LinearPhoto) -> StoredColour | None:
        """How the file of a photo stores colour; `None` for a file that is not a JPEG."""
        if photo.info.kind != "jpeg":
            return None
        return cls.of(photo.chroma_step, curves_of(photo.encoding.transfer, photo.encoding.icc))

    def held(self, photo: Planes, restored: Planes) -> Planes:
        """Keep of a correction what the file can show of luma and of chroma.

        With Y and C luma and chroma of file values, F what is kept of the finest detail, and H what the
        file's resolution leaves of chroma::

            Y = Y(photo) + F ( Y(restored) - Y(photo) ),   C = C(photo) + H F ( C(restored) - C(photo) )

        A correction assumes that each colour was measured at every pixel. In a JPEG that holds for luma
        alone: the finest detail of red and blue is that of luma, and colour that a correction adds to it
        comes from rounding and from errors of the kernels, and shows as coloured pixels.
        """
        before, change = np.empty(photo.shape, np.float32), np.empty(photo.shape, np.float32)
        _values(photo, self.tables, before)
        _values(restored, self.tables, change)
        change -= before
        for axis in (-2, -1):
            change = ndimage.convolve1d(change, _FINEST, axis=axis, mode="nearest")
        luma = np.tensordot(_LUMA, change, axes=1)
        # the same linear filter on all three differences: their weighted sum stays zero, and luma what it is
        chroma = self.shown(change - luma)
        _light(before, luma, chroma, self.curves)
        return before

    def shown(self, chroma: NDArray[np.float32]) -> NDArray[np.float32]:
        """Chroma `(..., rows, cols)` as finely as the file shows it."""
        for axis, size in zip((-2, -1), self.step, strict=True):
            for _ in range(size.bit_length() - 1):
                chroma = ndimage.convolve1d(chroma, _PAIRED, axis=axis, mode="nearest")
        return chroma


@jit
def _values(planes: Planes, tables: Tables, out: Planes) -> None:
    """File values of linear light, as `photo.colour.encode` finds them."""
    for c in range(planes.shape[0]):
        table = tables[c]
        last = np.float32(table.size - 1)
        for i in range(planes.shape[1]):
            for j in range(planes.shape[2]):
                light = min(max(planes[c, i, j], np.float32(0.0)), np.float32(1.0))
                out[c, i, j] = table[np.int32(np.sqrt(light) * last + np.float32(0.5))]


@jit
def _light(values: Planes, luma: NDArray[np.float32], chroma: Planes, curves: Tables) -> None:
    """Linear light of file values and their changes, between the codes of the curves, in place."""
    for c in range(values.shape[0]):
        curve = curves[c]
        last = np.float32(curve.size - 1)
        for i in range(values.shape[1]):
            for j in range(values.shape[2]):
                value = values[c, i, j] + luma[i, j] + chroma[c, i, j]
                at = min(max(value, np.float32(0.0)), np.float32(1.0)) * last
                k = min(np.int32(at), np.int32(curve.size - 2))
                values[c, i, j] = curve[k] + (at - np.float32(k)) * (curve[k + 1] - curve[k])
