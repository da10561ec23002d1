"""A worker process: runs the jobs that the tables ask for, and takes over those of dead workers."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Mapping
from datetime import UTC, datetime, timedelta
from functools import partial
from importlib.metadata import version
from pathlib import Path
from time import monotonic, sleep
from typing import Any, Final

import lensmodel
from app.blobs.account_data import erase
from app.blobs.storage import Storage
from app.jobs.answers import JobFailedError
from app.jobs.context import JobContext, drop_developed
from app.jobs.correction_work import correct, measure
from app.jobs.inspection import remove_location
from app.jobs.photo_work import work_on
from app.jobs.queue import DbosEngine
from app.jobs.running import OURS, durable, end_job, insist
from app.jobs.task_files import SHOWN, THUMBNAIL
from app.runtime import logs, metrics
from app.runtime.outage import is_outage
from app.runtime.processes import PARENT, end_with_parent, is_running, started_at
from app.runtime.settings import Settings
from app.sandbox import account, confine
from app.sandbox.child import clean_environment
from app.sandbox.runner import Budget, Sandbox
from app.store import Store
from app.store.database import new_id
from app.store.jobs import Job, Kind
from app.store.owners import ANY_OWNER
from lensmodel.cli import ending
from lensmodel.cli.ending import InterruptedByUser

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
        self._host, self._last_beat = socket.gethostname(), monotonic()
        database = self._store.database
        self._file = database.path if database.is_sqlite else Path()
        self._identity = _identity(self._file)

    def _task_account(self, data: Path) -> account.SystemAccount | None:
        """Return the account that children change to, with access to their folders and to nothing else."""
        if "account" not in self._confined:
            return None
        task_account = account.find(self._settings.task_user)
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
        log.info("children are confined by: %s", ", ".join(self._confined) or "nothing that the kernel has")
        about: dict[str, Any] = {
            "host": self._host,
            "pid": os.getpid(),
            "pid_started": started_at(os.getpid()),
        }
        insist(partial(self._store.jobs.register, self.id, confined=" ".join(self._confined), **about))
        self._last_beat = monotonic()
        beat_s = min(self._settings.lease_seconds / 4, 5.0)
        # in a thread of its own: nothing below, and no duty, may delay the lease
        self._start_thread(beat_s, self._keep_lease)
        insist(lambda: self._context.storage.settle(self._store.photos.newest_file))
        self._context.warmed.clear()
        threading.Thread(target=self._do, args=(self._warm,), daemon=True).start()
        end = partial(end_job, self._store)
        self._engine.start(
            {kind: durable(kind, partial(job, self._context), end) for kind, job in JOBS.items()}
        )
        self._start_thread(beat_s, self._take_over_dead)
        self._start_thread(SWEEP_S, self._sweep)
        self._start_thread(RECONCILE_S, self._reconcile, first_s=RECONCILE_S)
        self._start_thread(TIDY_S, self._tidy)

    def _start_thread(self, period_s: float, duty: Callable[[], None], *, first_s: float = 0.0) -> None:
        """Do a duty again and again, so that none delays another."""

        def repeat() -> None:
            sleep(first_s)
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
        for row in jobs.workers():
            if row.host == self._host and not is_running(row.pid, row.pid_started):
                jobs.bury(row.id)
        # should this end in between, `_reconcile` of another one does the rest
        for dead in jobs.remove_dead(self._settings.lease_seconds, by=self.id):
            self._engine.take_over(dead)
            shutil.rmtree(self._scratch / dead, ignore_errors=True)
            metrics.TAKEN_OVER.inc()
            log.info("took over the work of worker %s", dead)

    def _reconcile(self) -> None:
        """End jobs that the engine lost or gave up, so that none stays unfinished for ever."""
        holders = self._engine.holders()  # first: a worker has its row before it holds anything
        for holder in holders - {row.id for row in self._store.jobs.workers()}:
            self._engine.take_over(holder)
        for job in self._store.jobs.to_do(begun=True):
            ended = self._lost(job)
            if ended:
                end_job(self._store, job, ended)

    def _lost(self, job: Job) -> JobFailedError | None:
        status = self._engine.status(job)
        if status == "unknown":
            self._engine.enqueue(job)
        if status == "lost":
            return JobFailedError(
                "crashed_repeatedly", "the worker died each time that it tried; report the file"
            )
        return JobFailedError("internal_error", OURS) if status == "done" else None

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
            own = {"NUMBA_CACHE_DIR": str(cache), PARENT: str(os.getpid())}
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
        if prefix.endswith("/"):
            self._context.storage.delete(prefix)
        else:
            self._context.storage.remove(prefix)
        self._store.jobs.forget_garbage(prefix)

    def _die(self, why: str) -> None:
        log.error("%s: this worker stops", why)
        metrics.FENCED.inc()
        logging.shutdown()
        os._exit(EXIT_FENCED)


def fingerprint() -> str:
    """Return a digest of the library and its compiler: what was compiled for others is of no use."""
    files = sorted(Path(lensmodel.__file__).parent.rglob("*.py"))
    stamps = [(str(path), path.stat().st_mtime_ns) for path in files]
    return hashlib.sha256(f"{version('numba')} {stamps}".encode()).hexdigest()[:16]


def _identity(path: Path) -> tuple[int, int]:
    try:
        status = path.stat()
    except FileNotFoundError:
        return (0, 0)
    return (status.st_dev, status.st_ino)


def main() -> None:
    """Run a worker with the settings of the environment until SIGTERM or the supervisor's end."""
    end_with_parent()
    settings = Settings()
    logs.begin("worker", settings.log_level, settings.log_format)
    confine.keep_private()
    if settings.metrics_address:
        metrics.publish(settings.metrics_address)
    ending.install()
    with contextlib.suppress(InterruptedByUser):
        Worker(settings).run()
