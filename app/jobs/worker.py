"""A worker process: runs the jobs that the tables ask for, and takes over those of dead workers."""

from __future__ import annotations

import fcntl
import hashlib
import logging
import os
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib.metadata import version
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

import lensmodel
from app.blobs.account_data import erase
from app.blobs.storage import Storage
from app.jobs.answers import SHOWN, THUMBNAIL, JobFailedError
from app.jobs.context import JobContext, drop_developed
from app.jobs.queue import OURS, DbosEngine, durable, end_job, insist
from app.jobs.work import correct, measure, read_ahead, remove_location, work_on
from app.runtime import logs, metrics
from app.runtime.outage import is_outage
from app.runtime.settings import Settings
from app.sandbox import account, confine
from app.sandbox.child import clean_environment
from app.sandbox.runner import Budget, Sandbox
from app.store import Store
from app.store.database import new_id
from app.store.jobs import Kind
from app.store.owners import ANY_OWNER
from lensmodel.cli.console import InterruptedByUser, handle_signals

log = logging.getLogger(__name__)

# Exit status of a worker that was declared dead or whose database was replaced: EX_SOFTWARE (sysexits.h)
EXIT_FENCED: Final = 70
JOBS: Final[Mapping[Kind, Callable[..., None]]] = {
    "photo": work_on,
    "correction": correct,
    "measure": measure,
}
WARMING = "app.jobs.warming"  # module that compiles what tasks need; tests replace it
# seconds between two rounds of a duty, all chosen
SWEEP_S: Final = 0.5  # of the tables for new work, which takes seconds: an idle worker uses no processor
RECONCILE_S: Final = 10.0  # of the tables with the engine: the longest wait of a lost job
TIDY_S: Final = 60.0  # of deletion: nobody waits for it
# How long the engine remembers ended jobs (chosen): a fault of yesterday can still be looked into
KEEP_JOBS: Final = timedelta(days=2)


class Worker:
    """One worker: its lease, its sweeps, its engine."""

    def __init__(self, settings: Settings) -> None:
        self.id = new_id()
        self._settings = settings
        self._store = Store(settings)
        data = settings.data_dir.resolve()
        self._confined = [
            name for name, in_force in confine.available(settings.task_user, data).items() if in_force
        ]
        self._scratch = data / "scratch"
        self._sandbox = Sandbox(
            self._scratch / self.id,
            Budget(settings.worker_slots, settings.worker_memory_mb),
            cache=data / "cache",
            account=self._task_account(data),
            niceness=settings.task_niceness,
        )
        self._context = JobContext(
            settings,
            self._store,
            Storage(settings.storage, patience_s=settings.storage_seconds, create=False),
            self._sandbox,
        )
        self._engine = DbosEngine(settings.jobs, self.id, slots=settings.worker_slots)
        self._last_beat = monotonic()
        # locked as long as this process lives, however it ends
        self._alive = os.open(self._scratch / f"{self.id}.alive", os.O_CREAT | os.O_RDWR)
        fcntl.flock(self._alive, fcntl.LOCK_EX)
        database = self._store.database
        self._file = database.path if database.is_sqlite else Path()
        self._identity = _identity(self._file)

    def _task_account(self, data: Path) -> account.SystemAccount | None:
        """Return the account that children change to, with access to their folders and to nothing else."""
        task_account = account.find(self._settings.task_user) if "account" in self._confined else None
        if task_account is not None:
            folders = [data / "developed", self._scratch, data / "cache"]
            account.close_to_others(data, {path.name for path in folders})
            for folder in [data, *folders]:
                task_account.lets_through(folder)
        return task_account

    def run(self) -> None:
        """Work until the process is told to end."""
        try:
            self._begin()
            threading.Event().wait()
        except InterruptedByUser:
            self._do(lambda: self._store.jobs.bury(self.id))
            shutil.rmtree(self._scratch / self.id, ignore_errors=True)  # last: jobs still run
            logging.shutdown()
            os._exit(0)  # threads in the middle of a job must not go on to report it finished

    def _begin(self) -> None:
        log.debug("children are confined by: %s", ", ".join(self._confined) or "nothing that the kernel has")
        insist(partial(self._store.jobs.register, self.id, confined=" ".join(self._confined)))
        self._last_beat = monotonic()
        beat_s = min(self._settings.lease_seconds / 4, 5.0)
        # in a thread of its own: nothing below, and no duty, may delay the lease
        self._start_thread(beat_s, self._keep_lease)
        insist(lambda: self._context.storage.settle(self._store.photos.have_files))
        self._context.warmed.clear()
        threading.Thread(target=self._do, args=(self._warm,), daemon=True).start()
        context, end = self._context, partial(end_job, self._store)
        self._engine.start({kind: durable(kind, partial(job, context), end) for kind, job in JOBS.items()})
        self._start_thread(beat_s, self._take_over_dead)
        self._start_thread(SWEEP_S, self._sweep)
        self._start_thread(SWEEP_S, self._read_ahead)
        self._start_thread(RECONCILE_S, self._reconcile)
        self._start_thread(TIDY_S, self._tidy)

    def _start_thread(self, period_s: float, duty: Callable[[], None]) -> None:
        """Do a duty again and again, so that none delays another."""

        def repeat() -> None:
            while True:
                self._do(duty)
                sleep(period_s)

        threading.Thread(target=repeat, daemon=True).start()

    def _do(self, duty: Callable[[], object]) -> None:
        try:
            duty()
        except Exception:
            log.exception("a duty of the worker failed; it is tried again")

    # --- duties -------------------------------------------------------------------------------

    def _sweep(self) -> None:
        """Enqueue the jobs that the tables ask for; those already queued stay as they are."""
        for job in self._store.jobs.to_do():
            self._engine.enqueue(job)

    def _read_ahead(self) -> None:
        """Read photos while others are worked on, rather than when their turn comes."""
        while (photo := self._store.photos.unread()) is not None:
            insist(partial(read_ahead, self._context, photo), TIDY_S)  # then perhaps another

    def _keep_lease(self) -> None:
        """Renew the lease; stop at once if this worker was declared dead."""
        if _identity(self._file) != self._identity:
            self._die(f"{self._file} was replaced while this worker ran")
        try:
            alive = self._store.jobs.beat(self.id)
        except Exception as error:
            late = monotonic() - self._last_beat > self._settings.lease_seconds
            if late and is_outage(error):
                self._die("the database did not answer for a whole lease")
            raise
        if not alive:
            self._die("this worker was silent for too long and others took over its work")
        self._last_beat = monotonic()

    def _take_over_dead(self) -> None:
        """Take over from workers whose lease has expired, and from those of this machine that are gone."""
        jobs = self._store.jobs
        for alive in self._scratch.glob("*.alive"):
            if alive.stem != self.id and _is_free(alive):
                jobs.bury(alive.stem)
                alive.unlink(missing_ok=True)
        # should this end in between, `_reconcile` of another one does the rest
        for dead in jobs.remove_dead(self._settings.lease_seconds, by=self.id):
            self._engine.take_over(self._living)
            shutil.rmtree(self._scratch / dead, ignore_errors=True)
            metrics.TAKEN_OVER.inc()
            log.info("took over the work of worker %s", dead)

    def _reconcile(self) -> None:
        """End jobs that the engine lost or gave up, so that none stays unfinished for ever."""
        self._engine.take_over(self._living)
        for job in self._store.jobs.to_do(begun=True):
            status = self._engine.status(job)
            if status == "unknown":
                self._engine.enqueue(job)
            elif status == "lost":
                why = "the worker died each time that it tried; report the file"
                end_job(self._store, job, JobFailedError("crashed_repeatedly", why))
            elif status == "done":
                end_job(self._store, job, JobFailedError("internal_error", OURS))

    def _living(self) -> set[str]:
        return {row.id for row in self._store.jobs.workers()}

    def _tidy(self) -> None:
        """Delete data that are no longer needed; one failure does not prevent the others."""
        accounts, photos, jobs = self._store.accounts, self._store.photos, self._store.jobs
        expired = datetime.now(UTC) - timedelta(days=self._settings.keep_results_days)
        duties: list[tuple[Iterable[Any], Callable[[Any], object]]] = [
            (accounts.to_erase(), partial(erase, accounts, self._context.storage)),
            (photos.read_profiles(), lambda key: photos.delete(key, ANY_OWNER)),
            (photos.unsearched(), partial(remove_location, self._context)),
            (jobs.ended_before(expired), lambda key: jobs.delete(key, ANY_OWNER)),
            (jobs.garbage(), self._delete),
        ]
        if self._settings.keep_photos == "never":
            duties.append((photos.unneeded(), lambda key: photos.give_up_file(key, (THUMBNAIL, SHOWN))))
        for subjects, duty in duties:
            for subject in subjects:
                self._do(partial(duty, subject))
        self._do(partial(self._engine.forget, datetime.now(UTC) - KEEP_JOBS))
        drop_developed(self._context.cache, photos.existing, self._settings.task_seconds)

    def _warm(self) -> None:
        """Compile the inner loops for all tasks, unless that was done for this program."""
        try:
            cache = self._sandbox.cache
            if (done := cache / f"warm-{fingerprint()}").exists():
                return
            own = {"NUMBA_CACHE_DIR": str(cache), confine.PARENT: str(os.getpid())}
            subprocess.run(  # noqa: S603 - our own interpreter, our own module
                [sys.executable, "-m", WARMING, str(self._settings.task_niceness)],
                env=clean_environment() | own,
                check=True,
                timeout=self._settings.task_seconds,
            )
            done.touch()
        finally:
            self._context.warmed.set()

    def _delete(self, prefix: str) -> None:
        if not self._store.jobs.claim_garbage(prefix):
            return  # an upload that ended meanwhile has kept it
        storage = self._context.storage
        (storage.delete if prefix.endswith("/") else storage.remove)(prefix)
        self._store.jobs.forget_garbage(prefix)

    def _die(self, why: str) -> None:
        log.error("%s: this worker stops", why)
        metrics.FENCED.inc()
        logging.shutdown()
        os._exit(EXIT_FENCED)


def fingerprint() -> str:
    """Return a digest of the library and its compiler: what was compiled for others is of no use."""
    files = Path(lensmodel.__file__).parent.rglob("*.py")
    stamps = sorted((str(path), path.stat().st_mtime_ns) for path in files)
    return hashlib.sha256(f"{version('numba')} {stamps}".encode()).hexdigest()[:16]


def _is_free(path: Path) -> bool:
    """Say whether the process that locked a file is gone."""
    with suppress(OSError), path.open() as file:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return True
    return False


def _identity(path: Path) -> tuple[int, int]:
    with suppress(FileNotFoundError):
        status = path.stat()
        return status.st_dev, status.st_ino
    return 0, 0


def main() -> None:
    """Run a worker with the settings of the environment until SIGTERM or the supervisor's end."""
    confine.end_with_parent()
    settings = Settings()
    logs.begin("worker", settings.log_level, settings.log_format)
    confine.keep_private()
    if settings.metrics_address:
        metrics.publish(settings.metrics_address)
    handle_signals()
    with suppress(InterruptedByUser):
        Worker(settings).run()
