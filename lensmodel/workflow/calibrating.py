"""Steps 1 and 2: PSF samples of many photos, and the lens model that they make."""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable, Iterable
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from lensmodel import estimation, photo
from lensmodel.core import parallel, processes
from lensmodel.core.errors import (
    InvalidInputError,
    LensModelError,
    MetadataMissingError,
    NotEnoughEvidenceError,
    NoUsablePatchesError,
)
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import (
    LensSettings,
)
from lensmodel.estimation import patches
from lensmodel.estimation.estimator import require_size
from lensmodel.estimation.patches import Patch
from lensmodel.model import LensModel, ModelSettings
from lensmodel.workflow.developed import load_developed, photo_id, save_developed, settings_of
from lensmodel.workflow.estimating import (
    DEFAULT_KERNEL_SIZE,
    DEFAULT_PATCHES,
    CellSample,
    cells,
    estimate_cell,
    find_patches,
    require_spread,
)

log = logging.getLogger(__name__)

AHEAD: Final = 32
"""Photos that are sent to an executor at once (chosen): a gigabyte of them, work for some dozen processes."""


@dataclass(frozen=True, slots=True)
class CalibrationEvent:
    """What just happened in a calibration, for progress displays.

    Parameters
    ----------
    photo : Path
    stage : {"developing", "selecting", "estimating", "counted", "skipped"}
        The last two end the work on a photo.
    done, total : int
        Patches, while estimating; else 0.
    detail : str
        Why a photo was skipped.
    """

    photo: Path
    stage: Literal["developing", "selecting", "estimating", "counted", "skipped"]
    done: int = 0
    total: int = 0
    detail: str = ""


EventHook = Callable[[CalibrationEvent], None]


def ignore_event(event: CalibrationEvent) -> None:
    """Do nothing: the default `EventHook`."""


def samples_of_photo(
    path: Path,
    *,
    settings: LensSettings | None = None,
    estimator: str | estimation.PsfEstimator = "default",
    selector: str | patches.Selector = "r-map",
    count: int = DEFAULT_PATCHES,
    kernel_size: int = DEFAULT_KERNEL_SIZE,
    workers: int | None = None,
    executor: Executor | None = None,
    on_event: EventHook = ignore_event,
) -> list[PsfSample]:
    """Develop one photo, find its patches and estimate a PSF for each patch and channel.

    Cells are estimated in `workers` processes (all cores by default), or by an executor that sees the
    files of this machine; the result does not depend on it. An estimator of one's own that other processes
    cannot load (`processes.portable`) runs in threads of this one.

    Raises
    ------
    MetadataMissingError
        If the aperture is neither in the file nor given.
    NoUsablePatchesError
        If the photo tells nothing about the blur, or too little, or of one place only.
    """
    require_size(kernel_size)
    method = estimation.estimators.resolve(estimator)
    on_event(CalibrationEvent(path, "developing"))
    developed = photo.develop(path)
    chosen = settings_of(developed, settings)
    if chosen.aperture is None:
        raise MetadataMissingError(
            f"{path.name} does not say its aperture; give it (for example --aperture 2.8)"
        )
    on_event(CalibrationEvent(path, "selecting"))
    key = photo_id(path)
    groups = cells(find_patches(developed, count=count, selector=selector))
    total = sum(len(group) for group in groups)
    on_event(CalibrationEvent(path, "estimating", 0, total))
    by_cell: dict[int, list[CellSample]] = {}
    done = 0
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        save_developed(developed, Path(folder))
        del developed
        with processes.pool(executor, workers, method) as pool:
            jobs = {
                pool.submit(_cell_from_folder, folder, group, chosen, key, method, kernel_size): index
                for index, group in enumerate(groups)
            }
            try:
                for job in as_completed(jobs):
                    index = jobs[job]
                    try:
                        by_cell[index] = job.result()
                    except NotEnoughEvidenceError as error:
                        log.info("a cell of %s was dropped: %s", path.name, error)
                    done += len(groups[index])
                    on_event(CalibrationEvent(path, "estimating", done, total))
            except BaseException:
                for job in jobs:
                    job.cancel()  # leaving `with` waits only for what runs
                raise
    samples = [cell.sample for index in sorted(by_cell) for cell in by_cell[index]]
    if not samples:
        raise NoUsablePatchesError(
            f"none of the {total} patches of {path.name} determines a PSF; "
            "use a photo with more fine detail in focus"
        )
    determined = [cell.patch for index in sorted(by_cell) for cell in by_cell[index] if cell.channel == "g"]
    require_spread(determined, count=count)
    return samples


def _cell_from_folder(
    folder: str,
    group: tuple[Patch, ...],
    settings: LensSettings,
    key: str,
    estimator: str | estimation.PsfEstimator,
    size: int,
) -> list[CellSample]:
    return estimate_cell(
        load_developed(Path(folder)), group, settings=settings, photo_id=key, estimator=estimator, size=size
    )


def samples_of_bytes(
    name: str,
    data: bytes,
    settings: LensSettings | None,
    estimator: str | estimation.PsfEstimator,
    count: int = DEFAULT_PATCHES,
    selector: str | patches.Selector = "r-map",
    kernel_size: int = DEFAULT_KERNEL_SIZE,
) -> list[PsfSample]:
    """Do as `samples_of_photo` in this process alone, with a photo that lies on another machine."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        path = Path(folder) / Path(name).name
        path.write_bytes(data)
        return samples_of_photo(
            path,
            settings=settings,
            estimator=estimator,
            selector=selector,
            count=count,
            kernel_size=kernel_size,
            executor=parallel.Here(),
        )


def calibrate(
    paths: Iterable[Path],
    *,
    model: LensModel | None = None,
    settings: LensSettings | None = None,
    model_settings: ModelSettings | None = None,
    estimator: str | estimation.PsfEstimator = "default",
    selector: str | patches.Selector = "r-map",
    count: int = DEFAULT_PATCHES,
    kernel_size: int = DEFAULT_KERNEL_SIZE,
    workers: int | None = None,
    executor: Executor | None = None,
    on_event: EventHook = ignore_event,
) -> LensModel:
    """Learn the blur of one lens from photos taken with it; the model is `warmed`.

    Photos that cannot help (no detail, unreadable) are skipped and reported through `on_event`.

    Parameters
    ----------
    paths : iterable of Path
        Photos of one lens. RAW is best, JPEG worst.
    model : LensModel, optional
        What is known already; photos that it has not seen are added to it.
    settings : LensSettings, optional
        Values for the files that do not say their own.
    model_settings : ModelSettings, optional
        Choices of a new model; one that is given keeps its own.
    executor : Executor, optional
        Runs whole photos, whose bytes are sent to it: of other machines too. Without one, `workers`
        processes share the patches of one photo after the other.

    Raises
    ------
    InvalidInputError
        If both a model and settings for a new one are given.
    NotEnoughEvidenceError
        If no photo gave a sample and there was no model to start from.
    """
    if model is not None and model_settings is not None:
        raise InvalidInputError("the model has settings of its own; give a model or model_settings")
    samples: list[PsfSample] = []
    reasons: list[str] = []
    known = set() if model is None else {sample.photo for sample in model.samples}

    def sent(path: Path) -> tuple[Any, ...] | None:
        wanted = executor is not None and photo_id(path) not in known
        order = (settings, estimator, count, selector, kernel_size)
        return (path.name, path.read_bytes(), *order) if wanted else None

    ahead = 1 if executor is None else AHEAD
    for path, job in parallel.in_order(
        executor or parallel.Here(), samples_of_bytes, paths, sent, ahead=ahead
    ):
        if (key := photo_id(path)) in known:
            on_event(CalibrationEvent(path, "skipped", detail="its samples are in the model already"))
            continue
        try:
            learned = (
                samples_of_photo(
                    path,
                    settings=settings,
                    estimator=estimator,
                    selector=selector,
                    count=count,
                    kernel_size=kernel_size,
                    workers=workers,
                    on_event=on_event,
                )
                if job is None
                else job.result()
            )
        except LensModelError as error:
            reasons.append(f"{path.name}: {error}")
            on_event(CalibrationEvent(path, "skipped", detail=str(error)))
            continue
        samples.extend(learned)
        known.add(key)
        on_event(CalibrationEvent(path, "counted", len(learned), len(learned)))
    if model is not None:
        return (model.added(samples) if samples else model).warmed()
    if not samples:
        raise NotEnoughEvidenceError(
            "no photo could be used:\n  " + "\n  ".join(reasons or ["none was given"])
        )
    return LensModel.fit(samples, model_settings or ModelSettings()).warmed()
