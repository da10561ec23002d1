"""Patches of a photo: planned once, each cell finished once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from sqlalchemy import Select, func, select, update
from sqlalchemy.orm import Session

from app.store import windows
from app.store.access.owners import now
from app.store.database import Database, insert_new
from app.store.sample_rows import columns_of
from app.store.tables import PatchRow, PhotoRow, SampleRow
from app.store.windows import NewPatch
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition

OPEN: Final = ("pending", "running")


@dataclass(frozen=True, slots=True, eq=False)
class NewSample:
    """One sample that was estimated from the patch `idx`, and what the estimator says of itself."""

    idx: int
    sample: PsfSample
    diagnostics: Mapping[str, Any] = field(default_factory=dict)


class PatchStore:
    """Patches and the samples that are estimated from them."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def add(self, photo_id: str, epoch: int, patches: Sequence[NewPatch]) -> int:
        """Write the plan of a photo once; return how many patches are to be estimated.

        A second call, by a worker that repeats the step, adds nothing.
        """
        with self._db.writing() as session:
            photo = _live(session, photo_id, epoch)
            if photo is None:
                return 0
            rows = [
                {
                    "photo_id": photo.id,
                    "epoch": epoch,
                    "idx": patch.idx,
                    "cell": patch.cell,
                    "row": patch.row,
                    "col": patch.col,
                    "size": patch.size,
                    "r": patch.r,
                    "phi": patch.phi,
                    "score": patch.score,
                    "state": "pending",
                    "attempts": 0,
                }
                for patch in patches
                if patch.rejected is None
            ]
            insert_new(session, PatchRow, rows)
            rejected = [patch for patch in patches if patch.rejected is not None]
            if photo.windows is None:
                photo.windows, photo.windows_rejected = windows.packed(rejected), len(rejected)
            return recount_patches(session, photo)

    def all_of(self, photo_id: str, epoch: int | None = None) -> list[PatchRow]:
        """Return the patches of a photo that were chosen for estimation, in the order of their numbers."""
        with self._db.reading() as session:
            return list(session.scalars(_of_photo(photo_id, epoch).order_by(PatchRow.idx)))

    def places_of(self, photo_ids: Sequence[str]) -> list[FieldPosition]:
        """Return where patches of photos gave a PSF."""
        query = (
            select(PatchRow.r, PatchRow.phi)
            .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
            .where(PhotoRow.public_id.in_(photo_ids), PatchRow.epoch == PhotoRow.epoch)
            .where(PatchRow.state == "done")
            .order_by(PatchRow.id)
        )
        with self._db.reading() as session:
            return [FieldPosition(r, phi) for r, phi in session.execute(query)]

    def listed(self, photo_id: str) -> list[PatchRow]:
        """Return the patches of a photo, followed by the windows that were rejected before estimation."""
        with self._db.reading() as session:
            rows = list(session.scalars(_of_photo(photo_id).order_by(PatchRow.idx)))
            stored = session.scalar(select(PhotoRow.windows).where(PhotoRow.public_id == photo_id))
        return rows + windows.unpacked(stored)

    def cells(self, photo_id: str, epoch: int) -> list[int]:
        """Return the numbers of the cells that still have patches to estimate."""
        query = _of_photo(photo_id, epoch).where(PatchRow.state.in_(OPEN))
        with self._db.reading() as session:
            cells = session.scalars(query.with_only_columns(PatchRow.cell).distinct())
            return sorted(cell for cell in cells if cell is not None)

    def of_cell(self, photo_id: str, epoch: int, cell: int) -> list[PatchRow]:
        """Return the patches of one cell that are still to be estimated."""
        query = _of_photo(photo_id, epoch).where(PatchRow.state.in_(OPEN), PatchRow.cell == cell)
        with self._db.reading() as session:
            return list(session.scalars(query.order_by(PatchRow.idx)))

    def finish(self, photo_id: str, epoch: int, samples: Sequence[NewSample]) -> int:
        """Store the samples of some patches and mark these done; return how many samples were new.

        Nothing happens if the photo was cancelled, deleted or started anew meanwhile. A repeated
        call stores nothing twice: patch and channel are a unique key.
        """
        with self._db.writing() as session:
            photo = _live(session, photo_id, epoch)
            if photo is None:
                return 0
            numbers = {sample.idx for sample in samples}
            of_numbers = session.scalars(
                select(PatchRow).where(
                    PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, PatchRow.idx.in_(numbers)
                )
            )
            patches = {patch.idx: patch for patch in of_numbers}
            rows = [
                columns_of(new.sample, photo, patches[new.idx], new.diagnostics)
                for new in samples
                if new.idx in patches
            ]
            stored = insert_new(session, SampleRow, rows)
            for patch in patches.values():
                patch.state, patch.finished_at = "done", patch.finished_at or now()
            session.flush()
            recount_patches(session, photo)
            return stored

    def fail(
        self, photo_id: str, epoch: int, indices: Sequence[int], reason: str, *, rejected: bool = False
    ) -> None:
        """Mark patches as useless: `rejected` for their quality, else failed."""
        with self._db.writing() as session:
            photo = _live(session, photo_id, epoch)
            if photo is None:
                return
            session.execute(
                update(PatchRow)
                .where(
                    PatchRow.photo_id == photo.id,
                    PatchRow.epoch == epoch,
                    PatchRow.idx.in_(indices),
                    PatchRow.state != "done",
                )
                .values(state="rejected" if rejected else "failed", reason=reason[:60], finished_at=now())
            )
            recount_patches(session, photo)


def _of_photo(photo_id: str, epoch: int | None = None) -> Select[PatchRow]:
    return (
        select(PatchRow)
        .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
        .where(PhotoRow.public_id == photo_id, PatchRow.epoch == (epoch or PhotoRow.epoch))
    )


def _live(session: Session, photo_id: str, epoch: int) -> PhotoRow | None:
    return session.scalar(
        select(PhotoRow)
        .where(
            PhotoRow.public_id == photo_id,
            PhotoRow.epoch == epoch,
            PhotoRow.state.in_(("selecting", "estimating")),
            PhotoRow.deleted_at.is_(None),
        )
        .with_for_update()  # PostgreSQL: a cancel waits until this transaction is through, and the other way
    )


def recount_patches(session: Session, photo: PhotoRow) -> int:
    """Count the patches anew: recomputed, never incremented, so that a repeat cannot count twice."""
    rows = session.execute(
        select(PatchRow.state, func.count())
        .where(PatchRow.photo_id == photo.id, PatchRow.epoch == photo.epoch)
        .group_by(PatchRow.state)
    )
    counts = {row[0]: row[1] for row in rows}
    rejected = counts.get("rejected", 0)
    photo.patches_rejected = rejected + photo.windows_rejected
    photo.patches_done = counts.get("done", 0) + counts.get("failed", 0)
    photo.patches_total = sum(counts.values()) - rejected
    return photo.patches_total
