"""Step 1: from a photo to samples of its lens's PSF, with the parts that a `Config` names.

develop -> choose patches -> estimate each cell of them -> samples
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import tempfile
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final, Literal

import numpy as np

from lensmodel import photo
from lensmodel.blind import PhotoEstimator, PsfEstimate, PsfEstimator, estimators
from lensmodel.blind.estimator import require_size, weight_of
from lensmodel.core import errors, processes
from lensmodel.core.files import from_json, save_array, to_json
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, Channel, LensSettings, StepHook, ignore_step
from lensmodel.patches import Patch, Selection, Selector, select, selectors
from lensmodel.patches.select import LEAST_PARTS, LEAST_PATCHES, SMALLEST_PATCH, require_enough
from lensmodel.photo import LinearPhoto, PhotoMetadata

log = logging.getLogger(__name__)

DEFAULT_KERNEL_SIZE: Final = 31  # pixels: holds usual blur, and the cost grows with its square (chosen)
_PATCH_SIZE: Final = 192  # pixels: room for a kernel, few enough for one blur (chosen)
KERNEL_PATCHES: Final = 24  # that an estimator of kernels looks at: each costs a second (chosen)


@dataclass(frozen=True, slots=True)
class Config:
    """Which parts learn a lens and correct with it, and what is known of its photos."""

    model: str  # what users call it: the mode of the lens model
    estimator: str | PsfEstimator  # name in `estimators`, or an object of one's own
    kernel_size: int  # largest odd side of the estimated kernels in pixels
    patches: int  # parts of a photo that are looked at
    method: str  # of `deconvolvers`
    selector: str | Selector = "r-map"  # name in `selectors`, or an object of one's own
    settings: LensSettings = field(default_factory=LensSettings)  # for photos that do not say their own


PRESETS: Final[Mapping[str, Config]] = MappingProxyType(
    {
        "default": Config("default", "default", 55, 96, "standard"),
        "paper": Config("paper", "michaeli-irani", 55, KERNEL_PATCHES, "paper"),
    }
)
"""`default` encodes patches of whole photos and attends to them. `paper` is that of M. Hirsch and
B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, sections 4 to 7, to be compared with."""


def configured(
    model: str,
    settings: LensSettings,
    *,
    estimator: str | PsfEstimator | None = None,
    kernel_size: int | None = None,
    patches: int | None = None,
    selector: str | Selector = "r-map",
) -> Config:
    """Return a preset with what is asked for instead, before any work; None is as there."""
    if model not in PRESETS:
        raise errors.InvalidInputError(f"no model {model!r}; known: {', '.join(PRESETS)}")
    preset = PRESETS[model]
    asked = {"estimator": estimator, "kernel_size": kernel_size, "patches": patches}
    usual, method = (estimators.resolve(name) for name in (preset.estimator, estimator or preset.estimator))
    if isinstance(usual, PhotoEstimator) and not isinstance(method, PhotoEstimator):
        preset = replace(preset, kernel_size=DEFAULT_KERNEL_SIZE, patches=KERNEL_PATCHES)
    given: dict[str, Any] = {name: value for name, value in asked.items() if value is not None}
    config = replace(preset, selector=selector, settings=settings, **given)
    require_size(config.kernel_size)
    selectors.resolve(selector)
    if config.patches < 1:
        raise errors.InvalidInputError(f"patches must be at least 1, got {config.patches}")
    return config


def save_developed(developed: LinearPhoto, folder: Path) -> None:
    """Keep a developed photo so that other processes can map it, even one that may rename no file."""
    folder.mkdir(parents=True, exist_ok=True)
    fields = {
        f.name: getattr(developed, f.name) for f in dataclasses.fields(LinearPhoto) if f.name != "planes"
    }
    (folder / "photo.json").write_text(json.dumps(to_json(fields)), encoding="utf-8")
    path = folder / "planes.npy"
    try:
        with path.open("wb") as file:
            save_array(file, developed.planes)
    except OSError:  # a full disk: what there is of it is in the way of others
        with contextlib.suppress(OSError):
            path.unlink()
        raise


def load_developed(folder: Path) -> LinearPhoto:
    """Open what `save_developed` kept; the planes are memory-mapped, read-only."""
    try:
        planes = np.load(folder / "planes.npy", mmap_mode="r", allow_pickle=False)
        stored = json.loads((folder / "photo.json").read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise errors.InvalidInputError(f"{folder} holds no developed photo; develop it again") from error
    return from_json(LinearPhoto, {**stored, "planes": planes})


def photo_id(path: Path) -> str:
    """Name a photo by its content: the first 16 hex digits of its SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


def find_patches(
    developed: LinearPhoto,
    *,
    count: int,
    selector: str | Selector = "r-map",
    estimator: str | PsfEstimator = "default",
    on_step: StepHook = ignore_step,
) -> Selection:
    """Choose the patches that tell about the blur: by the estimator, or else by `selector`, on green."""
    developed.info.require_known_turn()
    method = estimators.resolve(estimator)
    if isinstance(method, PhotoEstimator):
        selection = method.select(developed, count=count)
        require_spread(selection.patches, count=count)
        return selection
    third = (min(developed.frame.height, developed.frame.width) // 3) // 2 * 2
    size = min(_PATCH_SIZE, max(third, SMALLEST_PATCH))
    selection = select(
        developed.planes[1],
        developed.noise[1],
        clip=developed.clip[1],
        count=count,
        size=size,
        selector=selector,
        jpeg=developed.lossy,
        coarse_noise=developed.coarse_noise[1],
        on_step=on_step,
    )
    # the selector makes cells of about three patches: of few that were asked for, few lie apart
    require_enough(selection.patches, least=min(LEAST_PATCHES, math.ceil(count / 3)))
    return selection


def require_spread(determined: Sequence[Patch], *, count: int) -> None:
    """Refuse a photo of whose patches too few gave a PSF: three parts of the picture must be left."""
    require_enough(determined, least=min(LEAST_PARTS, math.ceil(count / 3)))


def patches_by_cell(selection: Selection) -> list[tuple[Patch, ...]]:
    """Group accepted patches by field cell, the unit of work, largest groups first."""
    cells = Counter(patch.cell for patch in selection.patches)
    return [tuple(p for p in selection.patches if p.cell == cell) for cell, _ in cells.most_common()]


def estimate_cell(
    developed: LinearPhoto | Path,
    group: Sequence[Patch],
    *,
    settings: LensSettings,
    photo_id: str,
    estimator: str | PsfEstimator = "default",
    size: int = DEFAULT_KERNEL_SIZE,
    on_step: StepHook = ignore_step,
) -> list[PsfSample]:
    """Estimate the kernel that the patches of a field cell share in each channel, green first."""
    developed = load_developed(developed) if isinstance(developed, Path) else developed
    method = estimators.resolve(estimator)
    if isinstance(method, PhotoEstimator):
        return method.samples(developed, group, settings=settings, photo=photo_id, size=size, on_step=on_step)
    order: tuple[Channel, ...] = ("g", "r", "b")
    samples: list[PsfSample] = []
    green: PsfEstimate | None = None
    for done, channel in enumerate(order, start=1):
        index = CHANNELS.index(channel)
        planes = [
            np.ascontiguousarray(developed.planes[index, p.row : p.row + p.size, p.col : p.col + p.size])
            for p in group
        ]
        try:
            noise = [developed.noise[index]] * len(planes)
            estimate = method.estimate(planes, noise, size=size, green=green)
        except errors.NotEnoughEvidenceError:
            if channel == "g":
                raise
            log.info("channel %s of a cell at r=%.2f gave no kernel", channel, group[0].position.r)
            continue
        if channel == "g":
            green = estimate
        error = estimate.predicted_error if math.isfinite(estimate.predicted_error) else None
        samples += [
            PsfSample(
                kernel=estimate.kernel,
                position=patch.position,
                settings=settings.with_channel(channel),
                weight=weight_of(1.0 if error is None else error) / len(group),
                photo=photo_id,
                pixel_pitch_um=developed.info.metadata.pixel_pitch_um,
                estimator=f"{method.name}/{method.version}",
                error=error,
                half_diagonal_px=developed.frame.half_diagonal,
            )
            for patch in group
        ]
        on_step(done, len(order))
    return samples


@dataclass(frozen=True, slots=True)
class CalibrationEvent:
    """What just happened in a calibration, for progress displays.

    Parameters
    ----------
    photo : Path
    stage : {"developing", "selecting", "estimating", "counted", "skipped"}
        The last two end the work on a photo.
    done, total : int
        Patches, while estimating; samples, where counted; else 0.
    detail, error : str, Exception or None
        Why a photo was skipped, and what was raised; nothing where the lens knows it already.
    """

    photo: Path
    stage: Literal["developing", "selecting", "estimating", "counted", "skipped"]
    done: int = 0
    total: int = 0
    detail: str = ""
    error: errors.LensModelError | OSError | None = None


EventHook = Callable[[CalibrationEvent], None]


def ignore_event(event: CalibrationEvent) -> None:
    """Do nothing: the default `EventHook`."""


def samples_of_photo(
    path: Path,
    config: Config = PRESETS["default"],
    *,
    key: str = "",
    admit: Callable[[PhotoMetadata], None] | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    on_event: EventHook = ignore_event,
) -> list[PsfSample]:
    """Develop one photo, find its patches and estimate a PSF for each patch and channel."""

    def admitted(info: photo.PhotoInfo) -> None:
        info.metadata.require_aperture(config.settings)
        if admit is not None:
            admit(info.metadata)
        on_event(CalibrationEvent(path, "developing"))

    developed = photo.develop(path, on_info=admitted)
    on_event(CalibrationEvent(path, "selecting"))
    method = estimators.resolve(config.estimator)
    selection = find_patches(developed, count=config.patches, selector=config.selector, estimator=method)
    groups = patches_by_cell(selection)
    total, done = len(selection.patches), 0
    on_event(CalibrationEvent(path, "estimating", done, total))
    samples: list[PsfSample] = []
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        alone = len(groups) == 1
        if not alone:
            save_developed(developed, Path(folder))
        estimate = partial(
            estimate_cell,
            developed if alone else Path(folder),
            settings=developed.info.metadata.settings(config.settings),
            photo_id=key or photo_id(path),
            estimator=method,
            size=config.kernel_size,
        )
        with ThreadPoolExecutor(1) if alone else processes.pool(executor, workers, method) as pool:
            jobs = [pool.submit(estimate, group) for group in groups]
            try:
                for group, job in zip(groups, jobs, strict=True):
                    try:
                        samples += job.result()
                    except errors.NotEnoughEvidenceError as error:
                        log.info("a cell of %s was dropped: %s", path.name, error)
                    done += len(group)
                    on_event(CalibrationEvent(path, "estimating", done, total))
            finally:
                for job in jobs:
                    job.cancel()  # those not begun, after an error: leaving `with` waits only for what runs
    green = {sample.position for sample in samples if sample.settings.channel == "g"}
    determined = [patch for group in groups for patch in group if patch.position in green]
    require_spread(determined, count=config.patches)
    return samples


def samples_of_bytes(name: str, data: bytes, config: Config, key: str) -> list[PsfSample]:
    """Do as `samples_of_photo` in this process alone, with a photo that lies on another machine."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        path = Path(folder) / Path(name).name
        path.write_bytes(data)
        with ThreadPoolExecutor(1) as here:
            return samples_of_photo(path, config, key=key, executor=here)
