"""Step 1: from a photo to samples of its lens's PSF.

inspect -> develop -> choose patches -> estimate each cell of them -> samples

Each step is a plain function on values, so that a script, the command and the workers of the service run the
same code. `Preset` says which parts are taken where nobody asks for others, `Config` what somebody asked for.
"""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import logging
import math
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

import numpy as np

from lensmodel import blind, patches, photo
from lensmodel.blind.estimator import require_size
from lensmodel.core import codec, processes
from lensmodel.core.errors import (
    InvalidInputError,
    LensModelError,
    MetadataMissingError,
    NotEnoughEvidenceError,
    NoUsablePatchesError,
    UnknownMethodError,
)
from lensmodel.core.files import save_array
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, Channel, LensSettings, NoiseModel, Plane, StepHook, ignore_step
from lensmodel.model import LensModel
from lensmodel.model.answer import DEFAULT, PAPER
from lensmodel.patches import Patch, Selection
from lensmodel.photo import LinearPhoto, PhotoMetadata
from lensmodel.photo.raster import require_known_turn
from lensmodel.workflow.lens import Lens

log = logging.getLogger(__name__)

Stage = Literal["developing", "selecting", "estimating"]

DEFAULT_KERNEL_SIZE: Final = 31
"""Pixels: holds the blur of usual lenses, and the cost grows with its square (chosen)."""
_PATCH_SIZE: Final = 192  # pixels: room for a kernel, few enough for one blur (chosen)
_SMALLEST_PATCH: Final = 64  # pixels: the least that estimators take
KERNEL_PATCHES: Final = 24
"""Patches that an estimator of kernels looks at: each costs a second (chosen)."""


# --- which parts --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Preset:
    """What is taken where nobody asks for something else."""

    name: str  # what users call it
    estimator: str  # of `estimators`
    kernel_size: int  # largest odd side of the estimated kernels in pixels
    patches: int  # parts of a photo that are looked at
    mode: str  # of `answer.MODES`
    method: str  # of `deconvolvers`


PRESETS: Final[Mapping[str, Preset]] = MappingProxyType(
    {
        "default": Preset("default", "default", 55, 96, DEFAULT, "standard"),
        "paper": Preset("paper", "michaeli-irani", 55, KERNEL_PATCHES, PAPER, "paper"),
    }
)
"""`default` encodes patches of whole photos and attends to them. `paper` is that of M. Hirsch and
B. Schölkopf, "Self-Calibration of Optical Lenses", ICCV 2015, sections 4 to 7, to be compared with: kernels
by T. Michaeli and M. Irani, their Nadaraya-Watson regression, and Richardson-Lucy deconvolution, without
what guards photos from errors of any of them."""


def preset_named(name: str) -> Preset:
    """Return a preset."""
    if name not in PRESETS:
        raise UnknownMethodError(f"no model {name!r}; known: {', '.join(PRESETS)}")
    return PRESETS[name]


def preset_of(model: LensModel) -> Preset:
    """Return the preset by which a lens was learned."""
    return PRESETS["paper" if model.settings.mode == PAPER else "default"]


@dataclass(frozen=True, slots=True)
class Config:
    """How the samples of a photo are made; what is None is as the lens is learned (its preset)."""

    # values for photos that do not say their own (`settings_of`)
    settings: LensSettings = field(default_factory=LensSettings)
    model: str | None = None  # name of a preset; None is that of the lens, of a new one the usual
    estimator: str | blind.PsfEstimator | None = None  # name in `estimators`, or an object of one's own
    kernel_size: int | None = None  # odd side of the kernels in pixels
    selector: str | patches.Selector = "r-map"  # name in `selectors`, or an object of one's own
    count: int | None = None  # patches asked for

    def of_lens(self, lens: Lens | None) -> Config:
        """Return it as it holds for a lens: by what is asked for, else by the model of the lens."""
        return self if self.model or lens is None else replace(self, model=preset_of(lens.model).name)

    @property
    def preset(self) -> Preset:
        """What it follows where it says nothing else."""
        return preset_named(self.model or "default")

    @property
    def method(self) -> str | blind.PsfEstimator:
        """The estimator that it takes."""
        return self.preset.estimator if self.estimator is None else self.estimator

    @property
    def size(self) -> int:
        """The side of its kernels in pixels."""
        if self.kernel_size is not None:
            return self.kernel_size
        return DEFAULT_KERNEL_SIZE if self._of_own_kernels else self.preset.kernel_size

    @property
    def patches(self) -> int:
        """How many patches of a photo it looks at."""
        if self.count is not None:
            return self.count
        return KERNEL_PATCHES if self._of_own_kernels else self.preset.patches

    @property
    def _of_own_kernels(self) -> bool:
        """Whether an estimator of kernels takes the place of one that reads whole photos."""
        own = blind.estimators.resolve(self.preset.estimator)
        return isinstance(own, blind.PhotoEstimator) and not isinstance(
            blind.estimators.resolve(self.method), blind.PhotoEstimator
        )

    def check(self) -> None:
        """Refuse names, sizes and counts that there are not, before any work."""
        blind.estimators.resolve(self.method)
        require_size(self.size)
        patches.selectors.resolve(self.selector)
        if self.patches < 1:
            raise InvalidInputError(f"patches must be at least 1, got {self.patches}")


# --- a developed photo ----------------------------------------------------------------------


def save_developed(developed: LinearPhoto, folder: Path) -> None:
    """Keep a developed photo so that other processes can map it: planes.npy and photo.json.

    Neither is renamed, which a confined process may not do: the folder is of no use to others before the end.
    """
    folder.mkdir(parents=True, exist_ok=True)
    fields = {
        f.name: getattr(developed, f.name) for f in dataclasses.fields(LinearPhoto) if f.name != "planes"
    }
    (folder / "photo.json").write_text(json.dumps(codec.to_json(fields)), encoding="utf-8")
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
        raise InvalidInputError(f"{folder} holds no developed photo; develop it again") from error
    return codec.from_json(LinearPhoto, {**stored, "planes": planes})


def settings_of(developed: LinearPhoto, given: LensSettings | None = None) -> LensSettings:
    """Settings of the lens as the photo's metadata say; the caller's values fill what they leave open.

    The one rule of precedence, of the library and of the command: a value that is given for a folder of
    photos is meant for those among them that do not say their own.
    """
    known, given = developed.info.metadata, given or LensSettings()
    return LensSettings(
        aperture=given.aperture if known.aperture is None else known.aperture,
        focal_mm=given.focal_mm if known.focal_mm is None else known.focal_mm,
        focus_m=given.focus_m if known.focus_m is None else known.focus_m,
    )


def require_aperture(said: PhotoMetadata, given: LensSettings | None = None) -> None:
    """Refuse a photo of unknown aperture."""
    if said.aperture is None and (given is None or given.aperture is None):
        raise MetadataMissingError(
            "it does not say its aperture; give its f-number by --aperture, 2.8 for f/2.8"
        )


def photo_id(path: Path) -> str:
    """Name a photo by its content: the first 16 hex digits of its SHA-256."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()[:16]


# --- patches and cells ----------------------------------------------------------------------


def find_patches(
    developed: LinearPhoto,
    *,
    count: int,
    selector: str | patches.Selector = "r-map",
    estimator: str | blind.PsfEstimator = "default",
    on_step: StepHook = ignore_step,
) -> Selection:
    """Choose the patches that tell about the blur.

    An estimator of whole photos chooses its own; for others `selector` scores windows of the green plane.
    """
    require_known_turn(developed.info)
    method = blind.estimators.resolve(estimator)
    if isinstance(method, blind.PhotoEstimator):
        selection = method.select(developed, count=count)
        require_spread(selection.patches, count=count)
        return selection
    third = (min(developed.frame.height, developed.frame.width) // 3) // 2 * 2
    size = min(_PATCH_SIZE, max(third, _SMALLEST_PATCH))
    selection = patches.select(
        developed.planes[1],
        developed.noise[1],
        developed.frame,
        clip=developed.clip[1],
        count=count,
        size=size,
        selector=selector,
        jpeg=developed.lossy,
        coarse_noise=developed.coarse_noise[1],
        on_step=on_step,
    )
    # the selector makes cells of about three patches: of few that were asked for, few lie apart
    patches.require_enough(selection.patches, least=min(patches.LEAST_PATCHES, math.ceil(count / 3)))
    return selection


def require_spread(determined: Sequence[Patch], *, count: int) -> None:
    """Refuse a photo of whose patches too few gave a PSF: three parts of the picture must be left."""
    patches.require_enough(determined, least=min(patches.LEAST_PARTS, math.ceil(count / 3)))


def patches_by_cell(selection: Selection) -> list[tuple[Patch, ...]]:
    """Group accepted patches by field cell, the unit of work, largest groups first."""
    grouped: dict[int, list[Patch]] = {}
    for patch in selection.patches:
        grouped.setdefault(patch.cell, []).append(patch)
    return [tuple(group) for _, group in sorted(grouped.items(), key=lambda item: (-len(item[1]), item[0]))]


class CellSample(NamedTuple):
    """One PSF sample, and the part of the photo that it was made from."""

    patch: Patch
    sample: PsfSample


def estimate_cell(
    developed: LinearPhoto,
    group: Sequence[Patch],
    *,
    settings: LensSettings,
    photo_id: str,
    estimator: str | blind.PsfEstimator = "default",
    size: int = DEFAULT_KERNEL_SIZE,
    channels: Sequence[Channel] = CHANNELS,
    on_step: StepHook = ignore_step,
) -> list[CellSample]:
    """Estimate the PSF of one field cell in each channel, green first.

    The patches of a cell share one kernel: their normal equations are summed, which is worth
    more than averaging finished kernels. Each patch becomes one sample at its own place, and
    the weights of a cell's samples add up to the confidence of its estimate. An estimator of whole
    photos has all patches of one in one cell, and gives each its own kernels.
    """
    method = blind.estimators.resolve(estimator)
    if isinstance(method, blind.PhotoEstimator):
        patch_at = {patch.position: patch for patch in group}
        samples = method.samples(
            developed, group, settings=settings, photo=photo_id, size=size, on_step=on_step
        )
        return [CellSample(patch_at[sample.position], sample) for sample in samples]
    order = sorted(channels, key=lambda c: c != "g")
    results: list[CellSample] = []
    green: blind.PsfEstimate | None = None
    for done, channel in enumerate(order, start=1):
        planes, noises = zip(*(_view(developed, patch, channel) for patch in group), strict=True)
        try:
            estimate = method.estimate(planes, noises, size=size, green=green)
        except NotEnoughEvidenceError:
            if channel == "g":
                raise
            log.info("channel %s of a cell at r=%.2f gave no kernel", channel, group[0].position.r)
            continue
        if channel == "g":
            green = estimate
        for patch in group:
            sample = PsfSample(
                kernel=estimate.kernel,
                position=patch.position,
                settings=settings.with_channel(channel),
                weight=float(np.clip(estimate.confidence / len(group), 0.0, 1.0)),
                photo=photo_id,
                pixel_pitch_um=developed.info.metadata.pixel_pitch_um,
                estimator=f"{method.name}/{method.version}",
                error=estimate.predicted_error if math.isfinite(estimate.predicted_error) else None,
                half_diagonal_px=developed.frame.half_diagonal,
            )
            results.append(CellSample(patch, sample))
        on_step(done, len(order))
    return results


def _view(developed: LinearPhoto, patch: Patch, channel: Channel) -> tuple[Plane, NoiseModel]:
    index = CHANNELS.index(channel)
    window = (slice(patch.row, patch.row + patch.size), slice(patch.col, patch.col + patch.size))
    return np.ascontiguousarray(developed.planes[index][window]), developed.noise[index]


# --- a whole photo --------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class CalibrationEvent:
    """What just happened in a calibration, for progress displays.

    Parameters
    ----------
    photo : Path
        Its file.
    stage : {"developing", "selecting", "estimating", "counted", "skipped"}
        The last two end the work on a photo.
    done, total : int
        Patches, while estimating; else 0.
    detail : str
        Why a photo was skipped.
    error : Exception or None
        What was raised where a photo cannot be used; None where the lens knows it already.
    """

    photo: Path
    stage: Stage | Literal["counted", "skipped"]
    done: int = 0
    total: int = 0
    detail: str = ""
    error: LensModelError | OSError | None = None


EventHook = Callable[[CalibrationEvent], None]


def ignore_event(event: CalibrationEvent) -> None:
    """Do nothing: the default `EventHook`."""


def samples_of_photo(
    path: Path,
    config: Config | None = None,
    *,
    key: str = "",
    admit: Callable[[PhotoMetadata], None] | None = None,
    executor: Executor | None = None,
    workers: int | None = None,
    siblings: Iterable[Path] = (),
    on_event: EventHook = ignore_event,
) -> list[PsfSample]:
    """Develop one photo, find its patches and estimate a PSF for each patch and channel."""
    config = config or Config()
    config.check()

    def admitted(info: photo.PhotoInfo) -> None:
        require_aperture(info.metadata, config.settings)
        if admit is not None:
            admit(info.metadata)
        on_event(CalibrationEvent(path, "developing"))

    developed = photo.develop(path, on_info=admitted, siblings=siblings)
    on_event(CalibrationEvent(path, "selecting"))
    method = blind.estimators.resolve(config.method)
    selection = find_patches(developed, count=config.patches, selector=config.selector, estimator=method)
    groups = patches_by_cell(selection)
    total, done = len(selection.patches), 0
    on_event(CalibrationEvent(path, "estimating", done, total))
    order = (settings_of(developed, config.settings), key or photo_id(path), method, config.size)
    by_cell: dict[int, list[CellSample]] = {}
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        alone = len(groups) == 1
        if not alone:
            save_developed(developed, Path(folder))
        source = developed if alone else Path(folder)
        with ThreadPoolExecutor(1) if alone else processes.pool(executor, workers, method) as pool:
            jobs = {pool.submit(_cell_of, source, group, *order): index for index, group in enumerate(groups)}
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
    made = [cell for index in sorted(by_cell) for cell in by_cell[index]]
    if not made:
        raise NoUsablePatchesError(
            f"none of the {total} patches of {path.name} determines a PSF; "
            "use a photo with more fine detail in focus"
        )
    green = [cell.patch for cell in made if cell.sample.settings.channel == "g"]
    require_spread(green, count=config.patches)
    return [cell.sample for cell in made]


def _cell_of(
    source: LinearPhoto | Path,
    group: tuple[Patch, ...],
    settings: LensSettings,
    key: str,
    estimator: blind.PsfEstimator,
    size: int,
) -> list[CellSample]:
    developed = load_developed(source) if isinstance(source, Path) else source
    return estimate_cell(developed, group, settings=settings, photo_id=key, estimator=estimator, size=size)


def samples_of_bytes(name: str, data: bytes, config: Config, key: str = "") -> list[PsfSample]:
    """Do as `samples_of_photo` in this process alone, with a photo that lies on another machine."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        path = Path(folder) / Path(name).name
        path.write_bytes(data)
        with ThreadPoolExecutor(1) as here:
            return samples_of_photo(path, config, key=key, executor=here)
