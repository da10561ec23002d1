"""What a correction is expected to gain, zone by zone."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from lensmodel.blur import UniformBlur
from lensmodel.deconv.base import Sensor
from lensmodel.deconv.lattice import Cell
from lensmodel.deconv.wiener import SLOPE, counts, frequency_squared
from lensmodel.geometry import zone_of
from lensmodel.types import ZONES, EdgeGain, Planes, Zone

_GRID = (64, 64)
_EVERY = 3  # of the rows and columns suffice for a variance; odd, so that all colours of a mosaic are met
_SAMPLES = 80  # along a side are enough, whatever its length


@dataclass(frozen=True, slots=True)
class CellForecast:
    """Expected squared error of one cell before and after, and how sure its PSF is."""

    zone: Zone
    before: float
    after: float
    psf_error: float


@dataclass(frozen=True, slots=True)
class ZoneReport:
    """What the correction is expected to have done in one zone.

    Parameters
    ----------
    cells : int
        Cells of the zone that were corrected.
    gain_db : float
        Expected gain in PSNR of linear light against the sharp scene, decibels, never below 0.
    psf_error : float
        Mean expected relative error of the PSFs.
    measured : EdgeGain or None
        What the edges of a chart gained, where the photo shows one; `pipeline.correct_photo` measures it.
    """

    cells: int
    gain_db: float
    psf_error: float
    measured: EdgeGain | None = None


def forecast(
    cell: Cell,
    tile: Planes,
    blurs: Sequence[UniformBlur],
    sensors: Sequence[Sensor],
    errors: Sequence[float],
) -> CellForecast:
    """Squared error of the blurred photo and of the best linear estimate, for a natural scene.

    With the scene's power S::

    before = sum_f S |1 - K|² + n,     after = sum_f S n / (S |K|² + n),   S = c |f|^-2.2
    """
    before = after = 0.0
    shape, times = _scene_power(), counts(_GRID)
    every = max(_EVERY, min(tile.shape[1:]) // _SAMPLES // 2 * 2 + 1)
    for plane, blur, sensor in zip(tile[:, ::every, ::every], blurs, sensors, strict=True):
        noise = float(sensor.noise.variance(plane).mean())
        K = blur.spectrum(_GRID) if blur.kernel.shape[0] <= min(_GRID) else np.ones(shape.shape)
        power = K.real**2 + K.imag**2
        scale = max(float(plane.var()) - noise, 0.0) / float((times * shape * power).sum())
        S, n = scale * shape, noise / float(times.sum())
        before += float((times * (S * ((1.0 - K.real) ** 2 + K.imag**2) + n)).sum())
        after += float((times * S * n / np.maximum(S * power + n, 1e-30)).sum())
    return CellForecast(zone_of(cell.position.r), before, after, float(np.mean(errors)))


@lru_cache(maxsize=1)
def _scene_power() -> NDArray[np.float64]:
    """|f|^-2.2 on the grid of a forecast; nothing at zero."""
    decay = frequency_squared(_GRID).astype(np.float64) ** (SLOPE / 2)
    shape = np.where(decay == decay[0, 0], 0.0, 1.0 / decay)
    shape.setflags(write=False)
    return shape


def zone_reports(forecasts: Sequence[CellForecast]) -> dict[Zone, ZoneReport]:
    """Pool the cells of each zone; zones without a cell are left out."""
    reports: dict[Zone, ZoneReport] = {}
    for zone in ZONES:
        own = [f for f in forecasts if f.zone == zone]
        if not own:
            continue
        before, after = sum(f.before for f in own), sum(f.after for f in own)
        gain = 10.0 * math.log10(before / after) if after > 0.0 and before > 0.0 else 0.0
        error = sum(f.psf_error for f in own) / len(own)
        reports[zone] = ZoneReport(len(own), max(gain, 0.0), error)
    return reports
