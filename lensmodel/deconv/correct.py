"""Correct a whole photo: cells of one PSF each, faded into each other."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from lensmodel.audit import AuditReport, Evidence, TileAudit, held_back, pooled
from lensmodel.blur import Drift, UniformBlur, crop_to_support
from lensmodel.deconv.base import CoarseMethod, Deconvolver, Sensor, restore_planes
from lensmodel.deconv.beside_clipped import held_beside_clipped
from lensmodel.deconv.canvas import fitted_halo
from lensmodel.deconv.engine import compiled, keep_freed_memory
from lensmodel.deconv.hue import hue_held
from lensmodel.deconv.lattice import Cell, Roi, cells, usual_pitch
from lensmodel.deconv.limits import Bounds
from lensmodel.deconv.methods import deconvolvers
from lensmodel.deconv.report import WORTH_DB, CellForecast, ZoneReport, forecast, zone_reports
from lensmodel.deconv.texture import texture_kept
from lensmodel.errors import InvalidInputError
from lensmodel.geometry import Frame, zone_of
from lensmodel.psf import PsfField, as_kernel, delta
from lensmodel.types import (
    CHANNELS,
    BayerPattern,
    Channel,
    FieldPosition,
    Kernel,
    NoiseModel,
    Planes,
    StepHook,
    Zone,
    ignore_step,
)

PsfError = Callable[[FieldPosition, Channel], float] | float
"""Relative L2 error that the PSF is expected to have, everywhere or by place and channel."""


class LateralShift(Protocol):
    """Lateral colour of a lens: how far red and blue images lie from the green one."""

    def displacement(self, r: float, channel: Channel) -> float:
        """Pixels outwards by which a channel's image of a point lies beyond the green one, at r."""


KERNEL_SIZE = 55
_SURE, _LOST = 0.5, 0.8
"""Expected errors of a kernel up to which a correction is trusted, and from which on not at all (chosen)."""
MIN_HALO, MORE = 12, 6
"""Least halo of a cell in pixels, and pixels beyond the reach of its blur: less costs quality."""


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """A corrected photo.

    Parameters
    ----------
    planes : Planes
        The photo, or the part of it that was asked for.
    zones : Mapping[Zone, ZoneReport]
        What the correction is expected to have gained in each zone of the field.
    audit : AuditReport
        What was held back of it, why, and where most.
    """

    planes: Planes
    zones: dict[Zone, ZoneReport]
    audit: AuditReport = field(default_factory=lambda: pooled(()))

    @property
    def nothing_to_correct(self) -> bool:
        """Whether every pixel stayed as it was."""
        return all(zone.left == zone.cells for zone in self.zones.values())


@dataclass(frozen=True, slots=True, eq=False)
class _Job:
    """Everything that a cell needs; shared by the threads and never changed."""

    planes: Planes
    blurs: Callable[[FieldPosition, Channel, float], UniformBlur]
    frame: Frame
    method: Deconvolver
    strength: float
    noise: Sequence[NoiseModel]
    clip: Sequence[float]
    psf_error: PsfError
    cfa: BayerPattern | None
    bounds: Bounds
    cell_factor: int

    def __post_init__(self) -> None:
        wanted = (len(CHANNELS), self.frame.height, self.frame.width)
        if self.planes.shape != wanted:
            raise InvalidInputError(f"planes must be {wanted} as the frame says, got {self.planes.shape}")
        if not 0.0 <= self.strength <= 1.0:
            raise InvalidInputError(f"strength must lie in 0..1, got {self.strength}")
        if len(self.noise) != len(CHANNELS) or len(self.clip) != len(CHANNELS):
            raise InvalidInputError(
                f"noise and clip need one entry per channel, got {len(self.noise)} and {len(self.clip)}"
            )

    def measured(self, channel: int, top: int, left: int, shape: tuple[int, ...]) -> NDArray[np.bool_] | None:
        """Where the sensor measured a channel, on the part of the frame that begins at (top, left)."""
        if self.cfa is None:
            return None
        rows = (np.arange(shape[0]) + top) % 2
        cols = (np.arange(shape[1]) + left) % 2
        return np.asarray(np.asarray(self.cfa)[rows[:, None], cols[None, :]] == channel)

    def uncertainty(self, position: FieldPosition, channel: Channel) -> float:
        """Expected relative error of the PSF here."""
        value = self.psf_error(position, channel) if callable(self.psf_error) else self.psf_error
        if not (math.isfinite(value) and value >= 0.0):
            raise InvalidInputError(f"psf_error must be finite and not negative, got {value} at {position}")
        return float(value)

    def blur(self, cell: Cell, channel: Channel, error: float, corner: tuple[int, int]) -> UniformBlur:
        """Kernel of one channel in a cell, and how it changes there, on a tile that begins at `corner`."""
        middle = self.blurs(cell.position, channel, error)
        if self.cell_factor > 1:
            return UniformBlur(middle.kernel, middle.offset)  # its spectra go with the cell
        down, across = (
            (self.blurs(before, channel, error), self.blurs(after, channel, error), pixels)
            for before, after, pixels in cell.beside
        )
        origin = (cell.middle[0] - corner[0], cell.middle[1] - corner[1])
        return UniformBlur(middle.kernel, middle.offset, Drift(down, across, origin))

    def reach(self, position: FieldPosition, channel: Channel, error: float) -> int:
        """How far the blur of a place reaches, in pixels."""
        return self.blurs(position, channel, error).reach


@dataclass(frozen=True, slots=True, eq=False)
class _Restored:
    """One cell as it leaves: its pixels, what they should have gained, and what the audit said of them."""

    planes: Planes
    forecast: CellForecast
    audit: TileAudit | None
    left: bool = False


def correct_planes(
    planes: Planes,
    field: PsfField,
    frame: Frame,
    *,
    noise: Sequence[NoiseModel],
    clip: Sequence[float] = (1.0, 1.0, 1.0),
    method: str | Deconvolver = "standard",
    strength: float = 1.0,
    psf_error: PsfError = 0.0,
    lateral: LateralShift | None = None,
    cfa: BayerPattern | None = None,
    bounds: Bounds | None = None,
    roi: Roi | tuple[int, int, int, int] | None = None,
    workers: int = 1,
    pitch: int | None = None,
    out: Planes | None = None,
    on_step: StepHook = ignore_step,
) -> Corrected:
    """Remove the lens blur of a photo.

    The frame is cut into cells that are fixed in the field. Each is restored with the PSF of its
    centre and a halo of the PSF's own reach, and faded into its neighbours. Cells are added in a
    fixed order, so the result does not depend on the number of workers to the last bit.

    Parameters
    ----------
    planes : Planes, shape (3, height, width)
        Linear light, saturation 1; may be memory-mapped.
    field : PsfField
        The lens.
    frame : Frame
        Size of the photo.
    noise : sequence of NoiseModel
        One per channel.
    clip : sequence of float
        Level per channel from which on a value is only a lower bound.
    method : str or Deconvolver
        A name in `deconvolvers`, or a method of your own.
    strength : float
        0 leaves the photo as it is, 1 applies what the noise allows.
    psf_error : float or callable
        Expected relative L2 error of the PSF: the more, the more of a point is mixed into it, and the less
        is allowed beside edges.
    lateral : LateralShift or None
        Lateral colour to remove in the same step: it becomes part of the red and blue PSFs, so
        nothing is interpolated. Leave it out where the planes were resampled before.
    cfa : BayerPattern or None
        The mosaic on which the planes were measured; what demosaicing filled in is then no datum, and
        "standard" and "fast" demosaic and deblur in one. `noise` is that of the sensor then.
    bounds : Bounds or None
        What to allow beside edges and in flat areas; None lets `psf_error` decide.
    roi : tuple of int or None
        `(top, left, height, width)`: return only this part, with the same pixels as the whole.
    workers : int
        Threads.
    pitch : int or None
        Side of a cell in pixels; None chooses.
    out : Planes or None
        Where to write, for instance memory-mapped; zeroed first. None allocates.
    on_step : StepHook
        Called after each cell; may raise to stop.

    Returns
    -------
    Corrected

    Raises
    ------
    InvalidInputError
        If shapes, strength, window or worker count make no sense.
    UnknownMethodError
        If `method` is in no registry.
    """
    if workers < 1:
        raise InvalidInputError(f"workers must be at least 1, got {workers}")
    solver = deconvolvers.create(method) if isinstance(method, str) else method
    job = _Job(
        planes,
        _blurs_of(field, lateral),
        frame,
        solver,
        strength,
        tuple(noise),
        tuple(clip),
        psf_error,
        cfa,
        bounds or Bounds(),
        # Kernels do not change within cells that are larger than usual.
        solver.cell_factor if isinstance(solver, CoarseMethod) and cfa is None else 1,
    )
    window = Roi.of(frame, roi)
    keep_freed_memory()
    out = _zeroed(out, (len(CHANNELS), window.height, window.width))
    if pitch is None:
        pitch = usual_pitch(frame, job.cell_factor)
    wanted = [cell for cell in cells(frame, pitch) if cell.meets(window)]
    forecasts, audits, left = [], [], Counter[Zone]()
    for done, (cell, restored) in enumerate(_restored(job, wanted, workers), start=1):
        _add(out, window, cell, restored.planes)
        forecasts.append(restored.forecast)
        left[restored.forecast.zone] += restored.left
        if restored.audit is not None:
            audits.append((zone_of(cell.position.r), (cell.top, cell.left), restored.audit))
        on_step(done, len(wanted))
    report = pooled(audits)
    return Corrected(out, zone_reports(forecasts, left, report), report)


def _zeroed(out: Planes | None, shape: tuple[int, int, int]) -> Planes:
    """What the caller gave to write to, or something new."""
    if out is None:
        return np.zeros(shape, dtype=np.float32)
    if out.shape != shape or out.dtype != np.float32:
        raise InvalidInputError(f"out must be float32 {shape}, got {out.dtype} {out.shape}")
    out[:] = 0.0
    return out


def _blurs_of(
    field: PsfField, lateral: LateralShift | None
) -> Callable[[FieldPosition, Channel, float], UniformBlur]:
    """Blur of one channel at one place, its lateral shift included, for an expected error of its kernel.

    Each serves its own cell and as a neighbour; three rows of cells of 100 megapixels fit.
    """

    @lru_cache(maxsize=640)
    def kernels(position: FieldPosition, channel: Channel) -> Kernel:
        return crop_to_support(field.kernel_at(position, channel, KERNEL_SIZE))

    @lru_cache(maxsize=640)
    def blurs(position: FieldPosition, channel: Channel, error: float) -> UniformBlur:
        offset = (0.0, 0.0)
        if lateral is not None and channel != "g":
            out = lateral.displacement(position.r, channel)
            offset = (-out * math.sin(position.phi), out * math.cos(position.phi))
        return UniformBlur(_cautious(kernels(position, channel), error), offset)

    return blurs


def _restored(job: _Job, wanted: Sequence[Cell], workers: int) -> Iterator[tuple[Cell, _Restored]]:
    """Restore cells in order, a few ahead of the one that is being added."""
    if workers == 1:
        for cell in wanted:
            yield cell, _restore(job, cell)
        return
    with ThreadPoolExecutor(workers) as pool:
        ahead: deque[tuple[Cell, Future[_Restored]]] = deque()
        queue = iter(wanted)
        try:
            for cell in queue:
                ahead.append((cell, pool.submit(_restore, job, cell)))
                if len(ahead) > 2 * workers:
                    first, future = ahead.popleft()
                    yield first, future.result()
            while ahead:
                first, future = ahead.popleft()
                yield first, future.result()
        finally:
            for _, future in ahead:
                future.cancel()


def _restore(job: _Job, cell: Cell) -> _Restored:
    """Restore one cell, halo cut off again."""
    errors = [job.uncertainty(cell.position, channel) for channel in CHANNELS]
    reach = max(
        job.reach(cell.position, channel, error) for channel, error in zip(CHANNELS, errors, strict=True)
    )
    halo = fitted_halo((len(cell.rise), len(cell.run)), max(MIN_HALO, reach + MORE))
    top, left = max(cell.top - halo, 0), max(cell.left - halo, 0)
    blurs = [
        job.blur(cell, channel, error, (top, left)) for channel, error in zip(CHANNELS, errors, strict=True)
    ]
    tile = np.asarray(job.planes[:, top : cell.bottom + halo, left : cell.right + halo], dtype=np.float32)
    surrounded = (
        min(cell.top - halo, cell.left - halo) >= 0
        and cell.bottom + halo <= job.frame.height
        and cell.right + halo <= job.frame.width
    )
    edges = (
        top == 0,
        cell.bottom + halo >= job.frame.height,
        left == 0,
        cell.right + halo >= job.frame.width,
    )
    sensors = [
        Sensor(
            job.noise[c],
            job.clip[c],
            job.measured(c, top, left, plane.shape),
            surrounded,
            edges,
        )
        for c, plane in enumerate(tile)
    ]
    inner = (
        slice(None),
        slice(cell.top - top, cell.bottom - top),
        slice(cell.left - left, cell.right - left),
    )
    expected = forecast(cell, tile, blurs, sensors, errors)
    trust = trusted(sum(errors) / len(errors))
    worth = expected.held(1.0 - trust).gain_db >= WORTH_DB or job.bounds.denoise > 0.0
    if job.strength == 0.0 or not worth:
        untouched = replace(expected, after=expected.before)
        return _Restored(tile[inner], untouched, None, left=True)
    restored = restore_planes(job.method, tile, blurs, sensors)
    restored = texture_kept(
        tile, restored, blurs, sensors, texture=job.bounds.texture, denoise=job.bounds.denoise
    )
    restored = hue_held(tile, restored, blurs, sensors, errors)
    restored = held_beside_clipped(tile, restored, blurs, sensors, errors)
    evidence = Evidence(job.noise, job.clip, blurs, errors, [sensor.measured for sensor in sensors])
    # before the bounds, which would hide what tells of a wrong kernel: light below black, foreign hues
    restored, verdict = held_back(tile, restored, evidence, inner=inner[1:])
    restored = job.bounds.hold(job.planes, (cell.top, cell.left), restored, errors)
    if trust * job.strength < 1.0:
        restored = tile[inner] + np.float32(trust * job.strength) * (restored - tile[inner])
    held = 1.0 - trust * (1.0 - verdict.held_back)
    return _Restored(restored, expected.held(held), verdict.without_map())


def trusted(error: float) -> float:
    """Share of a correction that is applied where its kernel has an expected relative L2 error.

    All up to a half, nothing from 0.8 on, between which half of the kernel's power becomes error: what a
    method makes of such a kernel is a picture of the kernel, however crisp.
    """
    return float(np.clip((_LOST - error) / (_LOST - _SURE), 0.0, 1.0))


def _cautious(kernel: NDArray[np.float64], error: float) -> NDArray[np.float64]:
    """Mix an uncertain kernel with a point, s k + (1 - s) delta, s = 1 / (1 + e²).

    Too wide a kernel costs far more than too narrow a one. What a wrong kernel leaves is no noise: counted
    as such, it would hand strong edges to the prior, which paints their colour over what lies beside them.
    """
    if error == 0.0:
        return kernel
    share = 1.0 / (1.0 + error * error)
    return as_kernel(share * kernel + (1.0 - share) * delta(kernel.shape[0]))


def _add(out: Planes, window: Roi, cell: Cell, restored: Planes) -> None:
    """Add a cell with its weights to the part of it that was asked for."""
    top, left = max(cell.top, window.top), max(cell.left, window.left)
    bottom = min(cell.bottom, window.top + window.height)
    right = min(cell.right, window.left + window.width)
    rows, cols = slice(top - cell.top, bottom - cell.top), slice(left - cell.left, right - cell.left)
    target = (
        slice(None),
        slice(top - window.top, bottom - window.top),
        slice(left - window.left, right - window.left),
    )
    loops = compiled("auto")
    if loops is None:
        out[target] += np.outer(cell.rise[rows], cell.run[cols]) * restored[:, rows, cols]
    else:
        loops.add(np.asarray(out[target]), cell.rise[rows], cell.run[cols], restored[:, rows, cols])
