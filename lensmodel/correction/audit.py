"""The one audit of a correction: three figures that need no truth; what fails is mixed back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final

import numpy as np

from lensmodel.core.numerics import jit
from lensmodel.core.types import CHANNELS, Plane, Planes
from lensmodel.correction.blur import ONE, ZERO, Real, UniformBlur, Window, block_sums, interpolated, smooth
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.richardson_lucy import LEAST_CLIPPED

REBLUR, SPECTRUM, ISOLATED = "re-blur", "spectrum", "isolated pixels"

_STANDS_OUT: Final = 1.5
LIMITS: Final[Mapping[str, float]] = {REBLUR: 2.0, SPECTRUM: 2.0, ISOLATED: _STANDS_OUT}
"""Figures, in the unit of each equation, from which a correction is held back (chosen)."""

_MODEL_ERROR: Final = 0.3
"""Share of what the blur changes that may remain: PSFs change, prior and limit give way at edges (chosen)."""
_GLOW: Final = 0.005
"""Share of a clipped pixel's light beyond which a pixel does not count: lamps are far brighter (chosen)."""
_COARSE: Final = 4  # pixels: lenses leave the power of second differences at this distance alone
_NOISE: Final = 4.0  # times the power of the noise below which no detail is seen (chosen)
_SPIKE: Final = 12.0
"""Standard deviations of noise by which any pixel may stand out (chosen: corrections amplify noise)."""
_ROOM: Final = 1.25  # factor for points that lie a part of a pixel beside the middle of theirs (chosen)
_USUAL_GAIN: Final = 8.0  # of a point behind a PSF of one pixel, and the largest gain to assume

_SIDE: Final = 8  # pixels of a block: that of a JPEG (ITU-T T.81)
_WEIGHTS: Final = np.array([1, 2, 3, 4, 5, 4, 3, 2, 1], dtype=np.float32)
"""Weights of the blocks around one, along rows and columns: a window that fades out (chosen)."""
_FOOT: Final = np.array([0.16, 0.5, 0.84, 1, 1, 1, 0.84, 0.5, 0.16], dtype=np.float32)
"""Share that is held back beside a faulty pixel, along rows and columns (chosen: no edge shows)."""


@dataclass(frozen=True, slots=True)
class Audit:
    """Mean share of a correction that was held back, 0 to 1, and of each check alone; of pixels their sum."""

    held_back: float = 0.0
    checks: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def mean(cls, audits: Sequence[Audit]) -> Audit:
        """The audit of a photo from those of its tiles; a check that held nothing back is left out."""
        if not audits:
            return cls()
        means = {name: float(np.mean([audit.checks.get(name, 0.0) for audit in audits])) for name in LIMITS}
        return cls(
            float(np.mean([audit.held_back for audit in audits])),
            {name: share for name, share in means.items() if share > 0.0},
        )


def held_back(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur] | None,
    sensors: Sequence[Sensor],
    errors: Sequence[float],
    inner: Window,
) -> tuple[Planes, Plane, Audit]:
    r"""Mix the `inner` part of a tile's correction back towards the photo as far as it fails an audit.

    Returned are that part, the share that is kept of each of its pixels, and the audit; where all is kept,
    the part is exactly the correction. Without `blurs` nothing is re-blurred. With y the photo, x the result,
    sigma the noise, k the PSF and e its relative error, three figures around each place; D_s is the mean
    power of second differences along rows and columns at s pixels, in units of the variance of white noise::

        re-blur          r = (y - k * x) / sqrt( sigma² + e² (x - k * x)² ), its root mean square, where the
                         photo was measured and did not clip; where half of that of y - k * y exceeds 1, the
                         share of r in it: a limited result explains less, but no less than the photo itself
        spectrum         sqrt( max D_s(x) / ( max D_s(y) + 4 sigma² ) ) of the mean of the colours, s of x 1
                         or 2, of y 1, 2 or 4: scenes have no more contrast in a fine octave than in a coarse
        isolated pixels  how far x stands out of its 8 neighbours, over 12 sigma and what a point that makes
                         the photo's bump there would

    Of a correction within the limits all is kept, from twice the limit on nothing, and a share between.
    """
    y, x = (np.ascontiguousarray(planes, dtype=np.float32) for planes in (photo, restored))
    shape = (y.shape[1], y.shape[2])
    clip = np.array([min(sensor.clip, 1e9) for sensor in sensors], dtype=np.float32)
    shown = np.minimum(x, clip[:, None, None])
    noise = np.array([[sensor.noise.shot, sensor.noise.read + 1e-12] for sensor in sensors], dtype=np.float32)
    variance = noise[:, :1, None] * np.maximum(y, ZERO) + noise[:, 1:, None]
    before, after = (
        np.maximum.reduce([_around(_second_differences(plane, distance)) for distance in distances])
        for plane, distances in ((y.mean(axis=0), (1, 2, _COARSE)), (shown.mean(axis=0), (1, 2)))
    )
    before += np.float32(_NOISE) * _around(variance.mean(axis=0) / np.float32(3.0))
    severities = {SPECTRUM: np.sqrt(after / before)}
    if blurs is not None:
        severities[REBLUR] = _misfit(y, x, variance, blurs, sensors, errors)
    keep = np.ones(shape, dtype=np.float32)
    spikes = _spikes(y, shown, variance, _point_gains(blurs))
    if spikes.any():
        half, foot = len(_FOOT) // 2, np.outer(_FOOT, _FOOT)
        wide = np.pad(keep, half)
        for c, i, j in np.argwhere(spikes):
            part = wide[i : i + len(_FOOT), j : j + len(_FOOT)]
            np.minimum(part, ONE - spikes[c, i, j] * foot, out=part)
        keep = wide[half:-half, half:-half]
    checks = {ISOLATED: float(spikes[:, *inner].sum(dtype=np.float64) / keep[inner].size)}
    blocks = tuple(slice(part.start // _SIDE, max(-(-part.stop // _SIDE), 1)) for part in inner)
    for check, severity in severities.items():
        share = np.clip(2.0 - severity / LIMITS[check], 0.0, 1.0).astype(np.float32)
        if share.min() < 1.0:
            np.minimum(keep, interpolated(share, _SIDE, *shape), out=keep)
        checks[check] = float(1.0 - share[blocks].mean(dtype=np.float64))
    keep, before, after = keep[inner], photo[:, *inner], restored[:, *inner]
    audit = Audit(float(1.0 - keep.mean(dtype=np.float64)), checks)
    return after if keep.min(initial=1.0) == 1.0 else (after - before) * keep + before, keep, audit


def _point_gains(blurs: Sequence[UniformBlur] | None) -> Real:
    """How much more a point stands out of its surroundings than its image does, by colour."""
    if blurs is None:
        return np.full(len(CHANNELS), _USUAL_GAIN, dtype=np.float32)
    kernels, m = [np.pad(blur.kernel, 2) for blur in blurs], [blur.kernel.shape[0] // 2 for blur in blurs]
    contrast = [k[i + 2, i + 2] - k[i : i + 5, i : i + 5].mean() for k, i in zip(kernels, m, strict=True)]
    return np.clip(_ROOM / np.maximum(contrast, 1e-6), 1.0, _USUAL_GAIN).astype(np.float32)


@jit
def _second_differences(plane: Real, s: int) -> Real:
    """Power of second differences at s pixels, for white noise its variance; the border repeats."""
    rows, cols = plane.shape
    power, share = np.empty((rows, cols), np.float32), np.float32(1.0 / 12.0)
    wide = np.empty(cols + 2 * s, np.float32)
    for i in range(rows):
        above, here, below = plane[max(i - s, 0)], plane[i], plane[min(i + s, rows - 1)]
        wide[:s], wide[s : s + cols], wide[s + cols :] = here[0], here, here[cols - 1]
        for j in range(cols):
            two = here[j] + here[j]
            down, across = above[j] + below[j] - two, wide[j] + wide[j + 2 * s] - two
            power[i, j] = share * (down * down + across * across)
    return power


def _around(plane: Real, rim: int = 0) -> Real:
    """Weighted sums over the 9 x 9 blocks around each; zeros outside, so that ratios stay right."""
    return smooth(block_sums(plane, _SIDE, rim), _WEIGHTS)


@jit
def _spikes(y: Real, shown: Real, variance: Real, gains: Real) -> Real:
    """What each pixel of a colour loses because it stands out."""
    lost, most, limit = np.zeros_like(y), np.float32(_SPIKE), np.float32(_STANDS_OUT)
    least, out = np.square(limit * most), np.empty(y.shape[2], np.float32)
    for c in range(y.shape[0]):
        for i in range(1, y.shape[1] - 1):
            above, here, below = shown[c, i - 1], shown[c, i], shown[c, i + 1]
            for j in range(1, y.shape[2] - 1):
                top = max(above[j - 1], above[j], above[j + 1], here[j - 1], here[j + 1])
                low = min(above[j - 1], above[j], above[j + 1], here[j - 1], here[j + 1])
                top = max(top, below[j - 1], below[j], below[j + 1])
                low = min(low, below[j - 1], below[j], below[j + 1])
                out[j] = max(here[j] - top, low - here[j], ZERO)
            for j in range(1, y.shape[2] - 1):
                if out[j] * out[j] > least * variance[c, i, j]:
                    window = y[c, max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3]
                    bump = abs(y[c, i, j] - window.sum() / np.float32(window.size))
                    figure = out[j] / (gains[c] * bump + most * np.sqrt(variance[c, i, j]))
                    lost[c, i, j] = min(max(figure / limit - ONE, ZERO), ONE)
    return lost


def _misfit(
    y: Planes,
    x: Planes,
    variance: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
) -> Real:
    """Root mean square of the residual around each block, the most of all colours."""
    worst, limit = np.zeros_like(block_sums(y[0], _SIDE)), np.float32(LIMITS[REBLUR] ** 2)
    for c, (blur, sensor) in enumerate(zip(blurs, sensors, strict=True)):
        rim = blur.reach
        if min(y.shape[1:]) <= 2 * rim:
            continue  # light from beyond reaches all of it
        before, after, noise = (blur.frame(planes[c]) for planes in (y, x, variance))
        blurred = blur.forward(x[c])
        counted = np.ones_like(blurred) if sensor.measured is None else blur.frame(sensor.measured * ONE)
        clipped = y[c] >= np.float32(LEAST_CLIPPED * sensor.clip)
        if clipped.any():
            counted = counted * (blur.forward(clipped.astype(np.float32)) < _GLOW)
        error = np.float32(max(errors[c], _MODEL_ERROR))
        weight = counted / (noise + np.square(error * (after - blurred)))
        square = _around(weight * np.square(before - blurred), rim)
        number = np.maximum(_around(counted, rim), ONE)
        if (square > limit * number).any():  # else it does not matter what the photo itself leaves
            own = _around(weight * np.square(before - blur.forward(y[c])), rim)
            number = np.maximum(number, own / limit)
        np.maximum(worst, np.sqrt(square / number), out=worst)
    return worst
