"""What every job uses: the tables, the blobs, and tasks in the sandbox, with their limits and retries."""

from __future__ import annotations

import errno
import logging
import math
import random
import shutil
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeAlias

from app.blobs.storage import Storage
from app.jobs import answers
from app.jobs.answers import SHOWN, Answer, JobFailedError, NotWantedError, checked
from app.jobs.sample_files import write_samples
from app.runtime import metrics
from app.runtime.outage import OutageError, is_outage
from app.runtime.settings import Settings
from app.sandbox.child import MAX_RESULT, Outcome, ProgressHook, TaskLimits
from app.sandbox.runner import Sandbox
from app.store import Store
from app.store.tables import PhotoRow
from lensmodel.core.psf import PsfSample
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
# Address space in MiB that a thread reserves: 8 of stack and 128 that glibc maps for the heap of an arena,
# most of it never touched
THREAD_MB: Final = 136
# Bytes to which a profile may unpack (chosen): kernels of 20,000 samples of 55 pixels, which no lens has.
# Reading takes so many times as much (chosen, by counting): bytes, float32, float64, the model.
MAX_UNPACKED, COPIES = 256 << 20, 8
# Size of the cache at most (chosen: some seventy photos of 24 megapixels as planes of float32), or half of
# the free disk if that is less
KEEP_BYTES: Final = 20 << 30
Wanted: TypeAlias = Callable[[], bool]


@dataclass(frozen=True, slots=True)
class Needs:
    """What a task needs of the machine, and what it answers."""

    part: int = 1  # which part of `LENS_TASK_SECONDS` it may compute, such as 90: a 90th
    answer: Answer | None = None
    pixel_bytes: int = 0  # address space for each pixel of its photo (chosen, by counting), beside `spare_mb`
    spare_mb: int = SPARE_MB
    compiled: bool = True  # whether it runs compiled loops
    threads: bool = False  # whether it works in as many threads as the worker has slots
    quick: bool = False  # whether it goes before others: what it finds, its owner may have to answer


# Of a pixel mapped planes alone take 12 bytes; a measurement maps two photos, with a float64 plane of each
NEEDS: Final[Mapping[str, Needs]] = {
    "locate": Needs(90, answers.LOCATED, compiled=False, quick=True),
    "inspect": Needs(90, answers.INSPECTED, spare_mb=2 * SPARE_MB, compiled=False, quick=True),
    "develop": Needs(20, pixel_bytes=120, compiled=False),
    "select": Needs(20, answers.SELECTED, pixel_bytes=120, compiled=False),
    "estimate": Needs(6, pixel_bytes=24),
    "measure-lens": Needs(pixel_bytes=96),
    "correct": Needs(1, answers.CORRECTED, pixel_bytes=120, threads=True),
    "measure": Needs(1, answers.MEASURED, spare_mb=2 * SPARE_MB),
    "profile": Needs(20, answers.READ_PROFILE, spare_mb=SPARE_MB + COPIES * (MAX_UNPACKED >> 20)),
}


class JobContext:
    """What the jobs of one worker share: settings, rows, files, and a sandbox for their tasks."""

    def __init__(self, settings: Settings, store: Store, storage: Storage, sandbox: Sandbox) -> None:
        self.settings, self.store, self.storage, self.sandbox = settings, store, storage, sandbox
        self.warmed, self._locks = threading.Event(), defaultdict[str, threading.Lock](threading.Lock)
        self._copied = sandbox.account is not None  # another account reads copies, not the blobs
        self.warmed.set()  # unless the worker says that it compiles the loops
        self.cells = ThreadPoolExecutor(settings.worker_slots + 1)  # one more waits for the next slot
        self.cache = settings.data_dir.resolve() / "developed"  # developed photos, of this machine alone

    def wants(self, photo: PhotoRow | None) -> Wanted:
        """Return what tells whether the work on a photo, begun as the row says, is still wanted."""
        assert photo is not None
        return partial(self.store.photos.is_live, photo.public_id, photo.epoch)

    @contextmanager
    def task(
        self,
        name: str,
        photo: PhotoRow | None,
        /,
        wanted: Wanted | None = None,
        *,
        reads: Sequence[Path] = (),
        samples: Sequence[PsfSample] = (),
        on_progress: ProgressHook = ignore_step,
        **arguments: Any,  # noqa: ANN401 - JSON of any shape
    ) -> Iterator[tuple[Any, Path]]:
        """Run a task in a folder of its own, with `samples`; give its answer, checked, and the folder."""
        # `wanted` tells whether to go on; unless given, as long as the photo is being worked on
        needs, limits, wanted = NEEDS[name], self.limits(name, photo), _patient(wanted or self.wants(photo))
        if needs.compiled:
            self.warmed.wait()  # else it would compile the same at the same time
        with self.sandbox.folder() as folder:
            if samples:
                write_samples(folder, samples)
            around: dict[str, Any] = {"folder": folder, "reads": reads, "on_progress": on_progress}
            answer = self._attempt(
                partial(self.sandbox.run, name, arguments, wanted=wanted, **around), name, limits
            )
            yield answer if needs.answer is None else checked(needs.answer, answer), folder

    def _attempt(self, run: Callable[..., Outcome], task: str, limits: TaskLimits) -> Any:  # noqa: ANN401 - JSON of any shape
        """Run a task, with retries where they can help; return its result."""
        # After a death by signal the task is retried after a pause, after too little memory once with twice
        # as much. What the library refuses with a reason would be refused again. Ends by `NotWantedError`,
        # `JobFailedError`, or `OutageError` where the machine lacks disk space or memory.
        crashes, enlarged = 0, False
        while True:
            outcome = run(limits=limits)
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
                log.warning("task %s: %s (%d of %d)", task, outcome.detail, crashes, CRASHES)
                if crashes == CRASHES:
                    detail = f"{outcome.detail}; tried {crashes} times; report the file to the developers"
                    raise JobFailedError("crashed_repeatedly", detail)
                time.sleep(BACKOFF_S * 4 ** (crashes - 1) * random.uniform(0.5, 1.5))  # noqa: S311
            else:
                raise JobFailedError(outcome.code, outcome.detail)

    def limits(self, task: str, photo: PhotoRow | None) -> TaskLimits:
        """Return the limits of a task, which grow with its photo."""
        needs, seconds = NEEDS[task], self.settings.task_seconds
        pixels = 0 if photo is None else (photo.width or 0) * (photo.height or 0)
        memory = needs.spare_mb + needs.pixel_bytes * pixels // (1 << 20)
        memory = min(memory, max(self.sandbox.budget.memory_mb, needs.spare_mb))
        threads = self.settings.worker_slots if needs.threads else 0
        # the wall time of a part may be long on a busy machine; it bounds a task that waits for nothing
        cpu_s = math.ceil(seconds / needs.part) * max(threads, 1)
        return TaskLimits(memory + THREAD_MB * threads, seconds, cpu_s, quick=needs.quick)

    @contextmanager
    def original(self, photo: PhotoRow) -> Iterator[Path]:
        """Provide the file of a photo."""
        with self.sandbox.folder() as folder:
            try:
                with self.storage.as_file(photo.blob_key, folder, copied=self._copied) as path:
                    yield path
            except FileNotFoundError as error:
                with suppress(FileNotFoundError):  # OSError while the folder is away
                    self.storage.size(photo.blob_key)
                    raise OSError(errno.ENODEV, "the folder of the blobs was away", photo.blob_key) from error
                text = f"the file of photo {photo.public_id} is no longer stored; upload it again"
                raise JobFailedError("unknown_photo", text) from error

    def developed(self, photo: PhotoRow, wanted: Wanted | None = None) -> Path:
        """Return the folder of the developed photo; develop it if it is not there."""
        target = self.cache / photo.public_id
        with self._locks[photo.public_id], ExitStack() as files:
            if (target / "planes.npy").is_file():
                target.touch()  # the cache drops the least recently used
                return target
            target.parent.mkdir(parents=True, exist_ok=True)
            path = files.enter_context(self.original(photo))
            done = self.task(
                "develop",
                photo,
                wanted,
                reads=[path],
                path=str(path),
                max_megapixels=self.settings.max_megapixels,
            )
            _, folder = files.enter_context(done)
            if (folder / SHOWN).is_file():
                self.storage.put(f"{photo.folder}{SHOWN}", folder / SHOWN)
            shutil.rmtree(target, ignore_errors=True)
            folder.rename(target)  # complete, or absent
            return target

    def keep(self, key: str, written: Path) -> None:
        """Store what a task wrote for readers that read all of it; nothing that is missing or too large."""
        if written.is_file() and written.stat().st_size <= MAX_RESULT:
            self.storage.put(key, written)


def _patient(wanted: Wanted) -> Wanted:
    """Treat the job as wanted while the database is away: its restart must not discard hours of work."""

    def ask() -> bool:
        try:
            return wanted()
        except Exception as error:
            if is_outage(error):
                return True
            raise

    return ask


def drop_developed(base: Path, existing: Callable[[Iterable[str]], set[str]], idle_s: float) -> None:
    """Bound the cache in `base`; developed photos whose photo was deleted are removed too."""
    folders = sorted(base.glob("*/"), key=lambda path: path.stat().st_mtime)  # the least recently used first
    known = existing(path.name for path in folders)
    sizes = {path: sum(file.stat().st_size for file in path.glob("*")) for path in folders}
    total, room = sum(sizes.values()), min(KEEP_BYTES, shutil.disk_usage(base).free // 2) if folders else 0
    for path in folders:
        idle = time.time() - path.stat().st_mtime > idle_s
        if path.name not in known or (total > room and idle):
            total -= sizes[path]
            shutil.rmtree(path, ignore_errors=True)
