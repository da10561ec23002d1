"""The cells that a photo is corrected in, and one of them restored: plan, solve, limit, audit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

import numpy as np
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import PsfField, as_kernel, crop_to_support, delta
from lensmodel.core.types import (
    CHANNELS,
    BayerPattern,
    Channel,
    FieldPosition,
    Frame,
    NoiseModel,
    Planes,
    zone_of,
)
from lensmodel.correction.audit import Audit, held_back
from lensmodel.correction.blur import Drift, Real, UniformBlur, Window, fitted_halo
from lensmodel.correction.deconvolver import Deconvolver, Sensor, Solution, restore_planes
from lensmodel.correction.expected_gain import WORTH_DB, CellForecast, plan
from lensmodel.correction.limit import Bounds, StoredColour, limited
from lensmodel.correction.posterior import PosteriorField, PsfPosterior
from lensmodel.photo.lateral import LateralColour

KERNEL_SIZE: Final = 55  # pixels: the largest kernel that the paper estimates
_KEPT: Final = 640  # kernels to keep: three rows of cells of 100 megapixels

PosteriorAt = Callable[[FieldPosition, Channel], PsfPosterior]
BlurAt = Callable[[FieldPosition, Channel, float], UniformBlur]


def psfs_of(
    field: PsfField | PosteriorField, psf_error: float, lateral: LateralColour | None
) -> tuple[PosteriorAt, BlurAt]:
    """What is known of the PSF of one channel at one place; its blur when a share of it is used.

    The rest of the kernel is a point: the residual of a wrong kernel does not count as noise, or strong edges
    would be left to the prior, which spreads their colour over what lies beside them.
    """

    @lru_cache(maxsize=_KEPT)
    def posterior_at(position: FieldPosition, channel: Channel) -> PsfPosterior:
        if isinstance(field, PosteriorField):
            return field.posterior_at(position, channel)
        kernel = crop_to_support(field.kernel_at(position, channel, KERNEL_SIZE))
        return PsfPosterior.of_error(kernel, psf_error)

    @lru_cache(maxsize=_KEPT)
    def blur_at(position: FieldPosition, channel: Channel, share: float) -> UniformBlur:
        kernel, offset = posterior_at(position, channel).kernel, (0.0, 0.0)
        if share < 1.0:
            kernel = as_kernel(share * kernel + (1.0 - share) * delta(kernel.shape[0]))
        if lateral is not None and channel != "g":
            outwards = lateral.displacement(position.r, channel)
            offset = (-outwards * math.sin(position.phi), outwards * math.cos(position.phi))
        return UniformBlur(kernel, offset)

    return posterior_at, blur_at


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One cell: its part of the frame, and its weight there."""

    place: Window
    rise: Real  # weights along the rows; those of all cells sum to one
    run: Real  # and along the columns
    position: FieldPosition  # centre of the cell: where its PSF is taken
    middle: tuple[float, float]  # the same as a pixel (row, col)
    # Centres of the cells above and below, and left and right, with the pixels between them; at the border
    # the cell itself stands in for the missing one.
    beside: Sequence[tuple[FieldPosition, FieldPosition, float]]

    def meets(self, window: Window) -> bool:
        """Whether the cell has a pixel in a window."""
        return all(a.start < b.stop and b.start < a.stop for a, b in zip(self.place, window, strict=True))


_CELLS_PER_HALF_DIAGONAL: Final = 18.0
"""Half diagonal over the side of a cell (chosen: 200 pixels at 24 megapixels, where a PSF hardly changes)."""
_MIN_PITCH, _MAX_PITCH = 96, 208
"""Bounds of a cell's side in pixels: smaller ones are all halo, larger ones blur the PSF's change."""
_RAMP: Final = 16  # pixels over which cells fade into each other (chosen: narrower, a seam may show)


def cells(frame: Frame, pitch: int | None = None, factor: int = 1) -> tuple[Cell, ...]:
    """Cut a frame into cells, row by row; a preview has the same as the whole.

    Their side is `pitch` pixels, or `factor` times a fixed share of the field within practical bounds.
    """
    if pitch is None:
        share = factor * frame.half_diagonal / _CELLS_PER_HALF_DIAGONAL
        pitch = int(np.clip(share, _MIN_PITCH, factor * _MAX_PITCH))
    down, across = _pieces(frame.height, pitch), _pieces(frame.width, pitch)
    cells = []
    for (rows, rise, row, above, below), (cols, run, col, before, after) in itertools.product(down, across):
        beside = (
            (frame.position(above, col), frame.position(below, col), below - above),
            (frame.position(row, before), frame.position(row, after), after - before),
        )
        cells.append(Cell((rows, cols), rise, run, frame.position(row, col), (row, col), beside))
    return tuple(cells)


def _pieces(extent: int, pitch: int) -> list[tuple[slice, Real, float, float, float]]:
    """Pixels and weights of each piece of an axis, its centre, and those of the pieces before and after."""
    count = max(1, round(extent / pitch))
    edges = [round(i * extent / count) for i in range(count + 1)]
    middles = [(low + high - 1) / 2.0 for low, high in itertools.pairwise(edges)]
    half = min(_RAMP // 2, (edges[1] - edges[0]) // 2)
    pieces = []
    for i, (low, high) in enumerate(itertools.pairwise(edges)):
        place = slice(max(low - half, 0), min(high + half, extent))
        t = np.arange(place.start, place.stop, dtype=np.float64)
        weight = np.ones(len(t))
        if low > 0:
            weight = np.minimum(weight, np.clip((t - low + half + 0.5) / (2 * half), 0.0, 1.0))
        if high < extent:
            weight = np.minimum(weight, np.clip((high + half - t - 0.5) / (2 * half), 0.0, 1.0))
        beside = middles[max(i - 1, 0)], middles[min(i + 1, count - 1)]
        pieces.append((place, weight.astype(np.float32), middles[i], *beside))
    return pieces


_MIN_HALO, _MORE = 12, 6  # pixels: least halo of a cell, and beyond the reach of its blur; less costs quality
_SHARE: Final = 0.87
"""Share of what the prior took that comes back: three quarters of the power of its grain (chosen)."""
_HALF, _BEST = 0.5, 0.25
"""Error of a kernel at which half is corrected of a processed photo, and the least that counts (chosen)."""
_WINDOW, _NOISE, _TEXTURE = 7, 1.5, 4.0
"""Pixels; power over that of noise up to which what is unexplained is noise, from which texture (chosen)."""


@dataclass(frozen=True, slots=True, eq=False)
class CorrectionJob:
    """Everything that a cell needs; shared by the threads and never changed."""

    planes: Planes
    posteriors: PosteriorAt
    blur_at: BlurAt
    frame: Frame
    method: Deconvolver
    strength: float
    noise: Sequence[NoiseModel]
    clip: Sequence[float]
    cfa: BayerPattern | None
    bounds: Bounds
    layers: Sequence[Bounds]
    unguarded: bool
    stored: StoredColour | None
    processed: bool

    def __post_init__(self) -> None:
        shape = (len(CHANNELS), self.frame.height, self.frame.width)
        if self.planes.shape != shape:
            raise InvalidInputError(f"planes must be {shape} as the frame says, got {self.planes.shape}")
        if not 0.0 <= self.strength <= 1.0:
            raise InvalidInputError(f"strength must lie in 0..1, got {self.strength}")
        if len(self.noise) != len(CHANNELS) or len(self.clip) != len(CHANNELS):
            raise InvalidInputError(
                f"noise and clip need one entry per channel, got {len(self.noise)} and {len(self.clip)}"
            )

    @property
    def cell_factor(self) -> int:
        """How much larger than usual cells are: then kernels do not change within them."""
        factor: int = getattr(self.method, "cell_factor", 1)
        return factor


@dataclass(frozen=True, slots=True, eq=False)
class RestoredCell:
    """One restored cell: its pixels, the gain expected of them, and the verdict of the audit.

    `left` says that the cell was left as it was; `layers` are its pixels within the job's other bounds.
    """

    planes: Planes
    forecast: CellForecast
    audit: Audit | None
    left: bool = False
    layers: tuple[Planes, ...] = ()


def restore_cell(job: CorrectionJob, cell: Cell) -> RestoredCell:
    """Restore one cell, halo cut off again."""
    tile = _CellTile.of(job, cell)
    restored = tile.within(job.bounds)
    layers = tuple(tile.within(bounds).planes for bounds in job.layers)
    return replace(restored, layers=layers) if layers else restored


@dataclass(frozen=True, slots=True, eq=False)
class _CellTile:
    """A cell with its halo, cut out of the photo, and what is known about it."""

    job: CorrectionJob
    cell: Cell
    corner: tuple[int, int]
    photo: Planes
    inner: Window
    posteriors: Sequence[PsfPosterior]
    offsets: Sequence[tuple[float, float]]
    sensors: Sequence[Sensor]
    # by the shares of the kernels, which different bounds seldom change
    _solutions: dict[tuple[float, ...], tuple[Sequence[UniformBlur], Solution]] = field(default_factory=dict)

    @classmethod
    def of(cls, job: CorrectionJob, cell: Cell) -> _CellTile:
        """Cut the tile of a cell out of a photo."""
        blurs = [job.blur_at(cell.position, channel, 1.0) for channel in CHANNELS]
        reach, (rows, cols) = max(blur.reach for blur in blurs), cell.place
        halo = fitted_halo((len(cell.rise), len(cell.run)), max(_MIN_HALO, reach + _MORE))
        top, left = max(rows.start - halo, 0), max(cols.start - halo, 0)
        part = job.planes[:, top : rows.stop + halo, left : cols.stop + halo]
        tile = np.ascontiguousarray(part, dtype=np.float32)
        edges = (
            rows.start < halo,
            rows.stop + halo > job.frame.height,
            cols.start < halo,
            cols.stop + halo > job.frame.width,
        )
        sites = None
        if job.cfa is not None:
            i, j = ((np.arange(n) + at) % 2 for n, at in zip(tile.shape[1:], (top, left), strict=True))
            sites = np.asarray(job.cfa)[i[:, None], j]
        sensors = [
            Sensor(job.noise[c], job.clip[c], None if sites is None else sites == c, edges) for c in range(3)
        ]
        inner = slice(rows.start - top, rows.stop - top), slice(cols.start - left, cols.stop - left)
        posteriors = [job.posteriors(cell.position, channel) for channel in CHANNELS]
        return cls(job, cell, (top, left), tile, inner, posteriors, [blur.offset for blur in blurs], sensors)

    def within(self, bounds: Bounds) -> RestoredCell:
        """Restore the tile within bounds, checked; cut its halo off."""
        job, photo = self.job, np.ascontiguousarray(self.photo[:, *self.inner])
        zone, returned = zone_of(self.cell.position.r), _SHARE * bounds.texture
        plans = plan(zone, self.photo, self.posteriors, self.offsets, self.sensors, returned)
        expected, least = plans.forecast, WORTH_DB if bounds.denoise == 0.0 else -math.inf
        unchanged = RestoredCell(photo, replace(expected, after=expected.before), None, left=True)
        if job.strength == 0.0 or not (expected.gain_db >= least or job.unguarded):
            return unchanged
        blurs, solution = self._solved((1.0,) * len(CHANNELS) if job.unguarded else plans.shares)
        solved = solution.planes[:, *self.inner]
        if job.unguarded:
            return RestoredCell(_weakened(photo, solved, job.strength), expected, None)
        restored, audit = self._checked(bounds, blurs, solution, plans.softness)
        changed = expected.changed(photo, solved, restored, mosaic=job.cfa is not None, least=max(least, 0.0))
        if changed is None:
            # so little passed limit and audit that the rest would smooth the photo, not sharpen it
            return replace(unchanged, audit=audit)
        # A camera has sharpened, smoothed and compressed a processed photo: noise no longer tells where a
        # change is in vain. A share s of a change that is right gains 1 - (1 - s)² of it; of one that is not,
        # the error falls with s².
        error = max(expected.psf_error, _BEST) / _HALF if job.processed else 0.0
        strength = job.strength / (1.0 + error**2)
        weakened = changed.weakened(strength * (2.0 - strength))
        return RestoredCell(_weakened(photo, restored, strength), weakened, audit)

    def _solved(self, shares: tuple[float, ...]) -> tuple[Sequence[UniformBlur], Solution]:
        """Blurs of these shares of the kernels, and what undoing them makes of the tile."""
        if shares not in self._solutions:
            blurs = [self._blur(*each) for each in zip(CHANNELS, shares, strict=True)]
            solution = restore_planes(self.job.method, self.photo, blurs, self.sensors)
            self._solutions[shares] = blurs, solution
        return self._solutions[shares]

    def _blur(self, channel: Channel, share: float) -> UniformBlur:
        """Kernel of one channel, and its change within the tile."""
        blur_at, cell = self.job.blur_at, self.cell
        middle = blur_at(cell.position, channel, share)
        if self.job.cell_factor > 1:
            return middle  # used for this cell only
        down, across = (
            (blur_at(before, channel, share), blur_at(after, channel, share), pixels)
            for before, after, pixels in cell.beside
        )
        origin = (cell.middle[0] - self.corner[0], cell.middle[1] - self.corner[1])
        return UniformBlur(middle.kernel, middle.offset, Drift(down, across, origin))

    def _checked(
        self, bounds: Bounds, blurs: Sequence[UniformBlur], solution: Solution, softness: float
    ) -> tuple[Planes, Audit]:
        """Add back what the prior took, limit, audit; the cell without its halo."""
        job, photo, sensors = self.job, self.photo, self.sensors
        restored, errors = solution.planes, [posterior.error for posterior in self.posteriors]
        if solution.unexplained is not None and bounds.texture > 0.0:
            share = np.float32((_SHARE if job.cfa is None else 1.0) * bounds.texture) * _texture_share(
                photo, solution.unexplained, sensors, bounds.denoise
            )
            if softness > 0.0:
                share = share * _without_own_grain(photo, restored, softness)
            restored = restored + share * solution.unexplained
        if job.stored is not None:
            restored = job.stored.held(photo, restored)
        restored = limited(photo, restored, blurs, sensors, errors, bounds.halo)
        known = None if job.cell_factor > 1 else blurs  # Wiener's filter leaves no more than noise
        planes, _, audit = held_back(photo, restored, known, sensors, errors, self.inner)
        return planes, audit


def _weakened(photo: Planes, restored: Planes, strength: float) -> Planes:
    """Blend a photo with its correction."""
    return restored if strength == 1.0 else photo + np.float32(strength) * (restored - photo)


def _without_own_grain(photo: Planes, restored: Planes, softness: float) -> Real:
    """1 where the solution lacks the photo's fine contrast, less where it has it in a scene out of focus.

    There nothing fine is but grain, which the inverse of the blur has amplified: more would be too much.
    """
    fine = []
    for planes in (restored, photo):
        light = planes.mean(axis=0)
        fine.append(ndimage.uniform_filter(np.square(light - ndimage.uniform_filter(light, 3)), _WINDOW))
    own = np.clip(fine[0] / np.maximum(fine[1], np.float32(1e-12)), 0.0, 1.0)
    return np.asarray(1.0 - softness * own, dtype=np.float32)


def _texture_share(
    photo: Planes, unexplained: Planes, sensors: Sequence[Sensor], denoise: float
) -> Real | np.float32:
    """1 where what is unexplained is texture, 1 - denoise where it is noise."""
    if denoise <= 0.0:
        return np.float32(1.0)
    noise = np.mean([s.variance(p) for s, p in zip(sensors, photo, strict=True)], axis=0)
    power = np.square(unexplained).mean(axis=0)
    ratio = ndimage.uniform_filter(power, _WINDOW) / np.maximum(ndimage.uniform_filter(noise, _WINDOW), 1e-12)
    t = np.clip((ratio - _NOISE) / (_TEXTURE - _NOISE), 0.0, 1.0)
    return np.asarray(1.0 - denoise * (1.0 - t * t * (3.0 - 2.0 * t)), dtype=np.float32)
