"""Numbers for an operator: jobs that wait and for how long, rows in the tables."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from sqlalchemy import func, select

from app.store.access.owners import now
from app.store.database import Database
from app.store.tables import PHOTO_RUNNING, CorrectionRow, GarbageRow, LensRow, PhotoRow

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


class OperationStore:
    """Numbers over all owners."""

    def __init__(self, database: Database) -> None:
        self._db = database

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
