"""Correct a whole photo in cells of one PSF each, faded into each other: efficient filter flow."""

from __future__ import annotations

import itertools
import logging
from collections import Counter, deque
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import cache, partial
from typing import Final

import numpy as np
from numba.core import event

from lensmodel.core.errors import InvalidInputError
from lensmodel.core.numerics import jit
from lensmodel.core.psf import PsfField
from lensmodel.core.registry import Registry
from lensmodel.core.types import ZONES, BayerPattern, Frame, NoiseModel, Planes, StepHook, Zone, ignore_step
from lensmodel.correction.audit import Audit
from lensmodel.correction.blur import Real, Window
from lensmodel.correction.cell import Cell, CorrectionJob, RestoredCell, cells, psfs_of, restore_cell
from lensmodel.correction.deconvolver import Deconvolver
from lensmodel.correction.direct_filter import DirectFilter
from lensmodel.correction.expected_gain import CellForecast
from lensmodel.correction.limit import Bounds, StoredColour
from lensmodel.correction.posterior import PosteriorField
from lensmodel.correction.richardson_lucy import SaturationAwareRichardsonLucy
from lensmodel.correction.sparse_gradient import SparseGradient
from lensmodel.photo.lateral import LateralColour

deconvolvers: Registry[Deconvolver] = Registry(
    "deconvolver",
    {
        "standard": SparseGradient,
        "paper": partial(SaturationAwareRichardsonLucy, warped=True),  # section 7
        "fast": DirectFilter,
    },
)
"""The deconvolution methods by name."""

_ENOUGH_CELLS, _MORE_CELLS = 24, 96  # to try of a photo: a tenth of the work; where too few decide (chosen)
_SURE_DB: Final = 0.1

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
        *psfs_of(field, psf_error, lateral),
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
