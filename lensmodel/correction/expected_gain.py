"""What a correction is expected to gain, zone by zone, and what was held back of it."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from lensmodel.core.geometry import zone_of
from lensmodel.core.jit import jit
from lensmodel.core.psf import delta
from lensmodel.core.types import ZONES, Planes, Zone
from lensmodel.correction.audit import AuditReport
from lensmodel.correction.blur import UniformBlur
from lensmodel.correction.deconvolver import Sensor
from lensmodel.correction.methods.wiener import frequency_counts, frequency_squared
from lensmodel.correction.posterior import GRID, WIDEST, PsfPosterior
from lensmodel.correction.tiles.lattice import Cell

WORTH_DB: Final = 0.1
"""Expected gain below which a place is left as it is: a tenth of a decibel is not seen (chosen)."""

_UNKNOWN: Final = 1.0
"""Expected error of a kernel at and above which no gain is predicted: all its power may be error (chosen)."""

_SHARES: Final = (1.0, 0.95, 0.9, 0.8, 0.7, 0.6, 0.5, 0.35, 0.2, 0.1)
"""Shares of a kernel to try; finer steps change the expected error by less than a hundredth."""

_EDGES: Final = (0.05, 0.08, 0.12, 0.17, 0.24)
_MIDDLES: Final = np.sqrt(np.array(_EDGES[1:]) * _EDGES[:-1])
"""Rings of frequencies to which a scene's power is fitted, cycles/pixel: above them demosaicing has a part in
it (chosen)."""

_SLOPES: Final = (2.0, 5.0)
"""Least and greatest slope a: of sharp photographs of detail, and of what is out of focus (chosen)."""

_BLOCKS: Final = 3  # along each side of a tile: enough for a mean (chosen)
_GRID: Final = GRID
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

    def changed(self, photo: Planes, solution: Planes, result: Planes, *, mosaic: bool) -> CellForecast:
        """The forecast of a cell whose `solution` became `result` after limit and audit.

        The error of a posterior mean is orthogonal to it, so the error falls by the mean square of the
        change: by as large a share of what is forecast as is left of the solution's. A mosaic determines less
        than full planes do, for which the forecast is made: there the change itself counts.
        """
        if mosaic:
            fall = min(self._change(photo, result) / self.before, _MOST)
            return replace(self, after=(1.0 - fall) * self.before)
        made = _squared_distance(photo, solution)
        return self.weakened(min(_squared_distance(photo, result) / made, 1.0) if made > 0.0 else 0.0)

    def worth(self, photo: Planes, result: Planes) -> bool:
        """Whether the change of a cell is so large that the error may have fallen by a gain that is seen."""
        return self._change(photo, result) >= (1.0 - 10.0 ** (-0.1 * WORTH_DB)) * self.before

    def _change(self, photo: Planes, result: Planes) -> float:
        """Mean square of a change, in the unit of the errors."""
        return _squared_distance(photo, result) / photo[0].size * _GRID[0] * _GRID[1]

    def weakened(self, share: float) -> CellForecast:
        """The forecast where only this share of the error that was to fall does."""
        return replace(self, after=self.before - share * (self.before - self.after))


@dataclass(frozen=True, slots=True)
class ZoneReport:
    """What the correction is expected to have done in one zone.

    Parameters
    ----------
    cells : int
        Cells of the zone that were corrected.
    expected_gain_db : float or None
        Expected gain in PSNR of linear light against the sharp scene, decibels; may be negative. None where
        the PSFs are too uncertain.
    psf_error : float
        Mean expected relative error of the PSFs.
    left : int
        Cells left as they were, because there was nothing to gain.
    held_back : float
        Mean share of the correction that the audit held back, 0 to 1.
    reasons : tuple of str
        The checks that held something back, the strictest first.
    """

    cells: int
    expected_gain_db: float | None
    psf_error: float
    left: int = 0
    held_back: float = 0.0
    reasons: tuple[str, ...] = field(default=())


@dataclass(frozen=True, slots=True)
class Plan:
    """The share of each channel's kernel to use in a cell (the rest is a point), and the expected error."""

    shares: tuple[float, ...]
    forecast: CellForecast


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

    Parameters
    ----------
    offsets : sequence of tuple of float
        Lateral shift of each channel, `(row, col)` in pixels.
    returned : float
        t.
    """
    before = after = 0.0
    shares: list[float] = []
    times = frequency_counts(_GRID)
    measured = _ring_power(tile)
    for c, (posterior, offset, sensor) in enumerate(zip(posteriors, offsets, sensors, strict=True)):
        point = UniformBlur(delta(1), offset).spectrum(_GRID)
        K = (
            point
            if posterior.kernel.shape[0] > WIDEST
            else UniformBlur(posterior.kernel, offset).spectrum(_GRID)
        )
        power, D = np.maximum(K.real**2 + K.imag**2, _LEAST), posterior.variance
        n = float(sensor.noise.variance(tile[c, ::_EVERY, ::_EVERY]).mean())
        S = scene_power(measured[c], power + D, n)
        before += float((times * (S * ((1.0 - K.real) ** 2 + K.imag**2 + D) + n)).sum())
        remaining = np.empty(len(_SHARES))
        _remaining(K, point, S, D, times, n, np.array(_SHARES), returned, remaining)
        best = int(np.argmin(remaining))
        shares.append(_SHARES[best])
        after += float(remaining[best])
    error = float(np.mean([posterior.error for posterior in posteriors]))
    return Plan(tuple(shares), CellForecast(zone_of(cell.position.r), before, after, error))


@jit
def _remaining(
    K: NDArray[np.complex64],
    point: NDArray[np.complex64],
    S: NDArray[np.float64],
    D: NDArray[np.float32],
    times: NDArray[np.float32],
    noise: float,
    shares: NDArray[np.float64],
    returned: float,
    out: NDArray[np.float64],
) -> None:
    """Expected squared error that each share of a kernel leaves; see `plan`."""
    for number in range(shares.size):
        share, total = shares[number], 0.0
        for i in range(K.shape[0]):
            for j in range(K.shape[1]):
                k, s = complex(K[i, j]), S[i, j]
                mixed = share * k + (1.0 - share) * complex(point[i, j])
                W = mixed.conjugate() * s / max(s * (mixed.real**2 + mixed.imag**2) + noise, _LEAST)
                G = W + returned * (1.0 - mixed * W)
                missed = 1.0 - G * k
                kept = G.real**2 + G.imag**2
                error = s * (missed.real**2 + missed.imag**2 + kept * D[i, j]) + kept * noise
                total += times[i, j] * error
        out[number] = total


def scene_power(
    measured: NDArray[np.float64], transferred: NDArray[np.floating], noise: float
) -> NDArray[np.float64]:
    """Power of the scene behind a blur, S = c |f|^-a, on the `rfft2` grid of `GRID`.

    Scaled so that white noise has its variance as power. c and a are fitted to rings of the photo's own
    spectrum that blur and demosaicing leave intact: a soft scene, or one without detail, has nothing that a
    correction could restore.

    Parameters
    ----------
    measured : ndarray, shape (rings,)
        Mean power of a part of the photo in each ring.
    transferred : ndarray, shape (64, 33)
        Expected |H|² of its blur.
    noise : float
        Variance of its noise.
    """
    transmitted = _rings() @ transferred.ravel().astype(np.float64)
    power = np.maximum(measured - noise, 0.1 * noise + 1e-12) / np.maximum(transmitted, 1e-3)
    x, y = np.log(_MIDDLES), np.log(power)
    # rings with more noise than scene say little about the slope
    weight = 1.0 / (0.05 + (noise / np.maximum(measured, 1e-12)) ** 2)
    weight /= weight.sum()
    mean_x, mean_y = weight @ x, weight @ y
    slope = float(weight @ ((x - mean_x) * (y - mean_y)) / (weight @ (x - mean_x) ** 2))
    slope = min(max(-slope, _SLOPES[0]), _SLOPES[1])
    return np.asarray(math.exp(mean_y + slope * mean_x) * np.exp(-0.5 * slope * _log_squared()))


def _ring_power(planes: Planes) -> NDArray[np.float64]:
    """Mean power of each plane in each ring, `(planes, rings)`; 1 for white noise of variance 1."""
    missing = [max(g - n, 0) for g, n in zip(_GRID, planes.shape[1:], strict=True)]
    if any(missing):
        planes = np.pad(planes, [(0, 0), *((0, m) for m in missing)], "reflect")
    rows, cols = (
        np.linspace(0, n - g, min(max(n // g, 1), _BLOCKS)).astype(int)
        for n, g in zip(planes.shape[1:], _GRID, strict=True)
    )
    blocks = np.stack([planes[:, t : t + _GRID[0], l : l + _GRID[1]] for t in rows for l in cols], axis=1)
    blocks = (blocks - blocks.mean(axis=(2, 3), keepdims=True)) * _window()
    spectra = fft.rfft2(blocks)
    power = (spectra.real**2 + spectra.imag**2).mean(axis=1, dtype=np.float64) / (_GRID[0] * _GRID[1])
    return np.asarray(power.reshape(len(planes), -1) @ _rings().T)


@lru_cache(maxsize=1)
def _window() -> NDArray[np.float32]:
    window = np.outer(*(np.hanning(n + 2)[1:-1] for n in _GRID))
    return np.asarray(window / np.sqrt(np.mean(window**2)), dtype=np.float32)


@lru_cache(maxsize=1)
def _log_squared() -> NDArray[np.float64]:
    """Logarithm of |f|² on the grid; the mean has no power."""
    squared = frequency_squared(_GRID).astype(np.float64)
    squared[0, 0] = np.inf
    return np.log(squared)


@lru_cache(maxsize=1)
def _rings() -> NDArray[np.float64]:
    """Weights of each ring's frequencies, by how often the whole spectrum holds them; their sum is 1."""
    modulus, times = np.sqrt(frequency_squared(_GRID)), frequency_counts(_GRID)
    rings = [times * ((modulus >= low) & (modulus < high)) for low, high in pairwise(_EDGES)]
    return np.array([(ring / ring.sum()).ravel() for ring in rings])


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


@jit
def _squared_distance(a: Planes, b: Planes) -> float:
    total = 0.0
    for c in range(a.shape[0]):
        for i in range(a.shape[1]):
            for j in range(a.shape[2]):
                step = a[c, i, j] - b[c, i, j]
                total += step * step
    return total


def _decibels(before: float, after: float) -> float:
    return 10.0 * math.log10(before / after) if after > 0.0 and before > 0.0 else 0.0
