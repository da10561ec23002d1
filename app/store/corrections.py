"""Corrections: each request is stored once, each change of state happens once."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Select, func, select, update

from app.errors import BusyError, ConflictError, UnknownPhotoError
from app.store.database import Database, insert_new, new_id
from app.store.owners import ANY_OWNER, LATE, Owner, find_owned, find_to_change, is_id, now, owned
from app.store.tables import CorrectionRow, GarbageRow, LensRow, OwnerRow, PhotoRow

ACTIVE = ("queued", "running")

TRIES = 10
"""How often to look again for the same correction that ended between insert and select (chosen)."""


@dataclass(frozen=True, slots=True)
class Run:
    """One run of a correction: a worker that lost its lease, or was begun before a retry, has another."""

    correction_id: str
    epoch: int
    attempt: int


@dataclass(frozen=True, slots=True)
class CorrectionPlan:
    """A correction with its photo and its lens: everything that a worker needs."""

    correction: CorrectionRow
    photo: PhotoRow
    lens: LensRow


@dataclass(frozen=True, slots=True)
class Result:
    """A finished file and how to hand it out."""

    key: str
    etag: str
    media_type: str
    size: int
    name: str


def params_hash(params: Mapping[str, Any]) -> str:
    """Return the SHA-256 of the canonical JSON of the parameters."""
    return hashlib.sha256(json.dumps(params, sort_keys=True, separators=(",", ":")).encode()).hexdigest()


def correction_folder(correction: CorrectionRow) -> str:
    """Return the prefix of a correction's blobs."""
    return f"corrections/{correction.public_id}/"


def run_folder(correction: CorrectionRow) -> str:
    """Return the prefix of the files of a correction's last run: no other run writes there."""
    return f"{correction_folder(correction)}{correction.epoch}-{correction.attempt}/"


def _plans(owner: Owner) -> Select[Any]:
    """Select an owner's corrections, each with its photo and lens."""
    return (
        owned(CorrectionRow, owner)
        .join(PhotoRow, PhotoRow.id == CorrectionRow.photo_id)
        .join(LensRow, LensRow.id == CorrectionRow.lens_id)
        .add_columns(PhotoRow, LensRow)
    )


class CorrectionStore:
    """Corrections of all owners. `ANY_OWNER` asks as the service itself."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def create(
        self, photo: PhotoRow, lens: LensRow, version: int, params: Mapping[str, Any]
    ) -> tuple[CorrectionRow, bool]:
        """Create a correction, or return the one of the same request; True if it is new."""
        fresh = {
            "public_id": new_id(),
            "owner_id": photo.owner_id,
            "photo_id": photo.id,
            "lens_id": lens.id,
            "lens_version": version,
            "params": dict(params),
            "params_hash": params_hash(params),
            "attempt": 0,
            "state": "queued",
            "progress_done": 0,
            "progress_total": 0,
            "created_at": now(),
        }
        with self._db.writing(durable=True) as session:
            query = owned(PhotoRow, ANY_OWNER).where(PhotoRow.public_id == photo.public_id)
            current = session.scalar(query.with_for_update())
            # by its public id: SQLite may have given the key of a deleted photo to another one
            if current is None or (current.id, current.owner_id) != (photo.id, photo.owner_id):
                raise UnknownPhotoError(f"photo {photo.public_id} was deleted meanwhile: send it again")
            if current.file_gone_at is not None:
                raise ConflictError(f"the file of photo {photo.public_id} is no longer kept: send it again")
            same = select(CorrectionRow).where(
                CorrectionRow.photo_id == photo.id,
                CorrectionRow.lens_id == lens.id,
                CorrectionRow.lens_version == version,
                CorrectionRow.params_hash == fresh["params_hash"],
                CorrectionRow.state.not_in(("failed", "cancelled")),
            )
            for _ in range(TRIES):
                created = insert_new(session, CorrectionRow, [fresh]) == 1
                row = session.scalar(same)
                if row is not None:
                    return row, created
        raise BusyError(f"{TRIES} times the same correction ended just then: ask for it again")

    def get(self, correction_id: str, owner: Owner) -> CorrectionRow | None:
        """Return one correction, or None."""
        with self._db.reading() as session:
            return find_owned(session, CorrectionRow, correction_id, owner)

    def plan(self, correction_id: str, owner: Owner) -> CorrectionPlan | None:
        """Return a correction with its photo and lens, or None."""
        if not is_id(correction_id):
            return None
        query = _plans(owner).where(CorrectionRow.public_id == correction_id)
        with self._db.reading() as session:
            row = session.execute(query).one_or_none()
            return None if row is None else CorrectionPlan(*row)

    def page(
        self, owner: str, *, before: str | None, limit: int, photo: PhotoRow | None = None
    ) -> list[CorrectionPlan]:
        """Return corrections, newest first."""
        query = _plans(owner).order_by(CorrectionRow.public_id.desc()).limit(limit)
        if before is not None:
            query = query.where(CorrectionRow.public_id < before)
        if photo is not None:
            query = query.where(CorrectionRow.photo_id == photo.id)
        with self._db.reading() as session:
            return [CorrectionPlan(*row) for row in session.execute(query)]

    def to_do(self, limit: int = 100) -> list[tuple[str, int, str]]:
        """Return `(correction_id, epoch, owner)` of queued corrections, oldest first: the intent sweep."""
        return self._in_states(("queued",), limit)

    def running(self, limit: int = 1000) -> list[tuple[str, int, str]]:
        """Return `(correction_id, epoch, owner)` of corrections that a worker is busy with."""
        return self._in_states(("running",), limit)

    def _in_states(self, states: Sequence[str], limit: int) -> list[tuple[str, int, str]]:
        query = (
            select(CorrectionRow.public_id, CorrectionRow.epoch, OwnerRow.name)
            .join(OwnerRow, OwnerRow.id == CorrectionRow.owner_id)
            .where(CorrectionRow.state.in_(states))
            .order_by(CorrectionRow.id)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [(row[0], row[1], row[2]) for row in session.execute(query)]

    def is_live(self, correction_id: str, epoch: int | None = None) -> bool:
        """Say whether the correction is still wanted: the cancel poll."""
        row = self.get(correction_id, ANY_OWNER)
        return row is not None and row.state in ACTIVE and epoch in {None, row.epoch}

    def set_state(
        self,
        correction_id: str,
        from_states: Sequence[str],
        to: str,
        *,
        epoch: int | None = None,
        run: Run | None = None,
        **fields: object,
    ) -> bool:
        """Move a correction from one of `from_states` to `to`; False where it was in none of them.

        With `epoch` only if it was not started anew since, with `run` only if that is its last one.
        """
        conditions = [CorrectionRow.public_id == correction_id, CorrectionRow.state.in_(from_states)]
        if epoch is not None:
            conditions.append(CorrectionRow.epoch == epoch)
        if run is not None:
            conditions += [CorrectionRow.epoch == run.epoch, CorrectionRow.attempt == run.attempt]
        with self._db.writing() as session:
            statement = update(CorrectionRow).where(*conditions).values(state=to, **fields)
            return session.connection().execute(statement).rowcount == 1

    def start(self, correction_id: str, epoch: int | None = None) -> Run | None:
        """Begin, or begin again after the death of a worker; None if it is not to be done any more.

        What an earlier run has stored becomes garbage.
        """
        with self._db.writing() as session:
            row = find_to_change(session, CorrectionRow, correction_id, ANY_OWNER)
            if row is None or row.state not in ACTIVE or epoch not in {None, row.epoch}:
                return None
            if row.attempt:
                insert_new(session, GarbageRow, [{"prefix": run_folder(row), "not_before": now() + LATE}])
            row.state, row.started_at, row.attempt = "running", now(), row.attempt + 1
            return Run(row.public_id, row.epoch, row.attempt)

    def retry(self, correction_id: str, owner: Owner) -> bool:
        """Start a failed or cancelled correction anew; False if it is in another state.

        False as well if the same correction was requested again meanwhile: that one will do.
        """
        with self._db.writing() as session:
            row = find_to_change(session, CorrectionRow, correction_id, owner)
            if row is None or row.state not in {"failed", "cancelled"}:
                return False
            twin = select(CorrectionRow.id).where(
                CorrectionRow.photo_id == row.photo_id,
                CorrectionRow.lens_id == row.lens_id,
                CorrectionRow.lens_version == row.lens_version,
                CorrectionRow.params_hash == row.params_hash,
                CorrectionRow.state.not_in(("failed", "cancelled")),
            )
            if session.scalar(twin) is not None:
                return False
            insert_new(session, GarbageRow, [{"prefix": run_folder(row), "not_before": now() + LATE}])
            row.epoch += 1
            row.state, row.stage = "queued", None
            row.error_code = row.error_detail = row.started_at = row.finished_at = None
            row.attempt = row.progress_done = row.progress_total = 0
            return True

    def failed_by(self, owner: str, code: str, limit: int) -> list[str]:
        """Return the corrections that ended with a code, oldest first."""
        query = (
            owned(CorrectionRow, owner)
            .where(CorrectionRow.state == "failed", CorrectionRow.error_code == code)
            .order_by(CorrectionRow.id)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [row.public_id for row in session.scalars(query)]

    def progress(self, run: Run, done: int, total: int, stage: str = "correcting") -> None:
        """Record how far a running correction is."""
        self.set_state(
            run.correction_id,
            ("running",),
            "running",
            run=run,
            progress_done=done,
            progress_total=total,
            stage=stage,
        )

    def finish(self, run: Run, result: Result, report: Mapping[str, Any]) -> bool:
        """End with a file; False if it was cancelled, or begun again by another worker, meanwhile."""
        return self.set_state(
            run.correction_id,
            ("running",),
            "succeeded",
            run=run,
            report=dict(report),
            result_key=result.key,
            result_etag=result.etag,
            result_media_type=result.media_type,
            result_bytes=result.size,
            result_name=result.name,
            finished_at=now(),
        )

    def fail(self, correction_id: str, code: str, detail: str, *, epoch: int | None = None) -> bool:
        """End with a reason."""
        return self.set_state(
            correction_id,
            ACTIVE,
            "failed",
            epoch=epoch,
            error_code=code,
            error_detail=detail,
            finished_at=now(),
        )

    def cancel(self, correction_id: str, owner: Owner) -> bool:
        """Cancel an unfinished correction; False if it was finished already."""
        if self.get(correction_id, owner) is None:
            return False
        return self.set_state(correction_id, ACTIVE, "cancelled", finished_at=now())

    def unfinished_of(self, owner: str) -> int:
        """Return how many corrections of an owner wait or run."""
        query = owned(CorrectionRow, owner).where(CorrectionRow.state.in_(ACTIVE))
        with self._db.reading() as session:
            return session.scalar(select(func.count()).select_from(query.subquery())) or 0

    def ended_before(self, moment: datetime, limit: int = 100) -> list[str]:
        """Return corrections that ended before a moment, whatever came of them."""
        query = (
            select(CorrectionRow.public_id)
            .where(CorrectionRow.state.not_in(ACTIVE), CorrectionRow.finished_at < moment)
            .limit(limit)
        )
        with self._db.reading() as session:
            return list(session.scalars(query))

    def delete(self, correction_id: str, owner: Owner) -> str | None:
        """Forget a correction; return the prefix of its blobs, None if there is no such correction."""
        with self._db.writing() as session:
            row = find_owned(session, CorrectionRow, correction_id, owner)
            if row is None:
                return None
            prefix = correction_folder(row)
            insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": now() + LATE}])
            session.delete(row)
            return prefix
