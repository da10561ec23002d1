"""Corrections, the work that the tables ask for, the leases of workers, and blobs to be deleted."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, Final, Literal, TypeAlias

from sqlalchemy import delete, func, select, update
from sqlalchemy.orm import Session

from app.errors import ConflictError, UnknownError
from app.store.database import changed, find_or_insert, new_id, reads, writes
from app.store.owners import ANY_OWNER, Owner, Works, discard, find_to_change, now, page_of
from app.store.tables import (
    CORRECTION_ACTIVE,
    ENDED_BADLY,
    PHOTO_WORKED_ON,
    CorrectionRow,
    EventRow,
    GarbageRow,
    LensRow,
    OwnerRow,
    PhotoRow,
    WorkerRow,
)

Kind: TypeAlias = Literal["photo", "correction", "measure"]

GONE: Final = datetime(1970, 1, 1, tzinfo=UTC)  # heartbeat of a worker that will have no other
_REQUEST: Final = ("photo_id", "lens_public_id", "lens_version", "params_hash")

# Tables of unfinished work by its kind, and its states, that of work which nobody began first
_TABLES: Final[Mapping[Kind, tuple[type[PhotoRow | CorrectionRow], tuple[str, ...]]]] = {
    "photo": (PhotoRow, PHOTO_WORKED_ON),
    "correction": (CorrectionRow, CORRECTION_ACTIVE),
}


@dataclass(frozen=True, slots=True)
class Job:
    """One job: its kind, the ids and numbers of its subject, and the owner for whom it runs."""

    # The id is made of kind and arguments: enqueuing a job twice runs it once

    kind: Kind
    arguments: tuple[str | int, ...]
    owner: str = "local"

    @property
    def id(self) -> str:
        """The engine's id of this job."""
        return "/".join([self.kind, *map(str, self.arguments)])


def params_hash(params: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON of the parameters."""
    return hashlib.sha256(json.dumps(params, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


class Jobs(Works[CorrectionRow]):
    """Corrections, and who does the work of all owners."""

    table, active, unfinished = CorrectionRow, CORRECTION_ACTIVE, CORRECTION_ACTIVE

    # --- corrections ------------------------------------------------------------------------------

    @reads
    def is_known(
        self, session: Session, photo: PhotoRow, lens: LensRow, version: int, params: Mapping[str, Any]
    ) -> bool:
        """Say whether there is the correction of such a request."""
        return session.scalar(_same(_request(photo, lens, version, params))) is not None

    @writes
    def correct(
        self, session: Session, photo: PhotoRow, lens: LensRow, version: int, params: Mapping[str, Any]
    ) -> tuple[CorrectionRow, bool]:
        """Create a correction, or return the one of the same request; True if it is new."""
        request = _request(photo, lens, version, params)
        fresh = CorrectionRow(
            **request,
            public_id=new_id(),
            owner_id=photo.owner_id,
            params=dict(params),
            state="queued",
            **dict.fromkeys(("created_at", "stage_at"), now()),
        )
        current = find_to_change(session, PhotoRow, photo.public_id, ANY_OWNER)
        if current is None:
            raise UnknownError("photo", photo.public_id)
        if current.file_gone_at is not None:
            raise ConflictError(f"the file of photo {photo.public_id} is no longer kept: send it again")
        row, created = find_or_insert(session, _same(request), fresh)
        session.refresh(row, ["photo", "lens"])
        return row, created

    @reads
    def page(
        self, session: Session, owner: str, *, before: str | None, limit: int, photo: PhotoRow | None = None
    ) -> list[CorrectionRow]:
        """Return corrections with their photos and lenses, newest first."""
        of_photo = [] if photo is None else [CorrectionRow.photo_id == photo.id]
        return page_of(session, CorrectionRow, owner, *of_photo, before=before, limit=limit)

    def _taken_over(self, session: Session, row: CorrectionRow) -> None:
        """Let what an earlier run has stored become garbage."""
        if row.attempt:
            discard(session, row.run_folder)

    def _forget_work(self, session: Session, row: CorrectionRow) -> None:
        discard(session, row.run_folder)
        row.stage, row.progress_done, row.progress_total = None, 0, 0

    def _has_twin(self, session: Session, row: CorrectionRow) -> bool:
        return session.scalar(_same({name: getattr(row, name) for name in _REQUEST})) is not None

    @writes
    def progress(
        self, session: Session, run: CorrectionRow, done: int, total: int, stage: str = "correcting"
    ) -> None:
        """Record how far a correction is, as it was taken up."""
        fields = {"progress_done": done, "progress_total": total, "stage": stage}
        self._move_run(session, run, "running", **fields)

    @writes
    def finish(
        self, session: Session, /, run: CorrectionRow, report: Mapping[str, Any], **result: str | int
    ) -> bool:
        """End with a file; False if it was cancelled, or begun again by another worker, meanwhile."""
        # `result`: key, etag, media_type, bytes and name of the file, and `shown_bytes` of pictures of it
        fields = {f"result_{name}": value for name, value in result.items()}
        return self._move_run(session, run, "succeeded", report=dict(report), **fields)

    def _move_run(self, session: Session, run: CorrectionRow, state: str, **fields: object) -> bool:
        of_run: dict[str, Any] = {"epoch": run.epoch, "attempt": run.attempt, **fields}
        return self.move(session, run.public_id, ANY_OWNER, ("running",), state, **of_run) is not None

    @reads
    def ended_before(self, session: Session, moment: datetime, limit: int = 100) -> list[str]:
        """Return corrections that ended before a moment, whatever came of them."""
        ended = (CorrectionRow.state.not_in(CORRECTION_ACTIVE), CorrectionRow.finished_at < moment)
        return list(session.scalars(select(CorrectionRow.public_id).where(*ended).limit(limit)))

    @writes
    def delete(self, session: Session, correction_id: str, owner: Owner) -> str | None:
        """Forget a correction; return the prefix of its blobs, None if there is no such correction."""
        row = find_to_change(session, CorrectionRow, correction_id, owner)
        if row is None:
            return None
        discard(session, row.folder)
        session.delete(row)
        return row.folder

    # --- what is to do ----------------------------------------------------------------------------

    @reads
    def to_do(self, session: Session, *, begun: bool = False, limit: int = 100) -> list[Job]:
        """Return the jobs that the tables ask for, the oldest first; also those that workers began."""
        query = (
            select(LensRow.public_id, LensRow.version)
            .join(EventRow, (EventRow.lens_id == LensRow.id) & (EventRow.version == LensRow.version))
            .where(EventRow.metrics.is_(None), LensRow.sample_count > 0)
        )
        jobs = [Job("measure", (row[0], row[1])) for row in session.execute(query.limit(limit))]
        for kind, (table, states) in _TABLES.items():
            rows = session.execute(
                select(table.public_id, table.epoch, OwnerRow.name)
                .join(OwnerRow, OwnerRow.id == table.owner_id)
                .where(table.state.in_(states if begun else states[:1]))
                .order_by(table.id)
                .limit(10 * limit if begun else limit)
            )
            jobs += [Job(kind, (row[0], row[1]), row[2]) for row in rows]
        return jobs

    @reads
    def load(self, session: Session) -> tuple[dict[tuple[str, str], int], dict[str, float]]:
        """Return unfinished jobs by kind and state, and for how many seconds the oldest of a kind waits."""
        jobs: dict[tuple[str, str], int] = {}
        oldest: dict[str, float] = {}
        for kind, (table, states) in _TABLES.items():
            query = select(table.state, func.count(), func.min(table.stage_at)).where(table.state.in_(states))
            found = {row[0]: row for row in session.execute(query.group_by(table.state))}
            jobs |= {(kind, state): found[state][1] if state in found else 0 for state in states}
            waits = now() - found[states[0]][2] if states[0] in found else timedelta(0)
            oldest[kind] = max(waits.total_seconds(), 0.0)
        return jobs, oldest

    # --- workers ----------------------------------------------------------------------------------

    def _now(self, session: Session) -> datetime:
        """Return the time that all workers share: a database server's, whatever their own clocks say."""
        return now() if self.database.is_sqlite else session.scalars(select(func.now())).one()

    @writes
    def register(self, session: Session, worker_id: str, *, confined: str = "") -> None:
        """Enter a new worker, with the measures that confine its children."""
        session.add(WorkerRow(id=worker_id, heartbeat_at=self._now(session), confined=confined))

    @writes
    def beat(self, session: Session, worker_id: str) -> bool:
        """Renew the lease; False if the worker was declared dead: it must then stop at once."""
        mine = (WorkerRow.id == worker_id, WorkerRow.heartbeat_at > GONE)
        return changed(session, update(WorkerRow).where(*mine).values(heartbeat_at=self._now(session))) == 1

    @reads
    def live(self, session: Session, lease_seconds: float) -> list[WorkerRow]:
        """Return the workers whose last heartbeat is within the lease."""
        since = self._now(session) - timedelta(seconds=lease_seconds)
        return list(session.scalars(select(WorkerRow).where(WorkerRow.heartbeat_at > since)))

    @reads
    def workers(self, session: Session) -> list[WorkerRow]:
        """Return every worker that has a row, whatever its lease."""
        return list(session.scalars(select(WorkerRow)))

    @writes
    def bury(self, session: Session, worker_id: str) -> None:
        """Let a lease end at once: the worker has stopped, or its process is known to be gone."""
        session.execute(update(WorkerRow).where(WorkerRow.id == worker_id).values(heartbeat_at=GONE))

    @writes
    def remove_dead(self, session: Session, lease_seconds: float, *, by: str) -> list[str]:
        """Remove the others whose lease has ended; the one who did it takes over all that they had begun."""
        before = self._now(session) - timedelta(seconds=lease_seconds)
        dead = delete(WorkerRow).where(WorkerRow.heartbeat_at < before, WorkerRow.id != by)
        return list(session.scalars(dead.returning(WorkerRow.id)))

    # --- garbage ----------------------------------------------------------------------------------

    @reads
    def garbage(self, session: Session, limit: int = 100, *, at: datetime | None = None) -> list[str]:
        """Return prefixes of blobs that are due for deletion, now or at another time."""
        due = GarbageRow.not_before <= (at or now())
        return list(session.scalars(select(GarbageRow.prefix).where(due).limit(limit)))

    @writes
    def claim_garbage(self, session: Session, prefix: str, *, at: datetime | None = None) -> bool:
        """Say whether blobs are still garbage, and to be deleted now: no upload can keep them any more."""
        due = (GarbageRow.prefix == prefix, GarbageRow.not_before <= (at or now()))
        return changed(session, update(GarbageRow).where(*due).values(claimed=True)) == 1

    @writes
    def forget_garbage(self, session: Session, prefix: str) -> None:
        """Record that the blobs of a prefix are deleted."""
        session.execute(delete(GarbageRow).where(GarbageRow.prefix == prefix))


def _request(photo: PhotoRow, lens: LensRow, version: int, params: Mapping[str, Any]) -> dict[str, Any]:
    return dict(zip(_REQUEST, (photo.id, lens.public_id, version, params_hash(params)), strict=True))


def _same(request: Mapping[str, Any]) -> Any:  # noqa: ANN401 - a selection of corrections
    """Select the correction of the same request that has not failed and was not cancelled."""
    columns = [getattr(CorrectionRow, name) == value for name, value in request.items()]
    return select(CorrectionRow).where(*columns, CorrectionRow.state.not_in(ENDED_BADLY))
