"""The one audit of a correction: three figures that need no truth; what fails is mixed back."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, TypeAlias

import numpy as np

from lensmodel.core.numerics import jit
from lensmodel.core.types import CHANNELS, Plane, Planes
from lensmodel.correction.blur import ZERO, Real, UniformBlur, block_sums, interpolated, smooth
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.richardson_lucy import LEAST_CLIPPED

Window: TypeAlias = tuple[slice, slice]

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
    """Mean share of a correction that was held back, 0 to 1, and that of each check as if alone."""

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
) -> tuple[Planes, Audit]:
    """Audit the correction of a tile and mix its `inner` part back towards the photo as far as it fails.

    Where all is kept, it is exactly the correction. Without `blurs` nothing is re-blurred; see `kept_shares`.
    """
    keep, checks = kept_shares(photo, restored, blurs, sensors, errors, inner)
    part = (slice(None), *inner)
    before, after = photo[part], restored[part]
    audit = Audit(float(1.0 - keep.mean(dtype=np.float64)), checks)
    return after if keep.min(initial=1.0) == 1.0 else (after - before) * keep + before, audit


def kept_shares(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur] | None,
    sensors: Sequence[Sensor],
    errors: Sequence[float],
    inner: Window,
) -> tuple[Plane, dict[str, float]]:
    r"""Share of the correction of each pixel of `inner` that is kept, and what each check alone holds back.

    With y the photo, x the result, sigma the noise, k the PSF and e its relative error, three figures around
    each place; D_s is the mean power of second differences along rows and columns at a distance of s pixels,
    in units in which white noise has its variance::

        re-blur          r = (y - k * x) / sqrt( sigma² + e² (x - k * x)² ), its root mean square, where the
                         photo was measured and did not clip; where half of that of y - k * y exceeds 1, the
                         share of r in it: a limited result explains less, but no less than the photo itself
        spectrum         sqrt( max D_s(x) / ( max D_s(y) + 4 sigma² ) ) of the mean of the colours, s of x 1
                         or 2, of y 1, 2 or 4: scenes have no more contrast in a fine octave than in a coarse
        isolated pixels  how far x stands out of its 8 neighbours, over 12 sigma and what a point that makes
                         the photo's bump there would

    Of a correction within the limits all is kept, from twice the limit on nothing, and a share between.
    """
    y, x = (np.ascontiguousarray(p, dtype=np.float32) for p in (photo, restored))
    shape = (y.shape[1], y.shape[2])
    noise = np.array([[s.noise.shot, s.noise.read] for s in sensors], dtype=np.float32)
    clip = np.array([min(s.clip, 1e9) for s in sensors], dtype=np.float32)
    keep = np.ones(shape, dtype=np.float32)
    part = (*inner[0].indices(shape[0])[:2], *inner[1].indices(shape[1])[:2])
    spikes = _spikes(y, x, noise, clip, _point_gains(blurs), part, keep)
    checks = {ISOLATED: spikes / keep[inner].size}
    wide = _around(_powers(y, x, noise, clip))
    known = wide[2:5].max(axis=0) + np.float32(_NOISE) * wide[5] + np.float32(1e-12)
    severities = {SPECTRUM: np.sqrt(wide[:2].max(axis=0) / known)}
    if blurs is not None:
        severities[REBLUR] = _misfit(y, x, blurs, sensors, errors)
    blocks = tuple(slice(a // _SIDE, max(-(-b // _SIDE), 1)) for a, b in (part[:2], part[2:]))
    for check, severity in severities.items():
        share = np.clip(
            np.float32(2.0) - severity / np.float32(LIMITS[check]), np.float32(0.0), np.float32(1.0)
        )
        if share.min() < 1.0:
            np.minimum(keep, interpolated(share, _SIDE, *shape), out=keep)
        checks[check] = float(1.0 - share[blocks].mean(dtype=np.float64))
    return keep[inner], checks


def _point_gains(blurs: Sequence[UniformBlur] | None) -> Real:
    """How much more a point stands out of its surroundings than its image does, by colour."""
    if blurs is None:
        return np.full(len(CHANNELS), _USUAL_GAIN, dtype=np.float32)
    gains = []
    for blur in blurs:
        middle = blur.kernel.shape[0] // 2
        low = max(middle - 2, 0)
        mean = float(blur.kernel[low : middle + 3, low : middle + 3].sum() / 25.0)
        gains.append(np.clip(_ROOM / max(blur.kernel[middle, middle] - mean, 1e-6), 1.0, _USUAL_GAIN))
    return np.array(gains, dtype=np.float32)


@jit
def _powers(y: Real, x: Real, noise: Real, clip: Real) -> Real:
    """Sums over blocks of the mean of the colours: D_1, D_2 of x, D_1, D_2, D_4 of y, sigma²."""
    rows, cols = y.shape[1:]
    third, share, rim = np.float32(1.0 / 3.0), np.float32(1.0 / 12.0), _COARSE
    luma = np.empty((2, rows, cols + 2 * rim), np.float32)
    power = np.empty((rows, cols), np.float32)
    for i in range(rows):
        before, after = luma[0, i, rim : rim + cols], luma[1, i, rim : rim + cols]
        for j in range(cols):
            before[j] = third * (y[0, i, j] + y[1, i, j] + y[2, i, j])
            after[j] = third * (
                min(x[0, i, j], clip[0]) + min(x[1, i, j], clip[1]) + min(x[2, i, j], clip[2])
            )
            total = noise[0, 1] + noise[1, 1] + noise[2, 1]
            for c in range(3):
                total += noise[c, 0] * max(y[c, i, j], ZERO)
            power[i, j] = third * third * total
        luma[0, i, :rim], luma[0, i, rim + cols :] = before[0], before[cols - 1]
        luma[1, i, :rim], luma[1, i, rim + cols :] = after[0], after[cols - 1]
    of_noise = block_sums(power, _SIDE)
    sums = np.empty((6, *of_noise.shape), np.float32)
    sums[5] = of_noise
    for kind in range(5):
        plane = luma[1] if kind < 2 else luma[0]
        s = _COARSE if kind == 4 else 1 + kind % 2
        for i in range(rows):
            above, here, below = plane[max(i - s, 0)], plane[i], plane[min(i + s, rows - 1)]
            for j in range(cols):
                two = here[rim + j] + here[rim + j]
                down = above[rim + j] + below[rim + j] - two
                across = here[rim + j - s] + here[rim + j + s] - two
                power[i, j] = share * (down * down + across * across)
        sums[kind] = block_sums(power, _SIDE)
    return sums


@jit
def _spikes(  # noqa: C901 - one pass over the tile, row by row
    y: Real, x: Real, noise: Real, clip: Real, gains: Real, part: tuple[int, int, int, int], keep: Real
) -> float:
    """Lower `keep` around pixels that stand out of a colour; return the sum of what such in `part` lose."""
    rows, cols = keep.shape
    zero, one, limit, most = np.float32(0.0), np.float32(1.0), np.float32(_STANDS_OUT), np.float32(_SPIKE)
    shown, out = np.empty((rows, cols), np.float32), np.zeros(cols, np.float32)
    least, wide = (most * limit) ** 2, _FOOT.size // 2
    held = 0.0
    for c in range(3):
        shot, read = noise[c, 0], noise[c, 1]
        for i in range(rows):
            for j in range(cols):
                shown[i, j] = min(x[c, i, j], clip[c])
        for i in range(1, rows - 1):
            above, here, below = shown[i - 1], shown[i], shown[i + 1]
            for j in range(1, cols - 1):
                top = max(above[j - 1], above[j], above[j + 1], here[j - 1], here[j + 1])
                low = min(above[j - 1], above[j], above[j + 1], here[j - 1], here[j + 1])
                top = max(top, below[j - 1], below[j], below[j + 1])
                low = min(low, below[j - 1], below[j], below[j + 1])
                out[j] = max(here[j] - top, low - here[j], zero)
            for j in range(1, cols - 1):
                variance = max(shot * max(y[c, i, j], zero) + read, np.float32(1e-12))
                if out[j] * out[j] <= least * variance:
                    continue
                window = y[c, max(i - 2, 0) : i + 3, max(j - 2, 0) : j + 3]
                bump = abs(y[c, i, j] - window.sum() / np.float32(window.size))
                figure = out[j] / (gains[c] * bump + most * np.sqrt(variance))
                share = min(max(figure / limit - one, zero), one)
                if part[0] <= i < part[1] and part[2] <= j < part[3]:
                    held += share
                for k in range(max(i - wide, 0), min(i + wide + 1, rows) if share > zero else 0):
                    for l in range(max(j - wide, 0), min(j + wide + 1, cols)):
                        left = one - share * _FOOT[k - i + wide] * _FOOT[l - j + wide]
                        keep[k, l] = min(keep[k, l], left)
    return held


def _misfit(
    y: Planes, x: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor], errors: Sequence[float]
) -> Real:
    """Root mean square of the residual around each block, the most of all colours."""
    rows, cols = y.shape[1:]
    worst = np.zeros((-(-rows // _SIDE), -(-cols // _SIDE)), dtype=np.float32)
    limit = np.float32(LIMITS[REBLUR] ** 2)
    for c, (blur, sensor) in enumerate(zip(blurs, sensors, strict=True)):
        rim = blur.reach
        if min(rows, cols) <= 2 * rim:
            continue  # light from beyond reaches all of it

        inside = slice(rim, rows - rim), slice(rim, cols - rim)

        def spread(plane: Plane, blur: UniformBlur = blur, inside: Window = inside) -> Real:
            out = np.zeros(plane.shape, dtype=np.float32)
            out[inside] = blur.forward(plane)
            return out

        counted = np.zeros((rows, cols), dtype=np.float32)
        counted[inside] = 1.0
        if sensor.measured is not None:
            counted *= sensor.measured
        clipped = y[c] >= np.float32(LEAST_CLIPPED * sensor.clip)
        if clipped.any():
            counted *= spread(clipped.astype(np.float32)) < _GLOW
        error = max(errors[c], _MODEL_ERROR)
        allowed = np.array([sensor.noise.shot, sensor.noise.read, error**2], dtype=np.float32)
        blurred = spread(x[c])
        square = _around(_residual(y[c], x[c], blurred, blurred, counted, allowed)[None])[0]
        number = np.maximum(_around(block_sums(counted, _SIDE)[None])[0], np.float32(1.0))
        if (square > limit * number).any():  # else it does not matter what the photo itself leaves
            own = _residual(y[c], x[c], blurred, spread(y[c]), counted, allowed)
            number = np.maximum(number, _around(own[None])[0] / limit)
        np.maximum(worst, np.sqrt(square / number), out=worst)
    return worst


@jit
def _residual(y: Real, x: Real, blurred: Real, explained: Real, counted: Real, allowed: Real) -> Real:
    """Sums over blocks of squares of what is not `explained` over what may be, where it is `counted`."""
    square = np.empty_like(y)
    for i in range(y.shape[0]):
        for j in range(y.shape[1]):
            left, change = y[i, j] - explained[i, j], x[i, j] - blurred[i, j]
            variance = allowed[0] * max(y[i, j], ZERO) + allowed[1] + allowed[2] * change * change
            square[i, j] = counted[i, j] * left * left / max(variance, np.float32(1e-12))
    return block_sums(square, _SIDE)


def _around(totals: Real) -> Real:
    """Weighted sum over the 9 x 9 blocks around each; zeros outside, so that ratios stay right."""
    out = np.empty_like(totals)
    for figures, into in zip(totals, out, strict=True):
        smooth(figures, _WEIGHTS, into, wrapped=False)
    return out
