"""Patches of photos: planned once, each cell finished once.

Windows that were rejected before estimation are one compact value of their photo, not thousands of rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import Select, func, select, update
from sqlalchemy.orm import Session

from app.store.database import Repository, reads, writes
from app.store.owners import ANY_OWNER, find_to_change
from app.store.samples import columns_of
from app.store.tables import PatchRow, PhotoRow, SampleRow
from lensmodel.core.psf import PsfSample

# Decimals of r and phi (chosen): they round to 0.2 pixels at most in a photo of 24 megapixels, whose half
# diagonal is 3,600 pixels
DIGITS: Final = 4
_WINDOW: Final = ("idx", "row", "col", "size", "r", "phi")
_PLANNED: Final = (*_WINDOW, "cell", "score")


@dataclass(frozen=True, slots=True)
class NewPatch:
    """A window that was chosen, or rejected with a reason."""

    idx: int
    row: int
    col: int
    size: int
    r: float
    phi: float
    cell: int | None = None
    score: float | None = None
    rejected: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class NewSample:
    """One sample that was estimated from the patch `idx`."""

    idx: int
    sample: PsfSample


class Patches(Repository):
    """Patches of photos, and the samples that are estimated from them."""

    @writes
    def plan_patches(self, session: Session, photo_id: str, epoch: int, patches: Sequence[NewPatch]) -> int:
        """Write the plan of a photo once; return how many patches are to be estimated."""
        # A second call, by a worker that repeats the step, adds nothing
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return 0
        if photo.windows is None:
            session.add_all(
                PatchRow(
                    photo_id=photo.id,
                    epoch=epoch,
                    state="pending",
                    **{name: getattr(patch, name) for name in _PLANNED},
                )
                for patch in patches
                if patch.rejected is None
            )
            rejected = [patch for patch in patches if patch.rejected is not None]
            photo.windows, photo.windows_rejected = _packed(rejected), len(rejected)
        return _recount(session, photo)

    @reads
    def patches(self, session: Session, photo_id: str, epoch: int | None = None) -> list[PatchRow]:
        """Return the patches of a photo that were chosen for estimation, in the order of their numbers."""
        return list(session.scalars(_patches_of(photo_id, epoch).order_by(PatchRow.idx)))

    @reads
    def windows(self, session: Session, photo_id: str) -> list[PatchRow]:
        """Return the patches of a photo, followed by the windows that were rejected before estimation."""
        rows = list(session.scalars(_patches_of(photo_id).order_by(PatchRow.idx)))
        query = select(PhotoRow.windows).where(PhotoRow.public_id == photo_id)
        return rows + _unpacked(session.scalar(query))

    @reads
    def cells(self, session: Session, photo_id: str, epoch: int) -> list[int]:
        """Return the numbers of the cells that still have patches to estimate."""
        query = _patches_of(photo_id, epoch).where(PatchRow.state == "pending")
        cells = session.scalars(query.with_only_columns(PatchRow.cell).distinct())
        return sorted(cell for cell in cells if cell is not None)

    @reads
    def patches_of_cell(self, session: Session, photo_id: str, epoch: int, cell: int) -> list[PatchRow]:
        """Return the open patches of one cell; empty if there are none or the photo needs them no more."""
        query = _patches_of(photo_id, epoch).where(
            PhotoRow.epoch == epoch,
            PhotoRow.state == "estimating",
            PatchRow.cell == cell,
            PatchRow.state == "pending",
        )
        return list(session.scalars(query.order_by(PatchRow.idx)))

    @writes
    def add_samples(self, session: Session, photo_id: str, epoch: int, samples: Sequence[NewSample]) -> int:
        """Store the samples of some patches and mark these done; return how many samples were new."""
        # Nothing happens if the photo was cancelled, deleted or started anew meanwhile. A repeated call
        # stores nothing twice: what is done stays as it is.
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return 0
        of_patches = {(new.idx, new.sample.settings.channel): new for new in samples}
        numbers = {new.idx for new in samples}
        mine = (PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, PatchRow.idx.in_(numbers))
        query = select(PatchRow).where(*mine, PatchRow.state != "done")
        patches = {patch.idx: patch for patch in session.scalars(query)}
        rows = [
            SampleRow(**columns_of(new.sample, photo, patches[new.idx]))
            for new in of_patches.values()
            if new.idx in patches
        ]
        session.add_all(rows)
        for patch in patches.values():
            patch.state = "done"
        _recount(session, photo)
        return len(rows)

    @writes
    def fail_patches(
        self,
        session: Session,
        photo_id: str,
        epoch: int,
        reason: str,
        *,
        indices: Sequence[int] | None = None,
        cell: int | None = None,
        rejected: bool = False,
    ) -> None:
        """Mark patches, by their numbers or open ones of a cell, as useless: `rejected` for their quality."""
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return
        which = [PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, PatchRow.state != "done"]
        if indices is not None:
            which.append(PatchRow.idx.in_(indices))
        if cell is not None:
            which += [PatchRow.cell == cell, PatchRow.state == "pending"]
        state = "rejected" if rejected else "failed"
        session.execute(update(PatchRow).where(*which).values(state=state, reason=reason[:60]))
        _recount(session, photo)


def _patches_of(photo_id: str, epoch: int | None = None) -> Select[PatchRow]:
    return (
        select(PatchRow)
        .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
        .where(PhotoRow.public_id == photo_id, PatchRow.epoch == (epoch or PhotoRow.epoch))
    )


def _selecting(session: Session, photo_id: str, epoch: int) -> PhotoRow | None:
    """Return a photo whose patches may change, locked: on PostgreSQL a cancel waits, and the other way."""
    photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
    may = photo is not None and photo.epoch == epoch and photo.state in {"selecting", "estimating"}
    return photo if may else None


def _recount(session: Session, photo: PhotoRow) -> int:
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


def _packed(rejected: Sequence[NewPatch]) -> dict[str, list[Any]]:
    """Return windows as one value that JSON can hold: a list for each column."""
    columns = {name: [getattr(patch, name) for patch in rejected] for name in _WINDOW}
    rounded = {name: [round(value, DIGITS) for value in columns[name]] for name in ("r", "phi")}
    return {**columns, **rounded, "reason": [patch.rejected for patch in rejected]}


def _unpacked(stored: dict[str, list[Any]] | None) -> list[PatchRow]:
    """Return the windows of `_packed` as rows that belong to no table."""
    names, columns = (stored or {}).keys(), (stored or {}).values()
    windows = zip(*columns, strict=True)
    return [PatchRow(state="rejected", **dict(zip(names, window, strict=True))) for window in windows]
