"""Colours that a correction may make: those that the photo shows around."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.types import Planes
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.lights.saturation import closed

_UNSURE: Final = 0.1
"""Error of the kernels at and above which no new hue is allowed: the error of one colour then makes hues
(chosen)."""

_NEAR: Final = 2
"""Radius in pixels of the window whose hues a pixel may have (chosen: demosaicing mixes hues over as much; a
wider one holds the hues of other things)."""

_LEAST_LIGHT: Final = 3.0
"""Standard deviations of the noise below which light has no hue (chosen: below, noise decides which colour is
the largest)."""

_STILL_WHITE: Final = np.float32(0.8)
"""Share of a clipped pixel's light at and above which it counts as white: white balance hides what is missing
of one colour down to about there (chosen)."""

_AMID: Final = 5  # side in pixels of a window that is white all over: too far from the light's edge (chosen)

_SOME: Final = np.float32(0.5 / 49.0)  # share of the window of 7 x 7: half a pixel, so less means none

HUE_REACH: Final = 3
"""Radius in pixels of the window whose hues a pixel may have in the end, whatever came before: as far as
lateral colour moves them."""

_PURER: Final = np.float32(0.03)
"""By how much a colour's share of the light may leave the range nearby: colours that blur has washed out get
purer, and three times this shows in a light grey (chosen)."""

_COLOURLESS: Final = np.float32(0.05)
"""Share of the brightest light nearby that is added as grey to every pixel: what is far darker shows no
colour beside it, and has none to lend (chosen)."""


def hue_held(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
) -> Planes:
    """Hold the hue of a result within those of the photo nearby, more so the less certain the kernels are.

    A green kernel that is too wide beside a red one that is too narrow gives every edge a coloured line. The
    light of all colours together stays the same.

    Parameters
    ----------
    photo, restored : Planes, shape (channels, rows, cols)
        A tile, and its correction.
    blurs, sensors : sequence
        By colour; a lateral shift widens what counts as nearby.
    errors : sequence of float
        Expected relative L2 errors of the kernels.
    """
    share = np.float32(min(max(errors) / _UNSURE, 1.0))
    if share == 0.0 or len(photo) == 1:
        return restored
    shift = max(abs(offset) for blur in blurs for offset in blur.offset)
    side = 2 * (_NEAR + int(np.ceil(shift))) + 1
    clipped = np.stack([p >= np.float32(s.clip) for p, s in zip(photo, sensors, strict=True)])
    noise = np.stack([s.variance(p) for p, s in zip(photo, sensors, strict=True)])
    anywhere = np.asarray(clipped.any(axis=0))
    held = of_known_hue(photo, restored, anywhere, noise, (1, side, side))
    return np.where(anywhere, restored, restored + share * (held - restored)).astype(np.float32)


def of_known_hue(
    photo: Planes,
    corrected: Planes,
    clipped: NDArray[np.bool_],
    noise: NDArray[np.float32],
    window: tuple[int, int, int],
) -> Planes:
    """Hold each colour's share of the light within those of the photo in a window; light stays the same.

    Clipped pixels have no hue: all colours at saturation are grey on the sensor and pink in the picture.
    """
    floor = np.float32(_LEAST_LIGHT) * np.sqrt(noise.sum(axis=0)) + np.float32(1e-6)
    known = _shares(photo, floor)
    unknown = np.where(clipped, np.float32(np.inf), known), np.where(clipped, np.float32(-np.inf), known)
    low = np.minimum(ndimage.minimum_filter(unknown[0], window, mode="nearest"), known)
    high = np.maximum(ndimage.maximum_filter(unknown[1], window, mode="nearest"), known)
    light = np.maximum(corrected, np.float32(0.0)).sum(axis=0) + floor
    share = np.clip(_shares(corrected, floor), low, high)
    share /= share.sum(axis=0)
    return np.asarray(share * light - floor / len(corrected), dtype=np.float32)


def hue_bounded(photo: Planes, corrected: Planes, clips: Sequence[float], noise: Sequence[float]) -> Planes:
    """Draw each pixel's hue towards the photo's until the photo has it nearby; light stays the same.

    Bounding one colour at a time, or mixing two results, makes hues that neither has. With s the shares of
    the colours in the light, and s' those of the photo at the same place (where two are clipped, their mean
    nearby)::

        s <- s' + t (s - s'),    0 <= t <= 1 the greatest for which each of s_r, s_g, s_b, s_r - s_g,
                                 s_g - s_b, s_b - s_r is within its range nearby, widened by .03

    Parameters
    ----------
    photo : Planes, shape (channels, rows + 6, cols + 6)
        With `HUE_REACH` pixels around.
    made : Planes, shape (channels, rows, cols)
        The correction of its middle.
    clips, noise : sequence of float
        Level of saturation, and standard deviation of the noise in the dark, by colour.
    """
    if len(corrected) != 3:
        return corrected
    side = 2 * HUE_REACH + 1
    dark = np.float32(_LEAST_LIGHT * float(np.sqrt(np.square(noise).sum())) + 1e-6)
    brightest = ndimage.maximum_filter(np.maximum(photo, np.float32(0.0)).sum(axis=0), side)
    floor = np.maximum(dark, _COLOURLESS * brightest)
    full = [closed(p >= np.float32(clip)) for p, clip in zip(photo, clips, strict=True)]
    clipped = np.sum(full, axis=0) > 1  # one clipped colour leaves the hue that is seen: red paint
    shares = _shares(photo, floor)
    axes = _axes(shares)
    low = ndimage.minimum_filter(np.where(clipped, np.float32(np.inf), axes), (1, side, side))
    high = ndimage.maximum_filter(np.where(clipped, np.float32(-np.inf), axes), (1, side, side))
    inner = (slice(None), slice(HUE_REACH, -HUE_REACH), slice(HUE_REACH, -HUE_REACH))
    low, high, reference = low[inner] - _PURER, high[inner] + _PURER, shares[inner]
    lost = clipped[inner[1:]]
    if lost.any():
        known = ndimage.uniform_filter(np.asarray(~clipped, np.float32), side)
        mean = ndimage.uniform_filter(np.where(clipped, np.float32(0.0), shares), (0, side, side))
        near = np.where(known > _SOME, mean / np.maximum(known, _SOME), shares)[inner]
        reference = np.where(lost, near, reference)
    floor = floor[inner[1:]]
    light = np.maximum(corrected, np.float32(0.0)).sum(axis=0) + floor
    change = _shares(corrected, floor) - reference
    start, step = _axes(reference), _axes(change)
    room = np.where(step > 0.0, high - start, start - low) / np.maximum(np.abs(step), np.float32(1e-6))
    t = np.clip(np.min(np.where(np.isfinite(room), room, np.float32(1.0)), axis=0), 0.0, 1.0)
    bounded = (reference + t * change) * light - floor / len(corrected)
    saturated = np.stack([f[inner[1:]] for f in full])
    level = np.asarray(clips, dtype=np.float32)[:, None, None]
    # what was clipped and still is looks as it did; a pixel amid white that is hardly darker stays white:
    # with the hue of the glow around the light it would be a dot
    same = lost & np.all(~saturated | (corrected >= level), axis=0)
    amid = ndimage.minimum_filter(clipped, _AMID)[inner[1:]]
    white = amid & (corrected.sum(axis=0) >= _STILL_WHITE * photo[inner].sum(axis=0))
    kept = np.where(white & saturated, np.maximum(corrected, np.minimum(photo[inner], level)), corrected)
    return np.where(white | same | (t == 1.0), kept, bounded).astype(np.float32)


def _shares(planes: Planes, floor: NDArray[np.float32] | np.float32) -> Planes:
    """Each colour's share of the light; equal shares where the light drowns in noise."""
    positive = np.maximum(planes, np.float32(0.0))
    return np.asarray((positive + floor / len(planes)) / (positive.sum(axis=0) + floor), dtype=np.float32)


def _axes(shares: Planes) -> NDArray[np.float32]:
    """The shares and their differences: half planes of a hull with twelve sides."""
    return np.concatenate([shares, shares - np.roll(shares, -1, axis=0)])
