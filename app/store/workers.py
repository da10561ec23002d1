"""Workers and their leases, blobs that are due for deletion, and numbers for an operator."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Final

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from app.store.database import Database
from app.store.owners import now
from app.store.tables import PHOTO_RUNNING, CorrectionRow, GarbageRow, LensRow, PhotoRow, WorkerRow

_WAITING: Final = {"photo": "received", "correction": "queued"}


@dataclass(frozen=True, slots=True)
class Load:
    """Waiting jobs and numbers of rows at one moment.

    Parameters
    ----------
    jobs : mapping of (kind, state) to int
        Unfinished jobs.
    oldest_s : mapping of kind to float
        Seconds for which the oldest job has waited; 0 where none waits.
    garbage : int
        Prefixes of blobs that wait to be deleted.
    rows : mapping of table to int
        Photos, lenses and samples.
    """

    jobs: Mapping[tuple[str, str], int]
    oldest_s: Mapping[str, float]
    garbage: int
    rows: Mapping[str, int]


class WorkerStore:
    """Live workers, and those whose lease has expired."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def _now(self, session: Session) -> datetime:
        """Return the time that all workers share: a database server's, whatever their own clocks say."""
        return now() if self._db.is_sqlite else session.scalars(select(func.now())).one()

    def register(
        self, worker_id: str, *, host: str, pid: int, pid_started: float, confined: Iterable[str] = ()
    ) -> None:
        """Enter a new worker, with the measures that confine its children."""
        with self._db.writing() as session:
            at = self._now(session)
            session.add(
                WorkerRow(
                    id=worker_id,
                    host=host,
                    pid=pid,
                    pid_started=pid_started,
                    confined=" ".join(confined),
                    state="live",
                    started_at=at,
                    heartbeat_at=at,
                )
            )

    def beat(self, worker_id: str) -> bool:
        """Renew the lease; False if the worker was declared dead: it must then stop at once."""
        with self._db.writing() as session:
            statement = (
                update(WorkerRow)
                .where(WorkerRow.id == worker_id, WorkerRow.state == "live")
                .values(heartbeat_at=self._now(session))
            )
            return session.connection().execute(statement).rowcount == 1

    def live(self, lease_seconds: float) -> list[WorkerRow]:
        """Return the workers whose last heartbeat is within the lease."""
        with self._db.reading() as session:
            since = self._now(session) - timedelta(seconds=lease_seconds)
            query = select(WorkerRow).where(WorkerRow.state == "live", WorkerRow.heartbeat_at > since)
            return list(session.scalars(query))

    def all(self) -> list[WorkerRow]:
        """Return every worker that has a row, dead ones too."""
        with self._db.reading() as session:
            return list(session.scalars(select(WorkerRow)))

    def bury_stale(self, lease_seconds: float) -> list[str]:
        """Declare workers dead that missed their lease; return the ids of all dead ones."""
        with self._db.writing() as session:
            before = self._now(session) - timedelta(seconds=lease_seconds)
            session.execute(
                update(WorkerRow)
                .where(WorkerRow.state == "live", WorkerRow.heartbeat_at < before)
                .values(state="dead")
            )
            return list(session.scalars(select(WorkerRow.id).where(WorkerRow.state == "dead")))

    def bury(self, worker_id: str) -> None:
        """Declare one worker dead: it has stopped, or its process is known to be gone."""
        with self._db.writing() as session:
            session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(state="dead"))

    def forget(self, worker_id: str) -> None:
        """Remove a dead worker, once others have taken over all it had begun."""
        with self._db.writing() as session:
            session.execute(delete(WorkerRow).where(WorkerRow.id == worker_id, WorkerRow.state == "dead"))

    def garbage(self, limit: int = 100, *, at: datetime | None = None) -> list[str]:
        """Return prefixes of blobs that are due for deletion, now or at another time."""
        due = now() if at is None else at
        query = select(GarbageRow.prefix).where(GarbageRow.not_before <= due).limit(limit)
        with self._db.reading() as session:
            return list(session.scalars(query))

    def claim_garbage(self, prefix: str, *, at: datetime | None = None) -> bool:
        """Say whether blobs are still garbage, and to be deleted now: no upload can keep them any more."""
        due = (GarbageRow.prefix == prefix, GarbageRow.not_before <= (at or now()))
        with self._db.writing() as session:
            return (
                session.connection().execute(update(GarbageRow).where(*due).values(claimed=True)).rowcount
                == 1
            )

    def forget_garbage(self, prefix: str) -> None:
        """Record that the blobs of a prefix are deleted."""
        with self._db.writing() as session:
            session.execute(delete(GarbageRow).where(GarbageRow.prefix == prefix))

    def load(self) -> Load:
        """Return the numbers; reads of indexes, except for the counts of rows."""
        photo = (PhotoRow.state, PhotoRow.deleted_at.is_(None), PhotoRow.stage_at)
        correction = (CorrectionRow.state, CorrectionRow.id.is_not(None), CorrectionRow.created_at)
        states = {"photo": ("received", *PHOTO_RUNNING), "correction": ("queued", "running")}
        jobs = {(kind, state): 0 for kind, named in states.items() for state in named}
        oldest = dict.fromkeys(states, 0.0)
        with self._db.reading() as session:
            for kind, (state, exists, since) in {"photo": photo, "correction": correction}.items():
                query = (
                    select(state, func.count(), func.min(since))
                    .where(state.in_(states[kind]), exists)
                    .group_by(state)
                )
                for name, count, first in session.execute(query):
                    jobs[kind, name] = count
                    if name == _WAITING[kind]:
                        oldest[kind] = max((now() - first).total_seconds(), 0.0)
            counted = {
                "photo": select(func.count()).where(PhotoRow.deleted_at.is_(None)),
                "lens": select(func.count()).where(LensRow.deleted_at.is_(None)),
                "sample": select(
                    func.coalesce(func.sum(LensRow.sample_count), 0)
                ),  # a count of samples reads all
            }
            rows = {name: int(session.scalar(query) or 0) for name, query in counted.items()}
            garbage = session.scalar(select(func.count()).select_from(GarbageRow)) or 0
        return Load(jobs, oldest, garbage, rows)
