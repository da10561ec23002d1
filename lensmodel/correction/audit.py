"""The one audit of a correction: three figures that need no truth; what fails is mixed back."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

import numpy as np

from lensmodel.core.numerics import jit
from lensmodel.core.types import CHANNELS, ZONES, Plane, Planes, Zone
from lensmodel.correction.blur import Complex, Real, UniformBlur, fast_shape, smooth, through
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

HELD: Final = 0.1
"""Share of a correction from which on a tile counts as held back (chosen: a hundredth is only just seen)."""
_MAPPED: Final = 0.01  # least share held back at which a tile is on the map (chosen: less is not seen)


@dataclass(frozen=True, slots=True, eq=False)
class TileAudit:
    """Mean share of a tile's correction that is held back, 0 to 1, and that of each check as if alone."""

    held_back: float
    checks: Mapping[str, float]


def held_back(
    photo: Planes,
    restored: Planes,
    blurs: Sequence[UniformBlur] | None,
    sensors: Sequence[Sensor],
    errors: Sequence[float],
    inner: Window,
) -> tuple[Planes, TileAudit]:
    """Audit the correction of a tile and mix its `inner` part back towards the photo as far as it fails.

    Where all is kept, it is exactly the correction. Without `blurs` nothing is re-blurred; see `kept_shares`.
    """
    keep, checks = kept_shares(photo, restored, blurs, sensors, errors, inner)
    part = (slice(None), *inner)
    before, after = photo[part], restored[part]
    audit = TileAudit(float(1.0 - keep.mean(dtype=np.float64)), checks)
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
    powers = np.zeros((6, *_blocks(shape)), dtype=np.float32)
    clip = np.array([min(s.clip, 1e9) for s in sensors], dtype=np.float32)
    keep = np.ones(shape, dtype=np.float32)
    part = (*inner[0].indices(shape[0])[:2], *inner[1].indices(shape[1])[:2])
    spikes = _spikes(y, x, noise, clip, _point_gains(blurs), part, keep)
    checks = {ISOLATED: spikes / keep[inner].size}
    _powers(y, x, noise, clip, powers)
    wide = _around(powers)
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
            _lower(keep, share)
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
def _into_blocks(lines: Real, row: int, sums: Real) -> None:
    """Add lines `(kind, cols)` to the row of blocks that holds a row of pixels."""
    for kind in range(lines.shape[0]):
        for block in range(sums.shape[2]):
            total = np.float32(0.0)
            for j in range(8 * block, min(8 * block + 8, lines.shape[1])):
                total += lines[kind, j]
            sums[kind, row // 8, block] += total


@jit
def _powers(y: Real, x: Real, noise: Real, clip: Real, powers: Real) -> None:
    """Sums over blocks of the mean of the colours: D_1, D_2 of x, D_1, D_2, D_4 of y, sigma²."""
    rows, cols = y.shape[1:]
    zero, third, ninth = np.float32(0.0), np.float32(1.0 / 3.0), np.float32(1.0 / 9.0)
    share, rim = np.float32(1.0 / 12.0), _COARSE
    luma = np.empty((2, rows, cols + 2 * rim), np.float32)
    lines = np.zeros((6, cols), np.float32)
    for i in range(rows):
        before, after = luma[0, i, rim : rim + cols], luma[1, i, rim : rim + cols]
        for j in range(cols):
            before[j] = third * (y[0, i, j] + y[1, i, j] + y[2, i, j])
            after[j] = third * (
                min(x[0, i, j], clip[0]) + min(x[1, i, j], clip[1]) + min(x[2, i, j], clip[2])
            )
        luma[0, i, :rim], luma[0, i, rim + cols :] = before[0], before[cols - 1]
        luma[1, i, :rim], luma[1, i, rim + cols :] = after[0], after[cols - 1]
    for i in range(rows):
        for j in range(cols):
            total = noise[0, 1] + noise[1, 1] + noise[2, 1]
            for c in range(3):
                total += noise[c, 0] * max(y[c, i, j], zero)
            lines[5, j] += ninth * total
        for kind in range(5):
            plane = luma[1] if kind < 2 else luma[0]
            s = _COARSE if kind == 4 else 1 + kind % 2
            above, here, below = plane[max(i - s, 0)], plane[i], plane[min(i + s, rows - 1)]
            line = lines[kind]
            for j in range(cols):
                two = here[rim + j] + here[rim + j]
                down = above[rim + j] + below[rim + j] - two
                across = here[rim + j - s] + here[rim + j + s] - two
                line[j] += share * (down * down + across * across)
        if i % 8 == 7 or i == rows - 1:
            _into_blocks(lines, i, powers)
            lines[:] = zero


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
            number = 0
            for j in range(1, cols - 1):
                top = max(above[j - 1], above[j], above[j + 1], here[j - 1], here[j + 1])
                low = min(above[j - 1], above[j], above[j + 1], here[j - 1], here[j + 1])
                top = max(top, below[j - 1], below[j], below[j + 1])
                low = min(low, below[j - 1], below[j], below[j + 1])
                out[j] = max(here[j] - top, low - here[j], zero)
                number += out[j] * out[j] > least * (shot * max(y[c, i, j], zero) + read)
            if number == 0:
                continue
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
    shape = (y.shape[1], y.shape[2])
    grid = fast_shape(tuple(max(extent, blurs[0].kernel.shape[0]) for extent in shape))
    worst = np.zeros(_blocks(shape), dtype=np.float32)
    limit = np.float32(LIMITS[REBLUR] ** 2)
    for c, (blur, sensor) in enumerate(zip(blurs, sensors, strict=True)):
        K = blur.spectrum(grid)
        scratch = np.empty_like(K)

        def spread(plane: Plane, K: Complex = K, scratch: Complex = scratch) -> Real:
            """A plane as the blur shows it, on its canvas."""
            work = np.zeros(grid, dtype=np.float32)
            work[: shape[0], : shape[1]] = plane
            through(work, scratch, K, forward=True, first=0, last=shape[0], begin=0, end=shape[0])
            return work

        rim = min(blur.reach, (min(shape) - 1) // 2)
        counted = np.zeros(shape, dtype=np.float32)
        counted[rim : shape[0] - rim, rim : shape[1] - rim] = 1.0
        if sensor.measured is not None:
            counted *= sensor.measured
        clipped = y[c] >= np.float32(LEAST_CLIPPED * sensor.clip)
        if clipped.any():
            counted *= spread(clipped)[: shape[0], : shape[1]] < _GLOW
        error = max(errors[c], _MODEL_ERROR)
        allowed = np.array([sensor.noise.shot, sensor.noise.read, error**2], dtype=np.float32)
        blurred = spread(x[c])
        sums = np.zeros((2, *worst.shape), dtype=np.float32)
        _residual(y[c], x[c], blurred, blurred, counted, allowed, sums)
        square, number = _around(sums)
        number = np.maximum(number, np.float32(1.0))
        if (square > limit * number).any():  # else it does not matter what the photo itself leaves
            sums[:] = 0.0
            _residual(y[c], x[c], blurred, spread(y[c]), counted, allowed, sums)
            number = np.maximum(number, _around(sums)[0] / limit)
        np.maximum(worst, np.sqrt(square / number), out=worst)
    return worst


@jit
def _residual(
    y: Real, x: Real, blurred: Real, explained: Real, counted: Real, allowed: Real, sums: Real
) -> None:
    """Sums over blocks of squares of what is not `explained` over what may be, and of what counts."""
    rows, cols = y.shape
    lines = np.zeros((2, cols), np.float32)
    for i in range(rows):
        for j in range(cols):
            left, change = y[i, j] - explained[i, j], x[i, j] - blurred[i, j]
            variance = allowed[0] * max(y[i, j], np.float32(0.0)) + allowed[1] + allowed[2] * change * change
            lines[0, j] += counted[i, j] * left * left / max(variance, np.float32(1e-12))
            lines[1, j] += counted[i, j]
        if i % 8 == 7 or i == rows - 1:
            _into_blocks(lines, i, sums)
            lines[:] = np.float32(0.0)


def _blocks(shape: tuple[int, int]) -> tuple[int, int]:
    return -(-shape[0] // _SIDE), -(-shape[1] // _SIDE)


def _around(totals: Real) -> Real:
    """Weighted sum over the 9 x 9 blocks around each; zeros outside, so that ratios stay right."""
    out = np.empty_like(totals)
    for figures, into in zip(totals, out, strict=True):
        smooth(figures, _WEIGHTS, into, wrapped=False)
    return out


@jit
def _lower(keep: Real, shares: Real) -> None:
    """Lower `keep` to the shares of blocks, interpolated between their middles, in place."""
    rows, cols = shares.shape
    line = np.empty(cols, np.float32)
    for i in range(keep.shape[0]):
        at = min(max((i - 3.5) / 8.0, 0.0), rows - 1.0)
        a = min(int(at), max(rows - 2, 0))
        t, b = np.float32(at - a), min(a + 1, rows - 1)
        for j in range(cols):
            line[j] = shares[a, j] + t * (shares[b, j] - shares[a, j])
        for j in range(keep.shape[1]):
            at = min(max((j - 3.5) / 8.0, 0.0), cols - 1.0)
            a = min(int(at), max(cols - 2, 0))
            keep[i, j] = min(
                keep[i, j], line[a] + np.float32(at - a) * (line[min(a + 1, cols - 1)] - line[a])
            )


@dataclass(frozen=True, slots=True)
class HeldTile:
    """A tile of the photo, by its first pixel, and the share of its correction that was held back."""

    row: int
    col: int
    held_back: float


@dataclass(frozen=True, slots=True)
class ZoneAudit:
    """What was held back in one zone."""

    tiles: int  # how many were audited
    tiles_held: int  # those of which more than a tenth was held back
    held_back: float  # mean share of the correction that was held back, 0 to 1
    checks: Mapping[str, float]  # the same by check, each as if alone; only those that held something back


@dataclass(frozen=True, slots=True)
class AuditReport:
    """What the audit of a photo held back, why, and where."""

    zones: Mapping[Zone, ZoneAudit]  # zones without a tile are left out
    tiles: tuple[HeldTile, ...] = ()  # the map: those of which at least a hundredth was held back
    tile_side: int = 0  # side of the square in pixels that a tile stands for; 0 where it is not known

    @property
    def held_back(self) -> float:
        """Mean share of the correction that was held back, all tiles together."""
        tiles = sum(zone.tiles for zone in self.zones.values())
        return sum(zone.tiles * zone.held_back for zone in self.zones.values()) / tiles if tiles else 0.0


def pooled(audits: Iterable[tuple[Zone, tuple[int, int], TileAudit]], tile_side: int = 0) -> AuditReport:
    """Pool the audits of tiles, each with its zone and its first pixel in the photo."""
    listed = list(audits)
    zones = {
        zone: _zone(in_zone)
        for zone in ZONES
        if (in_zone := [audit for name, _, audit in listed if name == zone])
    }
    held = tuple(
        HeldTile(top, left, audit.held_back) for _, (top, left), audit in listed if audit.held_back >= _MAPPED
    )
    return AuditReport(zones, held, tile_side)


def _zone(audits: list[TileAudit]) -> ZoneAudit:
    shares = [audit.held_back for audit in audits]
    checks = {name: float(np.mean([audit.checks.get(name, 0.0) for audit in audits])) for name in LIMITS}
    return ZoneAudit(
        len(audits),
        sum(share > HELD for share in shares),
        float(np.mean(shares)),
        {name: share for name, share in checks.items() if share > 0.0},
    )
