"""Step 1: from a photo to samples of its lens's PSF.

inspect -> develop -> select -> estimate -> count      (`take`; in the service as well)
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Callable
from concurrent.futures import Executor, as_completed
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal, Protocol

from lensmodel import estimation, photo
from lensmodel.core import parallel, processes
from lensmodel.core.errors import InvalidInputError, NotEnoughEvidenceError, NoUsablePatchesError
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings
from lensmodel.estimation import patches
from lensmodel.estimation.estimator import require_size
from lensmodel.estimation.patches import Patch
from lensmodel.workflow.developed import (
    load_developed,
    photo_id,
    require_aperture,
    save_developed,
    settings_of,
)
from lensmodel.workflow.estimating import (
    DEFAULT_KERNEL_SIZE,
    CellSample,
    estimate_cell,
    find_patches,
    patches_by_cell,
    require_spread,
)
from lensmodel.workflow.lens import Lens
from lensmodel.workflow.ways import KERNEL_PATCHES, Way, chosen_way, way_named

log = logging.getLogger(__name__)

Stage = Literal["developing", "selecting", "estimating"]


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
    """

    photo: Path
    stage: Stage | Literal["counted", "skipped"]
    done: int = 0
    total: int = 0
    detail: str = ""


EventHook = Callable[[CalibrationEvent], None]


def ignore_event(event: CalibrationEvent) -> None:
    """Do nothing: the default `EventHook`."""


@dataclass(frozen=True, slots=True)
class Recipe:
    """How the samples of a photo are made; what is None is as the lens is learned (`ways`).

    Parameters
    ----------
    settings : LensSettings
        Values for photos that do not say their own (`settings_of`).
    model : str, optional
        Name of a way; None is that of the lens, of a new one the usual.
    estimator : str or PsfEstimator, optional
        Name in `estimators`, or an object of one's own.
    kernel_size : int, optional
        Odd side of the kernels in pixels.
    selector : str or Selector
        Name in `selectors`, or an object of one's own.
    count : int, optional
        Patches asked for.
    """

    settings: LensSettings = field(default_factory=LensSettings)
    model: str | None = None
    estimator: str | estimation.PsfEstimator | None = None
    kernel_size: int | None = None
    selector: str | patches.Selector = "r-map"
    count: int | None = None

    def of_lens(self, lens: Lens | None) -> Recipe:
        """Return it as it holds for a lens."""
        return replace(self, model=chosen_way(self.model, None if lens is None else lens.model).name)

    @property
    def way(self) -> Way:
        """The way it follows where it says nothing else."""
        return way_named(self.model or "default")

    @property
    def method(self) -> str | estimation.PsfEstimator:
        """The estimator that it takes."""
        return self.way.estimator if self.estimator is None else self.estimator

    @property
    def size(self) -> int:
        """The side of its kernels in pixels."""
        if self.kernel_size is not None:
            return self.kernel_size
        return DEFAULT_KERNEL_SIZE if self._of_own_kernels else self.way.kernel_size

    @property
    def patches(self) -> int:
        """How many patches of a photo it looks at."""
        if self.count is not None:
            return self.count
        return KERNEL_PATCHES if self._of_own_kernels else self.way.patches

    @property
    def _of_own_kernels(self) -> bool:
        """Whether an estimator of kernels takes the place of one that reads whole photos."""
        own = estimation.estimators.resolve(self.way.estimator)
        return isinstance(own, estimation.PhotoEstimator) and not isinstance(
            estimation.estimators.resolve(self.method), estimation.PhotoEstimator
        )

    def check(self) -> None:
        """Refuse names, sizes and counts that there are not, before any work."""
        estimation.estimators.resolve(self.method)
        require_size(self.size)
        patches.selectors.resolve(self.selector)
        if self.patches < 1:
            raise InvalidInputError(f"patches must be at least 1, got {self.patches}")


class PhotoSteps(Protocol):
    """The work on one photo, wherever it is done: here in `samples_of_photo`, in the service by jobs."""

    def inspect(self) -> bool:
        """Read what the file says; False where the photo is not to teach its lens, or cannot yet."""

    def enter(self, stage: Stage) -> None:
        """Take note of the step that comes."""

    def develop(self) -> None:
        """Make linear planes of the file."""

    def select(self) -> None:
        """Choose patches."""

    def estimate(self) -> None:
        """Estimate a PSF for each cell of them."""

    def count(self) -> None:
        """Hand over the samples; refuse the photo where they tell too little (`require_spread`)."""


def take(photo: PhotoSteps) -> None:
    """Take one photo through all steps."""
    if not photo.inspect():
        return
    photo.enter("developing")
    photo.develop()
    photo.enter("selecting")
    photo.select()
    photo.enter("estimating")
    photo.estimate()
    photo.count()


class _StepsHere:
    """`PhotoSteps` in this process, and cells in those of a pool; the developed photo lies in a folder."""

    def __init__(
        self,
        path: Path,
        recipe: Recipe,
        folder: Path,
        workers: int | None,
        executor: Executor | None,
        on_event: EventHook,
    ) -> None:
        self.samples: list[PsfSample] = []
        self._path, self._recipe, self._folder = path, recipe, folder
        self._workers, self._executor, self._on_event = workers, executor, on_event
        self._groups: list[tuple[Patch, ...]] = []
        self._by_cell: dict[int, list[CellSample]] = {}

    @property
    def _total(self) -> int:
        return sum(map(len, self._groups))

    def inspect(self) -> bool:
        require_aperture(photo.inspect(self._path).metadata, self._recipe.settings)
        return True

    def enter(self, stage: Stage) -> None:
        self._on_event(CalibrationEvent(self._path, stage, 0, self._total))

    def develop(self) -> None:
        save_developed(photo.develop(self._path), self._folder)

    def select(self) -> None:
        developed = load_developed(self._folder)
        recipe = self._recipe
        selection = find_patches(
            developed, count=recipe.patches, selector=recipe.selector, estimator=recipe.method
        )
        self._groups = patches_by_cell(selection)

    def estimate(self) -> None:
        recipe, done = self._recipe, 0
        settings = settings_of(load_developed(self._folder), recipe.settings)
        method = estimation.estimators.resolve(recipe.method)
        order = (settings, photo_id(self._path), method, recipe.size)
        alone = parallel.Here() if len(self._groups) == 1 else self._executor
        with processes.pool(alone, self._workers, method) as pool:
            jobs = {
                pool.submit(_cell_from_folder, self._folder, group, *order): index
                for index, group in enumerate(self._groups)
            }
            try:
                for job in as_completed(jobs):
                    index = jobs[job]
                    try:
                        self._by_cell[index] = job.result()
                    except NotEnoughEvidenceError as error:
                        log.info("a cell of %s was dropped: %s", self._path.name, error)
                    done += len(self._groups[index])
                    self._on_event(CalibrationEvent(self._path, "estimating", done, self._total))
            except BaseException:
                for job in jobs:
                    job.cancel()  # leaving `with` waits only for what runs
                raise

    def count(self) -> None:
        made = [cell for index in sorted(self._by_cell) for cell in self._by_cell[index]]
        if not made:
            raise NoUsablePatchesError(
                f"none of the {self._total} patches of {self._path.name} determines a PSF; "
                "use a photo with more fine detail in focus"
            )
        require_spread([cell.patch for cell in made if cell.channel == "g"], count=self._recipe.patches)
        self.samples = [cell.sample for cell in made]


def _cell_from_folder(
    folder: Path,
    group: tuple[Patch, ...],
    settings: LensSettings,
    key: str,
    estimator: estimation.PsfEstimator,
    size: int,
) -> list[CellSample]:
    return estimate_cell(
        load_developed(folder), group, settings=settings, photo_id=key, estimator=estimator, size=size
    )


def samples_of_photo(
    path: Path,
    recipe: Recipe | None = None,
    *,
    workers: int | None = None,
    executor: Executor | None = None,
    on_event: EventHook = ignore_event,
) -> list[PsfSample]:
    """Develop one photo, find its patches and estimate a PSF for each patch and channel.

    Cells are estimated in `workers` processes (all cores by default), or by an executor that sees the
    files of this machine; the result does not depend on it. An estimator of one's own that other processes
    cannot load (`processes.portable`) runs in threads of this one.
    """
    recipe = recipe or Recipe()
    recipe.check()
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        steps = _StepsHere(path, recipe, Path(folder), workers, executor, on_event)
        take(steps)
        return steps.samples


def samples_of_bytes(name: str, data: bytes, recipe: Recipe) -> list[PsfSample]:
    """Do as `samples_of_photo` in this process alone, with a photo that lies on another machine."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as folder:
        path = Path(folder) / Path(name).name
        path.write_bytes(data)
        return samples_of_photo(path, recipe, executor=parallel.Here())
