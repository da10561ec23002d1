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
from lensmodel.correction.blur import ONE, ZERO, Mask, Number, Real, UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.richardson_lucy import LEAST_CLIPPED, compact
from lensmodel.photo import LinearPhoto
from lensmodel.photo.colour import curves_of, encode, inverse

_REACH: Final = 2
"""Radius of the light that bounds a pixel (chosen: within 1 only a line's blur, further another object)."""
_LEVEL: Final = 0.1
"""Share of the range within which pixels belong to the level beside an edge (chosen: far more than noise)."""
_LINE_SHARE, _EDGE_SHARE = 0.12, 0.25
"""Share of a window at the level of a line, and of an edge (chosen: a line is narrower than its blur)."""
_PURER: Final = 0.01
"""By how much a colour's share may leave the range nearby (chosen: 0 gives dots, twice it spoils foliage)."""
_COLOURLESS: Final = 0.05
"""Share of the brightest light nearby that is added as grey: what is far darker shows no colour (chosen)."""
_OWN_COLOURLESS: Final = 0.02  # the same for the pixel itself (chosen: with more, black letters get green)
_TINY: Final = 1e-5  # light, as seen, below which there is none
_MOST: Final = 12  # pixels of a blur's reach beyond which levels beside an edge are of other things (chosen)
_LAMP: Final = 2.0  # saturations from which solved light is a lamp (chosen: edges overshoot by less)
_PLATEAU: Final = 3
"""Pixels beyond the blur's reach that hold the level beside an edge (chosen: about as many as its width)."""
_SURE: Final = 0.24  # error of a kernel that allows one range of room (chosen: the least that costs no gain)
_MOST_ROOM: Final = 4.0
"""Ranges of room at most (chosen: the least with which dark lines behind exact kernels return)."""
_EDGE, _UNSURE = 0.06, 0.1
"""Share of the range beyond an edge, half a visible halo; error of a kernel below which it grows (chosen)."""
_EXACT: Final = 0.02  # least error of a kernel: none is known better over a whole tile (chosen)
_FREE: Final = 1e6  # stands for no bound where infinity would make sums undefined
_DARKEST: Final = 0.5  # of the darkest light nearby remains where the kernel is unsure (chosen: one stop)
_SIGMAS: Final = 3.0  # of the noise in the dark, added as grey (chosen: below, noise decides on the colour)


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

    It is an edge where a quarter of the window lies at the level that is exceeded. Around what clips, and
    lamps, solved to be twice as bright as saturation, `_beside_lamps` holds each colour. Broad clipped areas
    stay as they are, white ones in all colours, and what is white all around gets no darker. Colour, the
    shares of red, green and blue in the light, is drawn towards the photo's own at the same place until
    their differences lie, but for .01 (up to .04 where the kernel is known), in the photo's range within 2
    pixels; the light stays. At last each colour, as seen, leaves its own range within 2 pixels by no more
    than the span of a line, or by that range if this is more or a lamp is near: where a colour has next to no
    light, its noise shows.

    `halo` is the share of the range that a photographer chose for line and edge.
    """
    error = max(*errors, _EXACT)
    room, edge = widening(error) if halo is None else (min(halo, _FREE),) * 2
    known = max(widening(error)[0], 1.0)
    reach = max(blur.spread for blur in blurs)
    dark = math.hypot(*(sensor.noise.sigma_at(0.0) for sensor in sensors))
    held = np.array(restored, dtype=np.float32, order="C")
    photo = np.ascontiguousarray(photo, dtype=np.float32)
    wide = min(reach, _MOST) + _PLATEAU
    near, number = np.zeros(photo.shape[1:], dtype=np.bool_), np.empty((0, 0), dtype=np.float32)
    clip = np.array([min(sensor.clip, _FREE) for sensor in sensors], dtype=np.float32)
    clipped = photo >= clip[:, None, None]
    solved = (held > np.float32(_LAMP) * clip[:, None, None]).any(axis=0)
    if clipped.any() or solved.any():
        broad = np.stack([plane & ~compact(plane, reach) for plane in clipped])
        white = broad.sum(axis=0) > 1
        number = clipped.sum(axis=0, dtype=np.float32)
        inside = (photo >= np.float32(LEAST_CLIPPED) * clip[:, None, None]).all(axis=0)
        inside = ndimage.binary_erosion(inside, np.ones((3, 3)), border_value=1)
        held[:, inside] = np.maximum(held[:, inside], photo[:, inside])
        glow = wide + max(blur.reach for blur in blurs)  # and what a cut kernel leaves
        near = ndimage.maximum_filter((number > 0) | solved, 2 * glow + 1)
        lamp = ndimage.maximum_filter((number > 1) | solved, 2 * glow + 1)
        glare = ndimage.maximum_filter(white, 2 * (glow // 2) + 1)
        _beside_lamps(photo, held, broad | white, near, lamp, glare)
    darkest = np.float32(_DARKEST * min(error / _SURE, 1.0) if halo is None else 0.0)
    most = _hold_light(photo, held, near, wide, np.float32(room), np.float32(edge), darkest)
    _hold_colour(photo, held, most, number, clip, np.float32(_SIGMAS * dark + 1e-6), np.float32(known))
    if halo is None:
        own = np.where(near, np.float32(1.0), np.float32(known))
        for plane, made, sensor in zip(photo, held, sensors, strict=True):
            _hold_own(plane, made, own, np.float32(_SIGMAS * sensor.noise.sigma_at(0.0)))
    elif halo < _FREE:
        for plane, made in zip(photo, held, strict=True):
            low, high = extremes(plane, plane, _REACH)
            more = np.float32(halo) * (high - low)
            np.clip(made, low - more, high + more, out=made)
    return held


def widening(error: float) -> tuple[float, float]:
    """Shares of the near range by which a line may leave it, and of the far one by which an edge may."""
    return min((_SURE / error) ** 2, _MOST_ROOM), _EDGE * max((_UNSURE / error) ** 2, 1.0)


@jit
def extremes(below: Real, above: Real, reach: int) -> tuple[Real, Real]:
    """Least value of one plane and largest of another in the square around each pixel; rims repeat."""
    rows, cols = below.shape
    low, high = np.empty_like(below), np.empty_like(above)
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
        least[:reach], least[reach + cols :] = line[0], line[cols - 1]
        most[:reach], most[reach + cols :] = top[0], top[cols - 1]
        for k in range(2 * reach + 1):
            for j in range(cols):
                line[j] = min(line[j], least[j + k])
                top[j] = max(top[j], most[j + k])
    return low, high


@jit
def _levels(light: Real, reach: int) -> tuple[Real, Real, Real, Real]:
    """Levels around every second pixel of every second row, as seen, and how much of an edge each makes.

    The first two are the least and most light within `reach` pixels; the others are 1 where a quarter of that
    window lies at this level, 0 where it is a line.
    """
    wide = (reach + 1) // 2
    rows, cols = (light.shape[0] + 1) // 2, (light.shape[1] + 1) // 2
    seen = np.empty((rows, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            total = ZERO
            for k in range(2 * i - 1, 2 * i + 2):
                line = light[min(max(k, 0), light.shape[0] - 1)]
                total += line[max(2 * j - 1, 0)] + line[2 * j] + line[min(2 * j + 1, light.shape[1] - 1)]
            seen[i, j] = np.sqrt(max(total, ZERO) / np.float32(9.0))
    bottom, top = extremes(seen, seen, wide)
    room = np.float32(_LEVEL) * (top - bottom)
    low, high = bottom + room, top - room
    below, above = np.empty_like(seen), np.empty_like(seen)
    padded = np.empty((rows + 2 * wide, cols + 2 * wide), np.float32)
    for i in range(rows + 2 * wide):
        line = seen[min(max(i - wide, 0), rows - 1)]
        padded[i, wide : wide + cols] = line
        padded[i, :wide], padded[i, wide + cols :] = line[0], line[cols - 1]
    side = 2 * wide + 1
    start, full = np.float32(_LINE_SHARE * side**2), np.float32((_EDGE_SHARE - _LINE_SHARE) * side**2)
    dark, bright = np.empty(cols, np.int32), np.empty(cols, np.int32)
    for i in range(rows):
        dark[:] = 0
        bright[:] = 0
        for k in range(side):
            for l in range(side):
                for j in range(cols):
                    dark[j] += np.int32(padded[i + k, j + l] <= low[i, j])
                    bright[j] += np.int32(padded[i + k, j + l] >= high[i, j])
        for j in range(cols):
            below[i, j] = min(max((np.float32(dark[j]) - start) / full, ZERO), ONE)
            above[i, j] = min(max((np.float32(bright[j]) - start) / full, ZERO), ONE)
    return bottom, top, below, above


@jit
def _hold_light(y: Real, x: Real, free: Mask, wide: int, room: Number, edge: Number, darkest: Number) -> Real:
    """Hold the light of `x` within that of `y` nearby, widened, in place, but where it is `free`.

    Return the brightest light within 2 pixels, as seen.
    """
    third, tiny = np.float32(1.0 / 3.0), np.float32(_TINY)
    light = third * (y[0] + y[1] + y[2])
    seen = np.sqrt(np.maximum(light, ZERO))
    least, most = extremes(seen, seen, _REACH)
    bottom, top, below, above = _levels(light, wide)
    for i in range(light.shape[0]):
        for j in range(light.shape[1]):
            a, b = i // 2, j // 2
            line = room * (most[i, j] - least[i, j])
            less = line - min(edge * (top[a, b] - bottom[a, b]), line)
            now = np.sqrt(third * (max(x[0, i, j], ZERO) + max(x[1, i, j], ZERO) + max(x[2, i, j], ZERO)))
            low = max(least[i, j] - line + below[a, b] * less, np.sqrt(darkest) * least[i, j])
            bound = min(max(now, low), most[i, j] + line - above[a, b] * less)
            share = (bound / max(now, tiny)) ** 2
            if free[i, j]:
                continue
            for c in range(3):
                if now < tiny and share > ZERO:
                    x[c, i, j] = y[c, i, j] * bound * bound / max(light[i, j], np.float32(1e-9))
                else:
                    x[c, i, j] *= share
    return most


@jit
def _hold_own(y: Real, x: Real, room: Real, dark: Number) -> None:
    """Hold one colour within its own range within 2 pixels, widened, in place."""
    seen = np.sqrt(np.maximum(y, ZERO) + dark)
    low, high = extremes(seen, seen, _REACH)
    for i in range(y.shape[0]):
        for j in range(y.shape[1]):
            more = room[i, j] * (high[i, j] - low[i, j])
            least, most = max(low[i, j] - more, ZERO), high[i, j] + more
            x[i, j] = min(max(x[i, j], least * least - dark), most * most - dark)


def _beside_lamps(y: Planes, x: Planes, fixed: Mask, near: Mask, lamp: Mask, glare: Mask) -> None:
    """Hold each colour near clipped light and lamps within that of the photo, in place.

    Specks in a dark glow are seen before all else, and darker twigs are not: so the most is that within 1
    pixel, the least that within 3, and within 2 where a `lamp` or what clips in more than one colour is near.
    """
    for before, after, fix in zip(y, x, fixed, strict=True):
        low = np.where(lamp, *(extremes(before, before, reach)[0] for reach in (2, 3)))
        high = np.where(glare, before, extremes(before, before, 1)[1])
        np.copyto(after, np.clip(after, low, high), where=near)
        np.copyto(after, before, where=fix)


@jit
def _shares(planes: Real, floor: Real) -> tuple[Real, Real]:
    """Each colour's share of the light, and their differences, whose ranges are half planes of a hull."""
    third = np.float32(1.0 / 3.0)
    shares, axes = np.empty_like(planes), np.empty_like(planes)
    for i in range(floor.shape[0]):
        for j in range(floor.shape[1]):
            r, g, b = max(planes[0, i, j], ZERO), max(planes[1, i, j], ZERO), max(planes[2, i, j], ZERO)
            grey = third * floor[i, j]
            scale = ONE / (r + g + b + floor[i, j])
            r, g, b = (r + grey) * scale, (g + grey) * scale, (b + grey) * scale
            shares[0, i, j], shares[1, i, j], shares[2, i, j] = r, g, b
            axes[0, i, j], axes[1, i, j], axes[2, i, j] = r - g, g - b, b - r
    return shares, axes


@jit
def _hold_colour(y: Real, x: Real, most: Real, number: Real, clip: Real, dark: Number, known: Number) -> None:
    """Draw the colours of `x` into the range of those of `y` nearby, in place.

    `most` is the brightest light within 2 pixels, as seen, and `number` how many colours clip: of two the hue
    is not known. It is empty where none does.
    """
    purer = np.float32(_PURER) * known
    floor = np.maximum(dark, np.float32(3.0 * _COLOURLESS) * most * most)
    axes = _shares(y, floor)[1]
    low, high = np.empty_like(axes), np.empty_like(axes)
    for k in range(3):
        below, above = axes[k], axes[k]
        if number.size > 0:
            below = np.where(number > ONE, np.float32(_FREE), axes[k])
            above = np.where(number > ONE, np.float32(-_FREE), axes[k])
        low[k], high[k] = extremes(below, above, _REACH)
    floor = np.maximum(dark, min(np.float32(_OWN_COLOURLESS / _COLOURLESS) * known, ONE) * floor)
    own, here = _shares(y, floor)
    made, there = _shares(x, floor)
    t, kept = np.empty(most.shape[1], np.float32), np.zeros(most.shape[1], np.bool_)
    for i in range(most.shape[0]):
        for j in range(t.size if number.size > 0 else 0):
            kept[j] = number[i, j] > ONE and _keeps_colour(y, x, clip, i, j, low, high, own, here)
        t[:] = ONE
        for k in range(3):
            for j in range(t.size):
                step = there[k, i, j] - here[k, i, j]
                room = high[k, i, j] - here[k, i, j] if step > ZERO else here[k, i, j] - low[k, i, j]
                t[j] = min(t[j], (max(room, ZERO) + purer) / max(abs(step), np.float32(1e-6)))
        for j in range(t.size):
            total = max(x[0, i, j], ZERO) + max(x[1, i, j], ZERO) + max(x[2, i, j], ZERO) + floor[i, j]
            grey = np.float32(1.0 / 3.0) * floor[i, j]
            for c in range(3):
                drawn = (own[c, i, j] + t[j] * (made[c, i, j] - own[c, i, j])) * total - grey
                x[c, i, j] = drawn if t[j] < ONE and not kept[j] else x[c, i, j]


@jit
def _keeps_colour(
    y: Real, x: Real, clip: Real, i: int, j: int, low: Real, high: Real, own: Real, axes: Real
) -> bool:
    """Whether a pixel without a hue, because it clipped, keeps that of `x`; else it gets that around it."""
    darker = False
    for c in range(3):
        darker |= y[c, i, j] >= clip[c] and x[c, i, j] < clip[c]
    if not darker:
        return True
    if low[0, i, j] > high[0, i, j]:  # white all around
        for c in range(3):
            x[c, i, j] = max(x[c, i, j], y[c, i, j])
        return True
    for k in range(3):
        axes[k, i, j] = np.float32(0.5) * (low[k, i, j] + high[k, i, j])
    red, green = axes[0, i, j], axes[1, i, j]  # over green, and over blue
    own[0, i, j] = np.float32(1.0 / 3.0) * (ONE + np.float32(2.0) * red + green)
    own[1, i, j] = own[0, i, j] - red
    own[2, i, j] = own[1, i, j] - green
    return False


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
        before, change = (
            np.stack([encode(plane, table) for plane, table in zip(planes, self.tables, strict=True)])
            for planes in (photo, restored)
        )
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
