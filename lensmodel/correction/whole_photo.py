"""Correct a whole photo in cells of one PSF each, faded into each other: plan, restore, limit, audit."""

from __future__ import annotations

import itertools
import logging
import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cache, lru_cache, partial
from typing import Final, Protocol

import numpy as np
from numba.core import event
from scipy import ndimage

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.psf import PsfField, as_kernel, crop_to_support, delta
from lensmodel.core.registry import Registry
from lensmodel.core.types import (
    CHANNELS,
    ZONES,
    BayerPattern,
    Channel,
    FieldPosition,
    Frame,
    NoiseModel,
    Plane,
    Planes,
    StepHook,
    Zone,
    ignore_step,
    zone_of,
)
from lensmodel.correction.audit import Audit, held_back
from lensmodel.correction.blur import Drift, Real, Sensor, Solution, UniformBlur, Window, fitted_halo
from lensmodel.correction.direct_filter import DirectFilter
from lensmodel.correction.expected_gain import WORTH_DB, CellForecast, PosteriorField, PsfPosterior, plan
from lensmodel.correction.limit import Bounds, StoredColour, limited
from lensmodel.correction.richardson_lucy import SaturationAwareRichardsonLucy
from lensmodel.correction.sparse_gradient import SparseGradient
from lensmodel.photo.lateral import LateralColour


class Deconvolver(Protocol):
    """Non-blind deconvolution of one plane: step 3 of Hirsch and Schölkopf (ICCV 2015, section 7)."""

    def deconvolve(self, blurred: Plane, blur: UniformBlur, *, sensor: Sensor) -> Plane:
        """Estimate the latent plane.

        Parameters
        ----------
        blurred : Plane, shape (H, W), float32
            Linear light, as the photo shows it.
        blur : UniformBlur
            From the latent plane, which is wider than the frame by the reach of the blur, onto the frame.
        sensor : Sensor
            Noise, clipping, and which pixels were measured.

        Returns
        -------
        Plane, shape (H, W), float32
            The latent plane inside the frame, in linear light.
        """


def restore_planes(
    method: Deconvolver, blurred: Planes, blurs: Sequence[UniformBlur], sensors: Sequence[Sensor]
) -> Solution:
    """Restore planes: together if the method has `deconvolve_planes`, else one by one."""
    if isinstance(method, SparseGradient | DirectFilter):
        return method.deconvolve_planes(blurred, blurs, sensors)
    colours = zip(blurred, blurs, sensors, strict=True)
    return Solution(np.stack([method.deconvolve(y, blur, sensor=sensor) for y, blur, sensor in colours]))


deconvolvers: Registry[Deconvolver] = Registry(
    "deconvolver",
    {
        "standard": SparseGradient,
        "paper": partial(SaturationAwareRichardsonLucy, warped=True),  # section 7
        "fast": DirectFilter,
    },
)
"""The deconvolution methods by name."""

KERNEL_SIZE: Final = 55  # pixels: the largest kernel that the paper estimates
_ENOUGH_CELLS, _MORE_CELLS = 24, 96  # to try of a photo: a tenth of the work; where too few decide (chosen)
_SURE_DB: Final = 0.1
_KEPT: Final = 640  # kernels to keep: three rows of cells of 100 megapixels

_UNKNOWN: Final = 1.0
"""Expected error of a kernel at and above which no gain is predicted: all its power may be error (chosen)."""

first_use = logging.getLogger(f"{__name__}.first_use")
"""Says when loops are compiled, during which nothing else happens that a user could see."""


@dataclass(frozen=True, slots=True)
class ZoneReport:
    """What the correction is expected to have done in one zone."""

    cells: int  # cells of the zone that were corrected
    # Expected gain in PSNR of linear light against the sharp scene, decibels; may be negative. None where the
    # PSFs are too uncertain.
    expected_gain_db: float | None
    psf_error: float  # mean expected relative error of the PSFs
    left: int = 0  # cells left as they were, because there was nothing to gain


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """A corrected photo.

    Parameters
    ----------
    planes : Planes, float32, shape (3, height, width)
        The photo, or the requested part of it, in linear light; saturation is 1.
    zones : dict of str to ZoneReport
        What the correction is expected to have gained, in decibels, in each zone of the field that it
        reaches: "center", "mid", "corner".
    audit : Audit
        Which share of the correction was held back, and why.
    chroma_step : tuple of int
        Rows and columns of pixels that share one value of chroma in the photo's file; where that is more than
        one pixel, chroma was corrected no more finely.
    layers : tuple of Planes, each float32 of the shape of `planes`
        The same within the other requested bounds.
    """

    planes: Planes
    zones: dict[Zone, ZoneReport]
    audit: Audit = field(default_factory=Audit)
    chroma_step: tuple[int, int] = (1, 1)
    layers: tuple[Planes, ...] = ()

    @property
    def nothing_to_correct(self) -> bool:
        """Whether every pixel stayed as it was."""
        return all(zone.left == zone.cells for zone in self.zones.values())

    @property
    def expected_gain_db(self) -> float:
        """Gain expected over the whole picture, decibels: the mean of its zones, each by its cells.

        A zone whose PSFs are too uncertain counts as 0.
        """
        cells = sum(zone.cells for zone in self.zones.values())
        gained = sum(zone.cells * (zone.expected_gain_db or 0.0) for zone in self.zones.values())
        return gained / cells if cells else 0.0


def correct_planes(
    planes: Planes,
    field: PsfField | PosteriorField,
    frame: Frame,
    *,
    noise: Sequence[NoiseModel],
    clip: Sequence[float] = (1.0, 1.0, 1.0),
    method: str | Deconvolver = "standard",
    strength: float = 1.0,
    psf_error: float = 0.0,
    lateral: LateralColour | None = None,
    cfa: BayerPattern | None = None,
    bounds: Bounds | None = None,
    layers: Sequence[Bounds] = (),
    unguarded: bool = False,
    least_gain_db: float | None = None,
    stored: StoredColour | None = None,
    processed: bool = False,
    roi: tuple[int, int, int, int] | None = None,
    workers: int = 1,
    pitch: int | None = None,
    on_step: StepHook = ignore_step,
) -> Corrected:
    """Remove the lens blur of a photo, `(3, height, width)` in linear light, saturation 1.

    The frame is cut into cells that are fixed in the field. Each is restored with the PSF of its centre and a
    halo of the PSF's own reach, and faded into its neighbours. Cells are added in a fixed order, so the
    result does not depend on the number of workers to the last bit. `psf_error` is the expected relative L2
    error of the PSFs of a `PsfField`. `lateral` colour becomes part of the red and blue PSFs. Of a mosaic
    `cfa`, what demosaicing filled in is not data, and `noise` is the sensor's. `layers` are further bounds
    within which to correct the photo, for a preview: they share the solution. `unguarded` returns what the
    method makes of the PSFs as they are, as in a paper's own experiments: not for photos to keep. Where
    cells gain less than `least_gain_db`, the photo stays as it is. Of a photo that a camera has sharpened and
    compressed (`processed`), less is corrected the larger the error. `roi`, `(top, left, height, width)`, is
    a part with the same pixels as the whole; `pitch` is the side of a cell in pixels.
    """
    if workers < 1:
        raise InvalidInputError(f"workers must be at least 1, got {workers}")
    job = CorrectionJob(
        planes,
        *_psfs_of(field, psf_error, lateral),
        frame,
        deconvolvers.resolve(method),
        strength,
        noise,
        clip,
        cfa,
        bounds or Bounds(),
        layers,
        unguarded,
        stored,
        processed,
    )
    window = window_of(frame, roi)
    # The C library keeps what a cell frees for the next one, a quarter of the time of "fast": glibc does so
    # for blocks smaller than the largest, up to 32 MiB, that it has seen freed.
    np.empty(31 << 20, dtype=np.uint8)
    tell_of_compiling()
    window_cells = [cell for cell in cells(frame, pitch, job.cell_factor) if cell.meets(window)]
    if least_gain_db is not None:
        unchanged = _unchanged(job, window_cells, window, workers, _ENOUGH_CELLS)
        if abs(unchanged.expected_gain_db - least_gain_db) < _SURE_DB:
            unchanged = _unchanged(job, window_cells, window, workers, _MORE_CELLS)
        if unchanged.expected_gain_db < least_gain_db:
            return unchanged
    out, *layer_planes = np.zeros((1 + len(layers), *planes[:, *window].shape), dtype=np.float32)
    forecasts, audits, left = [], [], Counter[Zone]()
    for done, (cell, restored) in enumerate(_restored(job, window_cells, workers), start=1):
        for into, made in zip((out, *layer_planes), (restored.planes, *restored.layers), strict=True):
            _add(into, window, cell, made)
        forecasts.append(restored.forecast)
        left[restored.forecast.zone] += restored.left
        if restored.audit is not None:
            audits.append(restored.audit)
        on_step(done, len(window_cells))
    step = (1, 1) if stored is None else stored.step
    return Corrected(out, zone_reports(forecasts, left), Audit.mean(audits), step, tuple(layer_planes))


_PosteriorAt = Callable[[FieldPosition, Channel], PsfPosterior]
_BlurAt = Callable[[FieldPosition, Channel, float], UniformBlur]


def _psfs_of(
    field: PsfField | PosteriorField, psf_error: float, lateral: LateralColour | None
) -> tuple[_PosteriorAt, _BlurAt]:
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


def _unchanged(
    job: CorrectionJob, window_cells: Sequence[Cell], window: Window, workers: int, enough: int
) -> Corrected:
    """The photo as it is, with what it would gain by some of its cells."""
    some = window_cells[:: max(1, len(window_cells) // enough)]
    forecasts = [restored.forecast for _, restored in _restored(job, some, workers)]
    left = Counter(forecast.zone for forecast in forecasts)
    return Corrected(np.array(job.planes[:, *window], dtype=np.float32), zone_reports(forecasts, left))


def zone_reports(forecasts: Sequence[CellForecast], left: Mapping[Zone, int]) -> dict[Zone, ZoneReport]:
    """Pool the cells of each zone; zones without a cell are left out."""
    reports: dict[Zone, ZoneReport] = {}
    for zone in ZONES:
        if in_zone := [forecast for forecast in forecasts if forecast.zone == zone]:
            error = sum(f.psf_error for f in in_zone) / len(in_zone)
            pooled = CellForecast(zone, sum(f.before for f in in_zone), sum(f.after for f in in_zone), error)
            known = pooled.gain_db if error < _UNKNOWN else None
            reports[zone] = ZoneReport(len(in_zone), known, error, left.get(zone, 0))
    return reports


def _restored(
    job: CorrectionJob, cells_in_order: Sequence[Cell], workers: int
) -> Iterator[tuple[Cell, RestoredCell]]:
    """Restore cells in order, a few ahead of the one that the caller adds."""
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[tuple[Cell, Future[RestoredCell]]] = deque()
        queue = iter(cells_in_order)
        try:
            while True:
                for cell in itertools.islice(queue, 2 * workers + 1 - len(ahead)):
                    ahead.append((cell, pool.submit(restore_cell, job, cell)))
                if not ahead:
                    return
                first, future = ahead.popleft()
                yield first, future.result()
        finally:
            for _, future in ahead:
                future.cancel()


def _add(out: Planes, window: Window, cell: Cell, restored: Planes) -> None:
    """Add a cell with its weights to the requested window."""
    at, part, weights = [], [], []
    for wanted, own, weight in zip(window, cell.place, (cell.rise, cell.run), strict=True):
        start, stop = max(own.start, wanted.start), min(own.stop, wanted.stop)
        at.append(start - wanted.start)
        part.append(start - own.start)
        weights.append(weight[start - own.start : stop - own.start])
    # strides that a compiler does not know cost more than a copy
    planes = np.ascontiguousarray(restored)
    _add_weighted(out, (at[0], at[1]), weights[0], weights[1], planes, (part[0], part[1]))


@jit
def _add_weighted(
    out: Real, at: tuple[int, int], rise: Real, run: Real, planes: Real, part: tuple[int, int]
) -> None:
    """Add planes from pixel `part` on, times a weight for each row and each column, to `out` from `at` on."""
    for c in range(planes.shape[0]):
        for i in range(rise.size):
            weight, line, into = rise[i], planes[c, part[0] + i], out[c, at[0] + i]
            for j in range(run.size):
                into[at[1] + j] += weight * run[j] * line[part[1] + j]


@cache
def tell_of_compiling() -> None:
    """Log once when Numba compiles; loading from its cache does not count."""

    class CompilationLog(event.Listener):
        tell = staticmethod(cache(first_use.info))  # once

        def on_start(self, started: object) -> None:
            del started
            # as long as on a usual machine, lest the silence look like a fault
            self.tell("compiling the inner loops, once on this machine: about 30 s")

        def on_end(self, ended: object) -> None:
            """The progress display shows the end."""

    event.register("numba:compile", CompilationLog())  # type: ignore[no-untyped-call] # Numba has no types


def window_of(frame: Frame, roi: tuple[int, int, int, int] | None) -> Window:
    """Rows and columns of a part `(top, left, height, width)` of the frame; None is all of it."""
    top, left, height, width = roi or (0, 0, frame.height, frame.width)
    if not (0 <= top < top + height <= frame.height and 0 <= left < left + width <= frame.width):
        raise InvalidInputError(f"roi {roi} does not lie in a photo of {frame.height} x {frame.width}")
    return slice(top, top + height), slice(left, left + width)


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
    posteriors: _PosteriorAt
    blur_at: _BlurAt
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
