"""The durable queue: every job that is enqueued is run, even after a crash.

The engine is DBOS Transact, a library that keeps its queue in SQLite or PostgreSQL. No other
module uses it. A job is a name with a few ids and numbers; what it did is recorded in our own
tables, so that running a job twice is harmless and the engine can be replaced, or its database
lost, without losing a photo. The library itself starts the jobs of a dead process again only where that
process starts again; here others resume them, once the tables say that its lease has expired.
"""

from __future__ import annotations

import contextvars
import json
import logging
import sqlite3
from collections.abc import Callable, Mapping
from contextlib import closing
from datetime import datetime
from typing import Any, Final, Literal, ParamSpec, TypeAlias, TypeVar

from dbos import DBOS, DBOSConfig, EnqueueOptions
from dbos import Serializer as DBOSSerializer
from sqlalchemy import make_url

from app.store.database import SERVER_DEADLINES
from app.store.jobs import Job, Kind

log = logging.getLogger(__name__)

JOB_PROTOCOL: Final = 1  # raised when jobs of an older program can no longer be finished by this one
Status: TypeAlias = Literal["unknown", "waiting", "done", "lost"]
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


class _Json(DBOSSerializer):
    """JSON rather than pickle: a manipulated row of the engine's tables must not run code here."""

    def serialize(self, data: object) -> str:
        return json.dumps(data, default=repr)

    def deserialize(self, serialized_data: str) -> object:
        return json.loads(serialized_data)

    def name(self) -> str:
        return "json"


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
        _switch_on_wal(self._url)
        config: DBOSConfig = {
            "name": "lensmodel",
            "system_database_url": self._url,
            "application_version": str(JOB_PROTOCOL),
            "executor_id": self._executor_id,
            "serializer": _Json(),
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

    def status(self, job: Job) -> Status:
        """Return whether a job waits or runs, ended, was given up, or was never enqueued."""
        record = _outside(DBOS.get_workflow_status, job.id)
        if record is None:
            self._enqueued.discard(job.id)
            return "unknown"
        if record.status in _WAITING:
            return "waiting"
        return "lost" if record.status == "CANCELLED" else "done"

    def take_over(self, executor_id: str) -> None:
        """Resume the running jobs of a dead worker in their queues."""
        # Interrupted, it can be done again. Should two workers do it at once, a job may run twice: the tables
        # count what it did once.
        for row in _listed(status="PENDING", executor_id=executor_id, app_version=str(JOB_PROTOCOL)):
            deaths = (row.attributes or {}).get(_DEATHS, 0) + 1
            if deaths > MAX_DEATHS[row.name]:
                _outside(DBOS.cancel_workflow, row.workflow_id)
            else:
                _outside(DBOS.update_workflow_attributes, row.workflow_id, {_DEATHS: deaths})
                _outside(DBOS.resume_workflow, row.workflow_id, queue_name=row.queue_name)

    def holders(self) -> set[str]:
        """Return the workers that run jobs, as far as the engine knows."""
        running = _listed(status="PENDING", app_version=str(JOB_PROTOCOL))
        return {row.executor_id for row in running if row.executor_id is not None}

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

    def stop(self) -> None:
        """Run no more jobs, without waiting for those that are running."""
        DBOS.destroy(destroy_registry=True)


def _listed(**which: Any) -> list[Any]:  # noqa: ANN401 - of `DBOS.list_workflows`
    return _outside(DBOS.list_workflows, load_input=False, load_output=False, **which)


def _outside(call: Callable[P, T], *arguments: P.args, **options: P.kwargs) -> T:
    """Call the library as if outside of any job."""
    # Inside a job it would record the call as one of the job's steps and replay it after a crash; our jobs
    # look at our tables instead
    return contextvars.Context().run(call, *arguments, **options)


def _switch_on_wal(url: str) -> None:
    """Let readers and one writer work at once (WAL): the library does not set it, and the file keeps it."""
    parsed = make_url(url)
    if parsed.get_backend_name() == "sqlite" and parsed.database:
        with closing(sqlite3.connect(parsed.database, timeout=30)) as connection:
            connection.execute("PRAGMA journal_mode=WAL")
