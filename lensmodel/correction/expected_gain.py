"""Plan of a correction: which share of each kernel gains most in a cell, and how much, zone by zone."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.core.numerics import jit
from lensmodel.core.psf import delta
from lensmodel.core.types import ZONES, Planes, Zone, zone_of
from lensmodel.correction.audit import AuditReport
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.lattice import Cell
from lensmodel.correction.posterior import GRID, WIDEST, PsfPosterior
from lensmodel.correction.scene_power import (
    frequency_counts,
    noise_power,
    ring_power,
    scene_law,
    scene_power,
    softness,
)
from lensmodel.correction.transforms import Complex, Number, Real

WORTH_DB: Final = 0.1
"""Expected gain below which a place is left as it is: a tenth of a decibel is not seen (chosen)."""

_UNKNOWN: Final = 1.0
"""Expected error of a kernel at and above which no gain is predicted: all its power may be error (chosen)."""

_SHARES: Final = np.array([1.0, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.35, 0.2, 0.1, 0.0], dtype=np.float32)
"""Shares of a kernel to try, the last if all others may harm; finer steps change the error by a hundredth."""

_SHARPER: Final = 3.0
"""Standard deviations z by which the true kernel may be narrower where a scene is out of focus (chosen: with
2, twice as many blocks of a photo out of focus lose by a lens that is known from one such photo)."""

_EVERY: Final = 3  # of the rows and columns suffices for a mean; odd, to meet all colours of a mosaic
_LEAST: Final = 1e-30  # keeps divisions finite, far below any power
_MOST: Final = 0.7
"""Largest share of a mosaic's error that a change is credited with removing (chosen: no correction takes all
of it away, and a change that is larger than the error did something else)."""


@dataclass(frozen=True, slots=True)
class CellForecast:
    """Expected squared error of one cell before and after, and how sure its PSF is."""

    zone: Zone
    before: float
    after: float
    psf_error: float

    @property
    def gain_db(self) -> float:
        """Expected gain in decibels."""
        return _decibels(self.before, self.after)

    def changed(
        self, photo: Planes, solution: Planes, result: Planes, *, mosaic: bool, least: float = WORTH_DB
    ) -> CellForecast | None:
        """The forecast of a cell whose `solution` became `result` after limit and audit.

        The error of a posterior mean is orthogonal to it, so the error falls by the mean square of the
        change: by as large a share of what is forecast as is left of the solution's. A mosaic determines less
        than full planes do, for which the forecast is made: there the change itself counts. None where the
        change is so small that the error cannot have fallen by `least` decibels.
        """
        scale = GRID[0] * GRID[1] / photo[0].size
        change = scale * _squared_distance(photo, result)
        if change < (1.0 - 10.0 ** (-0.1 * least)) * self.before:
            return None
        if mosaic:
            return replace(self, after=(1.0 - min(change / self.before, _MOST)) * self.before)
        made = scale * _squared_distance(photo, solution)
        return self.weakened(min(change / made, 1.0) if made > 0.0 else 0.0)

    def weakened(self, share: float) -> CellForecast:
        """The forecast where only this share of the error that was to fall does."""
        return replace(self, after=self.before - share * (self.before - self.after))


@dataclass(frozen=True, slots=True)
class ZoneReport:
    """What the correction is expected to have done in one zone."""

    cells: int  # cells of the zone that were corrected
    # Expected gain in PSNR of linear light against the sharp scene, decibels; may be negative. None where the
    # PSFs are too uncertain.
    expected_gain_db: float | None
    psf_error: float  # mean expected relative error of the PSFs
    left: int = 0  # cells left as they were, because there was nothing to gain
    held_back: float = 0.0  # mean share of the correction that the audit held back, 0 to 1
    reasons: tuple[str, ...] = ()  # the checks that held something back, the strictest first


@dataclass(frozen=True, slots=True)
class Plan:
    """The share of each channel's kernel to use in a cell (the rest is a point), and the expected error.

    `softness` says how far the scene is out of focus, 0 to 1.
    """

    shares: tuple[float, ...]
    forecast: CellForecast
    softness: float


def plan(
    cell: Cell,
    tile: Planes,
    posteriors: Sequence[PsfPosterior],
    offsets: Sequence[tuple[float, float]],
    sensors: Sequence[Sensor],
    returned: float = 0.0,
) -> Plan:
    """Choose the share of each kernel that leaves the least expected error in this scene.

    With the scene's power S, the noise n, the mean K and the variance D of the transfer function, the share s
    of the kernel (the rest is a point), and the part t of the unexplained residual that is added back
    (in `cell`)::

        K_s = s K + (1 - s),    W = K_s* S / (|K_s|² S + n),    G = W + t (1 - K_s W)
        before = sum_f S ( |1 - K|² + D ) + n,    after = sum_f S ( |1 - G K|² + |G|² D ) + |G|² n

    Detail in focus gains at many frequencies, at which a kernel errs this way and that. What is out of focus
    gains at a few low ones, and is lost there altogether if the kernel is too wide. There no share is taken
    that would do harm if the true kernel were narrower by z standard deviations of its width, short of a
    point, less noise counting as no gain; if all would, s is 0. Nothing fine is there but grain, so t fills
    up what W leaves of it::

        H = K |K|^-min( z D^(1/2) / |K ln |K||, 1 ),    t ( 1 - min( |W|², 1 ) )

    `offsets` are the lateral shifts of the channels, `(row, col)` in pixels; `returned` is t.
    """
    rings = ring_power(tile).mean(axis=1)
    scenes = []
    for c, (posterior, sensor) in enumerate(zip(posteriors, sensors, strict=True)):
        point = UniformBlur(delta(1), offsets[c]).spectrum(GRID)
        known = posterior.kernel.shape[0] <= WIDEST
        K = UniformBlur(posterior.kernel, offsets[c]).spectrum(GRID) if known else point
        noise = float(sensor.variance(tile[c, ::_EVERY, ::_EVERY].mean()))
        seen = noise_power(noise, c, mosaic=sensor.measured is not None)
        law = scene_law(rings[c], K.real**2 + K.imag**2 + posterior.variance, seen)
        scenes.append((K, point, posterior.variance, noise, *law))
    soft = softness(float(np.median([slope for *_, slope in scenes])))
    z = _SHARPER * soft
    before = after = 0.0
    shares: list[float] = []
    for K, point, D, noise, level, slope in scenes:
        left, harm = np.empty((2, _SHARES.size))
        spectra = (K, point, scene_power(level, slope), D, frequency_counts(GRID))
        t, n = np.float32(returned), np.float32(noise)
        before += _remaining(*spectra, n, _SHARES, t, np.float32(soft), np.float32(z), left, harm)
        harmless = harm <= 0.0
        harmless[-1] = not harmless[:-1].any()  # by a point only noise is taken
        best = int(np.argmin(np.where(harmless, left, np.inf)))
        shares.append(float(_SHARES[best]))
        after += float(left[best])
    error = float(np.mean([posterior.error for posterior in posteriors]))
    forecast = CellForecast(zone_of(cell.position.r), before, after, error)
    return Plan(tuple(shares), forecast, soft)


@jit
def _remaining(
    K: Complex,
    point: Complex,
    S: Real,
    D: Real,
    times: Real,
    noise: Number,
    shares: Real,
    returned: Number,
    soft: Number,
    z: Number,
    out: NDArray[np.float64],
    harm: NDArray[np.float64],
) -> float:
    """Expected squared error that each share of a kernel leaves, and, returned, of the photo; see `plan`.

    `harm` receives by how much the error rises if the kernel is narrower by z standard deviations.
    """
    one, least, before = np.float32(1.0), np.float32(_LEAST), np.float64(0.0)
    sharper = np.ones_like(D)  # |H| / |K|
    for i in range(K.shape[0]):
        part = np.float32(0.0)
        for j in range(K.shape[1]):
            a, b = one - K[i, j].real, K[i, j].imag
            part += times[i, j] * (S[i, j] * (a * a + b * b + D[i, j]) + noise)
            if z > np.float32(0.0):
                size = max(np.abs(K[i, j]), np.float32(1e-6))
                width = -np.log(min(size, np.float32(0.9999)))
                sharper[i, j] = np.exp(width * min(z * np.sqrt(D[i, j]) / (size * width), one))
        before += part
    for number in range(shares.size):
        share, total, rise = shares[number], np.float64(0.0), np.float64(0.0)
        for i in range(K.shape[0]):
            part, more = np.float32(0.0), np.float32(0.0)
            for j in range(K.shape[1]):
                a, b, s = K[i, j].real, K[i, j].imag, S[i, j]
                p = share * a + (one - share) * point[i, j].real
                q = share * b + (one - share) * point[i, j].imag
                power = p * p + q * q
                weight = s / max(s * power + noise, least)
                back = returned * (one - soft * min(power * weight * weight, one))
                re, im = p * weight + back * (one - power * weight), -q * weight
                missed, turned = one - re * a + im * b, re * b + im * a
                kept = re * re + im * im
                error = s * (missed * missed + turned * turned + kept * D[i, j]) + kept * noise
                part += times[i, j] * error
                u, v = sharper[i, j] * a, sharper[i, j] * b
                missed, turned = one - re * u + im * v, re * v + im * u
                change = missed * missed + turned * turned - (one - u) * (one - u) - v * v
                more += times[i, j] * (s * change + max(kept - one, np.float32(0.0)) * noise)
            total += part
            rise += more
        out[number] = total
        harm[number] = rise if z > np.float32(0.0) else np.float64(0.0)
    return before


def zone_reports(
    forecasts: Sequence[CellForecast], left: Mapping[Zone, int], audit: AuditReport
) -> dict[Zone, ZoneReport]:
    """Pool the cells of each zone; zones without a cell are left out."""
    reports: dict[Zone, ZoneReport] = {}
    for zone in ZONES:
        in_zone = [f for f in forecasts if f.zone == zone]
        if not in_zone:
            continue
        error = sum(f.psf_error for f in in_zone) / len(in_zone)
        gain = _decibels(sum(f.before for f in in_zone), sum(f.after for f in in_zone))
        held = audit.zones.get(zone)
        reports[zone] = ZoneReport(
            len(in_zone),
            gain if error < _UNKNOWN else None,
            error,
            left=left.get(zone, 0),
            held_back=0.0 if held is None else held.held_back,
            reasons=() if held is None else tuple(sorted(held.checks, key=lambda name: -held.checks[name])),
        )
    return reports


def _squared_distance(a: Planes, b: Planes) -> float:
    return float(np.square(a - b).sum(dtype=np.float64))


def _decibels(before: float, after: float) -> float:
    return 10.0 * math.log10(before / after) if after > 0.0 and before > 0.0 else 0.0
