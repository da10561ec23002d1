"""Correct one cell of a photo, of the lattice fixed in the field: plan, restore, limit, audit."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.psf import as_kernel, delta
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
from lensmodel.correction.blur import Drift, UniformBlur, fitted_halo
from lensmodel.correction.deconvolver import Deconvolver, Sensor, Solution, restore_planes
from lensmodel.correction.expected_gain import WORTH_DB, CellForecast, plan
from lensmodel.correction.limit import Bounds, StoredColour, limited
from lensmodel.correction.posterior import PsfPosterior
from lensmodel.photo.lateral import LateralColour

_CELLS_PER_HALF_DIAGONAL: Final = 18.0
"""Half diagonal over the side of a cell (chosen: 200 pixels at 24 megapixels, where a PSF hardly changes)."""
_MIN_PITCH, _MAX_PITCH = 96, 208
"""Bounds of a cell's side in pixels: smaller ones are all halo, larger ones blur the PSF's change."""
_RAMP: Final = 16  # pixels over which cells fade into each other (chosen: narrower, a seam may show)


_Beside = tuple[FieldPosition, FieldPosition, float]


@dataclass(frozen=True, slots=True)
class Roi:
    """A window of the photo in pixels."""

    top: int
    left: int
    height: int
    width: int

    @classmethod
    def of(cls, frame: Frame, roi: tuple[int, int, int, int] | None) -> Roi:
        """Check a window `(top, left, height, width)` against the frame; None is all of it."""
        if roi is None:
            return cls(0, 0, frame.height, frame.width)
        window = cls(*roi)
        if not (
            0 <= window.top < window.top + window.height <= frame.height
            and 0 <= window.left < window.left + window.width <= frame.width
        ):
            raise InvalidInputError(f"{window} does not lie in a photo of {frame.height} x {frame.width}")
        return window


@dataclass(frozen=True, slots=True, eq=False)
class Cell:
    """One cell: its part of the frame, and its weight there."""

    top: int
    left: int
    rise: NDArray[np.float32]  # weights along the rows; those of all cells sum to one
    run: NDArray[np.float32]  # and along the columns
    position: FieldPosition  # centre of the cell: where its PSF is taken
    middle: tuple[float, float]  # the same as a pixel (row, col)
    # Centres of the cells above and below, and left and right, with the pixels between them; at the border
    # the cell itself stands in for the missing one.
    beside: tuple[_Beside, _Beside]

    @property
    def bottom(self) -> int:
        """Row after the last one."""
        return self.top + len(self.rise)

    @property
    def right(self) -> int:
        """Column after the last one."""
        return self.left + len(self.run)

    def meets(self, roi: Roi) -> bool:
        """Whether the cell has a pixel in `roi`."""
        return (
            self.top < roi.top + roi.height
            and self.bottom > roi.top
            and self.left < roi.left + roi.width
            and self.right > roi.left
        )


def usual_pitch(frame: Frame, factor: int = 1) -> int:
    """Side of a cell in pixels: a fixed share of the field, times `factor`, within practical bounds."""
    share = factor * frame.half_diagonal / _CELLS_PER_HALF_DIAGONAL
    return int(np.clip(share, _MIN_PITCH, factor * _MAX_PITCH))


def cells(frame: Frame, pitch: int | None = None) -> tuple[Cell, ...]:
    """Cut a frame into cells of a side of `pitch` pixels, row by row; a preview has the same as the whole."""
    pitch = usual_pitch(frame) if pitch is None else pitch
    down, across = _pieces(frame.height, pitch), _pieces(frame.width, pitch)
    rows, cols = [piece[2] for piece in down], [piece[2] for piece in across]
    cells = []
    for i, (top, rise, row) in enumerate(down):
        above, below = rows[max(i - 1, 0)], rows[min(i + 1, len(rows) - 1)]
        for j, (left, run, col) in enumerate(across):
            before, after = cols[max(j - 1, 0)], cols[min(j + 1, len(cols) - 1)]
            beside = (
                (frame.position(above, col), frame.position(below, col), below - above),
                (frame.position(row, before), frame.position(row, after), after - before),
            )
            cells.append(Cell(top, left, rise, run, frame.position(row, col), (row, col), beside))
    return tuple(cells)


def _pieces(extent: int, pitch: int) -> list[tuple[int, NDArray[np.float32], float]]:
    """First pixel, weights and centre of each piece of an axis."""
    count = max(1, round(extent / pitch))
    edges = [round(i * extent / count) for i in range(count + 1)]
    half = min(_RAMP // 2, (edges[1] - edges[0]) // 2)
    pieces = []
    for low, high in itertools.pairwise(edges):
        start = low if low == 0 else low - half
        stop = high if high == extent else high + half
        t = np.arange(start, stop, dtype=np.float64)
        weight = np.ones(stop - start)
        if low > 0:
            weight = np.minimum(weight, np.clip((t - low + half + 0.5) / (2 * half), 0.0, 1.0))
        if high < extent:
            weight = np.minimum(weight, np.clip((high + half - t - 0.5) / (2 * half), 0.0, 1.0))
        pieces.append((start, weight.astype(np.float32), (low + high - 1) / 2.0))
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
    posteriors: Callable[[FieldPosition, Channel], PsfPosterior]
    blur_at: Callable[[FieldPosition, Channel, float], UniformBlur]
    frame: Frame
    method: Deconvolver
    strength: float
    noise: Sequence[NoiseModel]
    clip: Sequence[float]
    cfa: BayerPattern | None
    bounds: Bounds
    layers: tuple[Bounds, ...]
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

    def measured(self, channel: int, top: int, left: int, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """Where the sensor measured a channel, on the part of the frame that begins at (top, left)."""
        if self.cfa is None:
            return None
        rows = (np.arange(shape[0]) + top) % 2
        cols = (np.arange(shape[1]) + left) % 2
        return np.asarray(np.asarray(self.cfa)[rows[:, None], cols[None, :]] == channel)

    def blur(self, cell: Cell, channel: Channel, share: float, corner: tuple[int, int]) -> UniformBlur:
        """Kernel of one channel in a cell, and its change within it, on a tile that begins at `corner`."""
        middle = self.blur_at(cell.position, channel, share)
        if self.cell_factor > 1:
            return middle  # used for this cell only
        down, across = (
            (self.blur_at(before, channel, share), self.blur_at(after, channel, share), pixels)
            for before, after, pixels in cell.beside
        )
        origin = (cell.middle[0] - corner[0], cell.middle[1] - corner[1])
        return UniformBlur(middle.kernel, middle.offset, Drift(down, across, origin))

    def strength_at(self, error: float) -> float:
        """Share of a correction to make where the kernel is expected to have this error.

        A camera has sharpened, smoothed and compressed a processed photo: noise no longer tells where a
        change is in vain. A share s of a change that is right gains 1 - (1 - s)² of it; of one that is not,
        the error falls with s².
        """
        return self.strength / (1.0 + (max(error, _BEST) / _HALF) ** 2) if self.processed else self.strength


def _weakened(photo: Planes, restored: Planes, strength: float) -> Planes:
    """Blend a photo with its correction."""
    return restored if strength == 1.0 else photo + np.float32(strength) * (restored - photo)


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


@dataclass(frozen=True, slots=True, eq=False)
class _CellTile:
    """A cell with its halo, cut out of the photo, and what is known about it."""

    cell: Cell
    corner: tuple[int, int]
    photo: Planes
    inner: tuple[slice, slice, slice]
    posteriors: Sequence[PsfPosterior]
    offsets: Sequence[tuple[float, float]]
    sensors: Sequence[Sensor]

    @classmethod
    def of(cls, job: CorrectionJob, cell: Cell) -> _CellTile:
        """Cut the tile of a cell out of a photo."""
        blurs = [job.blur_at(cell.position, channel, 1.0) for channel in CHANNELS]
        reach = max(blur.reach for blur in blurs)
        halo = fitted_halo((len(cell.rise), len(cell.run)), max(_MIN_HALO, reach + _MORE))
        top, left = max(cell.top - halo, 0), max(cell.left - halo, 0)
        part = job.planes[:, top : cell.bottom + halo, left : cell.right + halo]
        tile = np.ascontiguousarray(part, dtype=np.float32)
        edges = (
            cell.top < halo,
            cell.bottom + halo > job.frame.height,
            cell.left < halo,
            cell.right + halo > job.frame.width,
        )
        sensors = [
            Sensor(job.noise[c], job.clip[c], job.measured(c, top, left, plane.shape), edges)
            for c, plane in enumerate(tile)
        ]
        inner = (
            slice(None),
            slice(cell.top - top, cell.bottom - top),
            slice(cell.left - left, cell.right - left),
        )
        posteriors = [job.posteriors(cell.position, channel) for channel in CHANNELS]
        offsets = [blur.offset for blur in blurs]
        return cls(cell, (top, left), tile, inner, posteriors, offsets, sensors)

    @property
    def cell_pixels(self) -> Planes:
        """The cell without its halo."""
        return np.ascontiguousarray(self.photo[self.inner])


def restore_cell(job: CorrectionJob, cell: Cell) -> RestoredCell:
    """Restore one cell, halo cut off again."""
    tile = _CellTile.of(job, cell)

    @lru_cache  # different bounds seldom change the kernels' shares
    def solved(shares: tuple[float, ...]) -> tuple[Sequence[UniformBlur], Solution]:
        blurs = [
            job.blur(cell, channel, share, tile.corner)
            for channel, share in zip(CHANNELS, shares, strict=True)
        ]
        return blurs, restore_planes(job.method, tile.photo, blurs, tile.sensors)

    restored = _within(job, tile, job.bounds, solved)
    layers = tuple(_within(job, tile, bounds, solved).planes for bounds in job.layers)
    return replace(restored, layers=layers) if layers else restored


def _within(
    job: CorrectionJob,
    tile: _CellTile,
    bounds: Bounds,
    solved: Callable[[tuple[float, ...]], tuple[Sequence[UniformBlur], Solution]],
) -> RestoredCell:
    """Restore a tile within bounds, checked; cut its halo off."""
    cell, sensors = tile.cell, tile.sensors
    plans = plan(
        zone_of(cell.position.r), tile.photo, tile.posteriors, tile.offsets, sensors, _SHARE * bounds.texture
    )
    expected = plans.forecast
    worth = expected.gain_db >= WORTH_DB or bounds.denoise > 0.0
    if job.strength == 0.0 or not (worth or job.unguarded):
        return RestoredCell(tile.cell_pixels, replace(expected, after=expected.before), None, left=True)
    blurs, solution = solved((1.0,) * len(CHANNELS) if job.unguarded else plans.shares)
    if job.unguarded:
        made = _weakened(tile.cell_pixels, solution.planes[tile.inner], job.strength)
        return RestoredCell(made, expected, None)
    restored, audit = _checked(job, tile, bounds, blurs, solution, plans.softness)
    photo, least = tile.cell_pixels, WORTH_DB if bounds.denoise == 0.0 else 0.0
    changed = expected.changed(
        photo, solution.planes[tile.inner], restored, mosaic=job.cfa is not None, least=least
    )
    if changed is None:
        # so little passed limit and audit that the rest would smooth the photo, not sharpen it
        return RestoredCell(photo, replace(expected, after=expected.before), audit, left=True)
    strength = job.strength_at(expected.psf_error)
    return RestoredCell(
        _weakened(photo, restored, strength), changed.weakened(strength * (2.0 - strength)), audit
    )


def _checked(
    job: CorrectionJob,
    tile: _CellTile,
    bounds: Bounds,
    blurs: Sequence[UniformBlur],
    solution: Solution,
    softness: float,
) -> tuple[Planes, Audit]:
    """Add back what the prior took, limit, audit; the cell without its halo."""
    photo, sensors, errors = tile.photo, tile.sensors, [posterior.error for posterior in tile.posteriors]
    restored = solution.planes
    if solution.unexplained is not None and bounds.texture > 0.0:
        most = _SHARE if job.cfa is None else 1.0
        share = np.float32(most * bounds.texture) * _texture_share(
            photo, solution.unexplained, sensors, bounds.denoise
        )
        if softness > 0.0:
            share = share * _without_own_grain(photo, restored, softness)
        restored = restored + share * solution.unexplained
    if job.stored is not None:
        restored = job.stored.held(photo, restored)
    restored = limited(photo, restored, blurs, sensors, errors, bounds.halo)
    known = None if job.cell_factor > 1 else blurs  # Wiener's filter leaves no more than noise
    return held_back(photo, restored, known, sensors, errors, tile.inner[1:])


def _without_own_grain(photo: Planes, restored: Planes, softness: float) -> NDArray[np.float32]:
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
) -> NDArray[np.float32] | np.float32:
    """1 where what is unexplained is texture, 1 - denoise where it is noise."""
    if denoise <= 0.0:
        return np.float32(1.0)
    noise = np.mean([s.variance(p) for s, p in zip(sensors, photo, strict=True)], axis=0)
    power = np.square(unexplained).mean(axis=0)
    ratio = ndimage.uniform_filter(power, _WINDOW) / np.maximum(ndimage.uniform_filter(noise, _WINDOW), 1e-12)
    t = np.clip((ratio - _NOISE) / (_TEXTURE - _NOISE), 0.0, 1.0)
    return np.asarray(1.0 - denoise * (1.0 - t * t * (3.0 - 2.0 * t)), dtype=np.float32)


def blur_of(
    posterior: PsfPosterior,
    lateral: LateralColour | None,
    position: FieldPosition,
    channel: Channel,
    share: float,
) -> UniformBlur:
    """Blur of one channel at a place: a share of its kernel, the rest a point, moved by lateral colour.

    The residual of a wrong kernel does not count as noise, or strong edges would be left to the prior, which
    spreads their colour over what lies beside them.
    """
    kernel, offset = posterior.kernel, (0.0, 0.0)
    if share < 1.0:
        kernel = as_kernel(share * kernel + (1.0 - share) * delta(kernel.shape[0]))
    if lateral is not None and channel != "g":
        outwards = lateral.displacement(position.r, channel)
        offset = (-outwards * math.sin(position.phi), outwards * math.cos(position.phi))
    return UniformBlur(kernel, offset)
