"""What a correction is expected to gain, zone by zone, and what was held back of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import AuditReport
from lensmodel.blur import UniformBlur
from lensmodel.deconv.base import Sensor
from lensmodel.deconv.lattice import Cell
from lensmodel.deconv.wiener import SLOPE, counts, frequency_squared
from lensmodel.geometry import zone_of
from lensmodel.types import ZONES, EdgeGain, Planes, Zone

WORTH_DB: Final = 0.1
"""Expected gain below which a place is left as it is: a tenth of a decibel is not seen (chosen)."""

_UNKNOWN: Final = 0.7
"""Expected error of a kernel from which on no gain is foretold: half of its power is error then (chosen)."""

_GRID: Final = (64, 64)
_EVERY: Final = 3  # of the rows and columns suffice for a variance; odd: all colours of a mosaic are met
_SAMPLES: Final = 80  # along a side are enough, whatever its length
_LEAST: Final = 1e-30


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

    def held(self, share: float) -> CellForecast:
        """The forecast where a share of the correction was held back."""
        return CellForecast(
            self.zone, self.before, self.after + share * (self.before - self.after), self.psf_error
        )


@dataclass(frozen=True, slots=True)
class ZoneReport:
    """What the correction is expected to have done in one zone.

    Parameters
    ----------
    cells : int
        Cells of the zone that were corrected.
    expected_gain_db : float or None
        Expected gain in PSNR of linear light against the sharp scene, decibels; may be negative. None where
        the PSFs are too unsure to tell.
    psf_error : float
        Mean expected relative error of the PSFs.
    measured : EdgeGain or None
        What the edges of a chart gained, where the photo shows one; `pipeline.correct_photo` measures it.
    left : int
        Cells that stayed as they were, because nothing was to be gained.
    held_back : float
        Mean share of the correction that the audit held back, 0 to 1.
    reasons : tuple of str
        The checks that held something back, the one that held back most first.
    """

    cells: int
    expected_gain_db: float | None
    psf_error: float
    measured: EdgeGain | None = None
    left: int = 0
    held_back: float = 0.0
    reasons: tuple[str, ...] = field(default=())


def forecast(
    cell: Cell,
    tile: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
) -> CellForecast:
    """Squared error of the blurred photo and of the best linear estimate, for a natural scene.

    With the scene's power S, the noise n, G = K* S / (|K|² S + n) and D the expected error of |K|²::

        before = sum_f S ( |1 - K|² + D ) + n,     after = sum_f S ( |1 - G K|² + |G|² D ) + |G|² n,
        S = c |f|^-2.2,     D = e² |K|² ln²|K| sum |K|² / sum |K|² ln²|K|

    D has the shape that an error of the width makes, and the size of the kernel's expected error e.
    """
    before = after = 0.0
    shape, times = _scene_power(), counts(_GRID)
    every = max(_EVERY, min(tile.shape[1:]) // _SAMPLES // 2 * 2 + 1)
    for plane, blur, sensor, error in zip(tile[:, ::every, ::every], blurs, sensors, errors, strict=True):
        noise = float(sensor.noise.variance(plane).mean())
        K = blur.spectrum(_GRID) if blur.kernel.shape[0] <= min(_GRID) else np.ones(shape.shape)
        power = np.maximum(K.real**2 + K.imag**2, _LEAST)
        wrong = power * np.log(power) ** 2
        wrong *= error * error * float((times * power).sum()) / max(float((times * wrong).sum()), _LEAST)
        scale = max(float(plane.var()) - noise, 0.0) / float((times * shape * power).sum())
        S, n = scale * shape, noise / float(times.sum())
        G = np.conj(K) * S / np.maximum(S * power + n, _LEAST)
        kept = G.real**2 + G.imag**2
        missed = 1.0 - G * K
        before += float((times * (S * ((1.0 - K.real) ** 2 + K.imag**2 + wrong) + n)).sum())
        after += float((times * (S * (missed.real**2 + missed.imag**2 + kept * wrong) + kept * n)).sum())
    return CellForecast(zone_of(cell.position.r), before, after, float(np.mean(errors)))


@lru_cache(maxsize=1)
def _scene_power() -> NDArray[np.float64]:
    """|f|^-2.2 on the grid of a forecast; nothing at zero."""
    decay = frequency_squared(_GRID).astype(np.float64) ** (SLOPE / 2)
    shape = np.where(decay == decay[0, 0], 0.0, 1.0 / decay)
    shape.setflags(write=False)
    return shape


def zone_reports(
    forecasts: Sequence[CellForecast], left: Mapping[Zone, int], audit: AuditReport
) -> dict[Zone, ZoneReport]:
    """Pool the cells of each zone; zones without a cell are left out."""
    reports: dict[Zone, ZoneReport] = {}
    for zone in ZONES:
        own = [f for f in forecasts if f.zone == zone]
        if not own:
            continue
        error = sum(f.psf_error for f in own) / len(own)
        gain = _decibels(sum(f.before for f in own), sum(f.after for f in own))
        seen = audit.zones.get(zone)
        reports[zone] = ZoneReport(
            len(own),
            gain if error < _UNKNOWN else None,
            error,
            left=left.get(zone, 0),
            held_back=0.0 if seen is None else seen.held_back,
            reasons=() if seen is None else tuple(sorted(seen.checks, key=lambda name: -seen.checks[name])),
        )
    return reports


def _decibels(before: float, after: float) -> float:
    return 10.0 * math.log10(before / after) if after > 0.0 and before > 0.0 else 0.0
