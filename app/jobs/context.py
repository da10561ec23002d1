"""What every job uses: the tables, the blobs, the sandbox, and the rules for retries."""

from __future__ import annotations

import errno
import logging
import random
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Final

from app.blobs.storage import Storage
from app.jobs.task_files import SHOWN
from app.runtime import metrics
from app.runtime.outage import OutageError, is_outage
from app.runtime.settings import Settings
from app.sandbox.child import ProgressHook
from app.sandbox.outcome import Outcome, TaskLimits
from app.sandbox.runner import Sandbox
from app.store import Store
from app.store.tables import PhotoRow
from lensmodel.core.types import ignore_step

log = logging.getLogger(__name__)

# Deaths of a child by a signal before its job fails (chosen): one may be the machine's fault, three are the
# file's
CRASHES: Final = 3
# Seconds before the second attempt, four times as long before each further one (chosen): a machine short of
# memory recovers, and its owner hardly waits
BACKOFF_S: Final = 0.5
# Address space in MiB of a task besides its picture (chosen): what libraries reserve, and room to spare
SPARE_MB: Final = 768
COMPUTING: Final = frozenset(
    {"estimate", "correct", "measure", "measure-lens", "profile"}
)  # by compiled loops
SIBLINGS: Final = 7  # photos that tell of the defects of a sensor (chosen): more tell hardly more
# Size of the cache at most (chosen: some seventy photos of 24 megapixels as planes of float32), or half of
# the free disk if that is less
KEEP_BYTES: Final = 20 << 30


class JobFailedError(Exception):
    """A job cannot be done, and a retry would not help: a fixed code and a sentence for its owner."""

    def __init__(self, code: str, detail: str) -> None:
        super().__init__(detail)
        self.code, self.detail = code, detail


class NotWantedError(Exception):
    """The job was cancelled, or its photo deleted or started anew: stop, and change nothing."""


@dataclass
class JobContext:
    """What the jobs of one worker share: settings, rows, files, and a sandbox for their tasks."""

    settings: Settings
    store: Store
    storage: Storage
    sandbox: Sandbox
    warmed: threading.Event = field(default_factory=threading.Event)  # whether loops are compiled
    _locks: defaultdict[str, threading.Lock] = field(init=False)

    def __post_init__(self) -> None:
        self._locks = defaultdict(threading.Lock)
        self.warmed.set()  # unless the worker says that it compiles them

    def attempt(
        self,
        task: str,
        arguments: Mapping[str, Any],
        *,
        folder: Path,
        limits: TaskLimits,
        wanted: Callable[[], bool],
        reads: Sequence[Path] = (),
        on_progress: ProgressHook = ignore_step,
    ) -> Any:  # noqa: ANN401 - JSON of any shape
        """Run a task, with retries where they can help; return its result."""
        # After a death by signal the task is retried after a pause, after too little memory once with twice
        # as much. What the library refuses with a reason would be refused again. Ends by `NotWantedError`,
        # `JobFailedError`, or `OutageError` where the machine lacks disk space or memory.
        if task in COMPUTING:
            self.warmed.wait()  # else it would compile the same at the same time
        wanted = _patient(wanted)
        crashes = 0
        enlarged = False
        while True:
            outcome = self.sandbox.run(
                task,
                arguments,
                folder=folder,
                limits=limits,
                reads=reads,
                wanted=wanted,
                on_progress=on_progress,
            )
            metrics.TASKS.labels(task, outcome.ending).inc()
            if outcome.ending == "ok":
                return outcome.value
            if outcome.ending == "cancelled":
                raise NotWantedError
            if outcome.ending == "outage":
                raise OutageError(f"task {task}: {outcome.detail}")
            doubled_mb = min(2 * limits.memory_mb, self.sandbox.budget.memory_mb)
            if outcome.ending == "memory_limit" and not enlarged and doubled_mb > limits.memory_mb:
                enlarged, limits = True, replace(limits, memory_mb=doubled_mb)
            elif outcome.code == "crashed":
                crashes += 1
                self._pause_after(outcome, task, crashes, wanted)
            else:
                raise JobFailedError(outcome.code, outcome.detail)

    def _pause_after(self, outcome: Outcome, task: str, crashes: int, wanted: Callable[[], bool]) -> None:
        log.warning("task %s: %s (%d of %d)", task, outcome.detail, crashes, CRASHES)
        if crashes == CRASHES:
            detail = f"{outcome.detail}; tried {crashes} times; please report the file to the developers"
            raise JobFailedError("crashed_repeatedly", detail)
        end = time.monotonic() + BACKOFF_S * 4 ** (crashes - 1) * random.uniform(0.5, 1.5)  # noqa: S311
        while time.monotonic() < end:
            if not wanted():
                raise NotWantedError
            time.sleep(0.05)

    def limits(self, photo: PhotoRow, seconds: float, bytes_per_pixel: int) -> TaskLimits:
        """Return limits that grow with the photo; 12 bytes a pixel are the mapped planes alone."""
        pixels = (photo.width or 0) * (photo.height or 0)
        memory = SPARE_MB + bytes_per_pixel * pixels // (1 << 20)
        return TaskLimits(memory_mb=min(memory, max(self.sandbox.budget.memory_mb, SPARE_MB)), wall_s=seconds)

    @contextmanager
    def original(self, photo: PhotoRow) -> Iterator[Path]:
        """Provide the file of a photo."""
        with self.sandbox.folder() as folder:
            try:
                # another account reads a copy, not the blob
                copied = self.sandbox.account is not None
                with self.storage.as_file(photo.blob_key, folder, copied=copied) as path:
                    yield path
            except FileNotFoundError as error:
                with suppress(FileNotFoundError):  # OSError while the folder is away
                    self.storage.size(photo.blob_key)
                    raise OSError(errno.ENODEV, "the folder of the blobs was away", photo.blob_key) from error
                text = f"the file of photo {photo.public_id} is no longer stored; upload it again"
                raise JobFailedError("unknown_photo", text) from error

    @contextmanager
    def _siblings(self, photo: PhotoRow) -> Iterator[list[Path]]:
        """Provide other photos of the same body, which tell of defects of its sensor, if they are here."""
        found = [] if self.storage.folder is None else self.store.photos.siblings(photo, SIBLINGS)
        with self.sandbox.folder() as folder, ExitStack() as opened:
            paths = []
            for row in found:
                with suppress(OSError):  # deleted meanwhile
                    file = self.storage.as_file(row.blob_key, folder, copied=self.sandbox.account is not None)
                    paths.append(opened.enter_context(file))
            yield paths

    def developed_folder(self, photo_id: str) -> Path:
        """Return the folder of the developed photo, in a cache of this machine."""
        return self.settings.data_dir.resolve() / "developed" / photo_id

    def developed(self, photo: PhotoRow, wanted: Callable[[], bool]) -> Path:
        """Return the folder of the developed photo; develop it if it is not there."""
        target = self.developed_folder(photo.public_id)
        with self._locks[photo.public_id]:
            if (target / "planes.npy").is_file():
                (target / "planes.npy").touch()  # the cache drops the least recently used
                return target
            target.parent.mkdir(parents=True, exist_ok=True)
            limits = self.limits(photo, self.settings.develop_seconds, 120)
            with (
                self.original(photo) as path,
                self._siblings(photo) as siblings,
                self.sandbox.folder() as folder,
            ):
                arguments = {
                    "path": str(path),
                    "siblings": [str(sibling) for sibling in siblings],
                    "max_megapixels": self.settings.max_megapixels,
                }
                reads = [path, *siblings]
                self.attempt("develop", arguments, folder=folder, limits=limits, wanted=wanted, reads=reads)
                if (folder / SHOWN).is_file():
                    self.storage.put(f"{photo.folder}{SHOWN}", folder / SHOWN)
                shutil.rmtree(target, ignore_errors=True)
                folder.rename(target)  # complete, or absent
            return target


def _patient(wanted: Callable[[], bool]) -> Callable[[], bool]:
    """Treat the job as wanted while the database is away: its restart must not discard hours of work."""

    def ask() -> bool:
        try:
            return wanted()
        except Exception as error:
            if not is_outage(error):
                raise
            return True

    return ask


def drop_developed(base: Path, existing: Callable[[Iterable[str]], set[str]], idle_s: float) -> None:
    """Bound the cache in `base`; developed photos whose photo was deleted are removed first."""
    folders = [path for path in base.iterdir() if path.is_dir()] if base.is_dir() else []
    known = existing(path.name for path in folders)
    used = sorted((_used(path), path) for path in folders)
    free = shutil.disk_usage(base).free if folders else 0
    room = min(KEEP_BYTES, free // 2) if free else 0
    total = sum(_size(path) for path in folders)
    for last, path in used:
        idle = time.time() - last > idle_s
        if path.name not in known or (total > room and idle):
            total -= _size(path)
            shutil.rmtree(path, ignore_errors=True)


def _size(folder: Path) -> int:
    return sum(path.stat().st_size for path in folder.glob("*"))


def _used(folder: Path) -> float:
    planes = folder / "planes.npy"
    return planes.stat().st_mtime if planes.exists() else 0.0
