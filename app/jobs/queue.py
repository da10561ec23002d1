"""The durable queue: every job that is enqueued is run, even after a crash, until it is done or cannot be.

The engine is DBOS Transact; no other module uses it. What a job did is recorded in our own tables, so that
running it twice is harmless, and the engine's database may be lost. The library starts the jobs of a dead
process again only where that process starts again; here others resume them, once its lease has expired.
"""

from __future__ import annotations

import contextvars
import logging
import math
from collections import Counter
from collections.abc import Callable, Container, Mapping
from contextlib import closing
from datetime import datetime
from functools import partial
from random import uniform
from time import monotonic, sleep
from typing import Any, Final, Literal, ParamSpec, TypeAlias, TypeVar

from dbos import DBOS, DBOSConfig, DBOSPortableJSONSerializer, EnqueueOptions
from structlog.contextvars import bound_contextvars

from app.jobs.answers import JobFailedError, NotWantedError
from app.runtime import metrics
from app.runtime.outage import CODE, is_outage
from app.store import Store
from app.store.database import SERVER_DEADLINES, Database
from app.store.jobs import Job, Kind

log = logging.getLogger(__name__)

JOB_PROTOCOL: Final = 1  # raised when jobs of an older program can no longer be finished by this one
Handler: TypeAlias = Callable[..., None]
P = ParamSpec("P")
T = TypeVar("T")

# Deaths of its worker after which a job is started again (chosen): a photo takes long, and whoever restarts
# workers interrupts it; the others may be what killed them
MAX_DEATHS: Final[Mapping[str, int]] = {"photo": 50, "correction": 5, "measure": 3}
_DEATHS: Final = "deaths"  # attribute of a job: how many workers have died of it, or while it ran
# Seconds between two polls of each queue (chosen): three polls every 0.1 s take a tenth of a core
POLL_S: Final = 0.2
_WAITING: Final = ("ENQUEUED", "PENDING", "DELAYED")
# How long a job waits for a database, a storage or a disk before it fails (chosen): a night
OUTAGE_S: Final = 12 * 3600.0
# Longest pause before a retry (chosen): after a long outage work goes on within a minute
LONGEST_PAUSE_S: Final = 60.0
# Attempts at a job that fails with an unforeseen error (chosen): what the moment caused passes, and a real
# fault is reported soon
BUGS: Final = 3
OURS: Final = "an error of ours; the log of the worker has it; retry later, or report the file"
IN_VAIN: Final = "waited in vain for what the service needs ({}): retry once its operator has mended that"
# What the first argument of a job is, for the log
_SUBJECT: Final[Mapping[Kind, str]] = {
    "photo": "photo_id",
    "correction": "correction_id",
    "measure": "lens_id",
}


class DbosEngine:
    """DBOS in this process; one at a time, since the library keeps one state per process."""

    def __init__(self, url: str, executor_id: str, *, slots: int) -> None:
        self._url, self._executor_id = url, executor_id
        # How many jobs of a kind this worker runs at once (chosen): more photos than fill it would keep other
        # machines from them
        self._at_once: Mapping[Kind, int] = {"photo": slots + 1, "correction": 2, "measure": 2}
        self._enqueued: set[str] = set()

    def start(self, handlers: Mapping[Kind, Handler]) -> None:
        """Open the tables, declare the queues, start running jobs: `handlers[kind](*arguments)`."""
        # the library does not let readers and one writer of SQLite work at once; the file keeps what ours set
        with closing(Database(self._url)) as tables, tables.reader.connect():
            pass
        config: DBOSConfig = {
            "name": "lensmodel",
            "system_database_url": self._url,
            "application_version": str(JOB_PROTOCOL),
            "executor_id": self._executor_id,
            # JSON rather than pickle: a manipulated row of the engine's tables must not run code here
            "serializer": DBOSPortableJSONSerializer(),
            "log_level": "WARNING",
            "enable_otlp": False,
        }
        if not self._url.startswith("sqlite"):
            config["db_engine_kwargs"] = {"connect_args": dict(SERVER_DEADLINES)}
        DBOS(config=config)
        for kind, handler in handlers.items():
            DBOS.workflow(name=kind)(handler)
        DBOS.launch()
        for kind, limit in self._at_once.items():
            DBOS.register_queue(
                kind,
                worker_concurrency=limit,
                partition_worker_concurrency=limit,  # queues with partitions are fair between owners
                polling_interval_sec=POLL_S,
                on_conflict="always_update",
            )

    def enqueue(self, job: Job) -> None:
        """Put a job into its queue; a second call does nothing, even after the job ended."""
        if job.id in self._enqueued:
            return
        options: EnqueueOptions = {
            "workflow_name": job.kind,
            "queue_name": job.kind,
            "workflow_id": job.id,
            "app_version": str(JOB_PROTOCOL),
            "queue_partition_key": job.owner,
        }
        _outside(DBOS.enqueue_workflow_with_options, options, *job.arguments)
        self._enqueued.add(job.id)

    def status(self, job: Job) -> Literal["unknown", "waiting", "done", "lost"]:
        """Return whether a job waits or runs, ended, was given up, or was never enqueued."""
        record = _outside(DBOS.get_workflow_status, job.id)
        if record is None:
            self._enqueued.discard(job.id)
            return "unknown"
        if record.status in _WAITING:
            return "waiting"
        return "lost" if record.status == "CANCELLED" else "done"

    def take_over(self, living: Callable[[], Container[str]]) -> None:
        """Resume the running jobs of all workers but the living in their queues."""
        # Interrupted, it can be done again. Should two workers do it at once, a job may run twice: the tables
        # count what it did once. The living are asked last: a worker has its row before it runs anything
        running = _listed(status="PENDING", app_version=str(JOB_PROTOCOL))
        alive = living()
        for row in running:
            if row.executor_id in alive:
                continue
            deaths = (row.attributes or {}).get(_DEATHS, 0) + 1
            if deaths > MAX_DEATHS[row.name]:
                _outside(DBOS.cancel_workflow, row.workflow_id)
            else:
                _outside(DBOS.update_workflow_attributes, row.workflow_id, {_DEATHS: deaths})
                _outside(DBOS.resume_workflow, row.workflow_id, queue_name=row.queue_name)

    def forget(self, before: datetime) -> int:
        """Delete the records of jobs that ended before a time; return how many."""
        ended = _listed(
            status=["SUCCESS", "ERROR", "CANCELLED"], completed_before=before.isoformat(), limit=1000
        )
        ids = [row.workflow_id for row in ended]
        if ids:
            _outside(DBOS.delete_workflows, ids)
        self._enqueued.difference_update(ids)
        return len(ids)


def _listed(**which: Any) -> list[Any]:  # noqa: ANN401 - of `DBOS.list_workflows`
    return _outside(DBOS.list_workflows, load_input=False, load_output=False, **which)


def _outside(call: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
    """Call the library as if outside of any job."""
    # Inside a job it would record the call as one of the job's steps and replay it after a crash; our jobs
    # look at our tables instead
    return contextvars.Context().run(call, *arguments, **options)


def durable(kind: Kind, handler: Handler, give_up: Callable[[Job, JobFailedError], object]) -> Handler:
    """Wrap a job: failures are retried, and one that cannot be done is given up with a reason."""

    def run(*arguments: str | int) -> None:
        job, began, how = Job(kind, arguments), monotonic(), "done"
        with bound_contextvars(job_id=job.id, **{_SUBJECT[kind]: str(arguments[0])}):
            try:
                insist(partial(handler, *arguments), OUTAGE_S, kind)
            except NotWantedError:
                log.info("not wanted any more")
            except JobFailedError as reason:
                insist(partial(give_up, job, reason))
            except Exception as error:  # noqa: BLE001 - whatever it is, it has been logged
                how, why = "internal_error", OURS
                if is_outage(error):
                    how, why = CODE, IN_VAIN.format(type(error).__name__)
                insist(partial(give_up, job, JobFailedError(how, why)))
        metrics.JOB_SECONDS.labels(kind, how).observe(monotonic() - began)

    return run


def insist(call: Callable[[], object], outage_s: float = math.inf, kind: Kind | None = None) -> None:
    """Do something again until it succeeds; raise its error after a few bugs, or an outage of that time."""
    failures, began = Counter[str](), None
    while True:
        try:
            call()
        except (JobFailedError, NotWantedError):
            raise
        except Exception as error:
            outage = is_outage(error)
            log.warning("%s: %s", type(error).__name__, error, exc_info=None if outage else error)
            cause, moment = ("outage" if outage else "unforeseen"), monotonic()
            failures[cause] += 1
            began = moment if began is None else began
            if moment - began > outage_s if outage else failures[cause] == BUGS:
                raise
            if kind is not None:
                metrics.RETRIES.labels(kind, cause).inc()
            # drawn: jobs that failed together do not come back together
            sleep(uniform(1.0, min(2.0 ** min(failures[cause], 6), LONGEST_PAUSE_S)))  # noqa: S311
        else:
            return


def end_job(store: Store, job: Job, reason: JobFailedError) -> None:
    """End the work of a job with a reason; changes nothing where that has ended meanwhile."""
    log.info("job %s: %s: %s", job.id, reason.code, reason.detail)
    subject, number = str(job.arguments[0]), int(job.arguments[1])
    if job.kind == "measure":
        store.lenses.record_metrics(
            subject, number, {"error": None, "coverage": None, "problem": reason.code}
        )
    else:
        works = store.photos if job.kind == "photo" else store.jobs
        works.fail(subject, number, reason.code, reason.detail)
