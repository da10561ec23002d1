"""Patches of photos: planned once, each cell finished once.

Windows that were rejected before estimation are one compact value of their photo, not thousands of rows.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
_WINDOW: Final = ("row", "col", "size", "r", "phi", "reason")


class Patches(Repository):
    """Patches of photos, and the samples that are estimated from them."""

    @writes
    def plan_patches(
        self,
        session: Session,
        photo_id: str,
        epoch: int,
        patches: Sequence[Mapping[str, Any]],
        rejected: Sequence[Mapping[str, Any]],
    ) -> int:
        """Write the plan of a photo once, as columns of patches; return how many are to be estimated."""
        # A second call, by a worker that repeats the step, adds nothing
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return 0
        if photo.windows is None:
            which = {"photo_id": photo.id, "epoch": epoch, "state": "pending"}
            session.add_all(PatchRow(**which, idx=idx, **patch) for idx, patch in enumerate(patches))
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
        columns = session.scalar(select(PhotoRow.windows).where(PhotoRow.public_id == photo_id)) or {}
        rejected = enumerate(zip(*columns.values(), strict=True), len(rows))
        return rows + [
            PatchRow(idx=idx, state="rejected", **dict(zip(columns, window, strict=True)))
            for idx, window in rejected
        ]

    @writes
    def add_samples(
        self, session: Session, photo_id: str, epoch: int, samples: Sequence[tuple[int, PsfSample]]
    ) -> int:
        """Store the samples of some patches and mark these done; return how many samples were new."""
        # Nothing happens if the photo was cancelled, deleted or started anew meanwhile. A repeated call
        # stores nothing twice: what is done stays as it is.
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return 0
        new = {(idx, sample.settings.channel): sample for idx, sample in samples}
        numbers = PatchRow.idx.in_({idx for idx, _ in new})
        mine = (PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, numbers)
        query = select(PatchRow).where(*mine, PatchRow.state != "done")
        patches = {patch.idx: patch for patch in session.scalars(query)}
        rows = [
            SampleRow(**columns_of(sample, photo, patches[idx]))
            for (idx, _), sample in new.items()
            if idx in patches
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
        numbers: Sequence[int],
        *,
        rejected: bool = False,
    ) -> None:
        """Mark patches as useless: `rejected` for their quality."""
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return
        mine = (PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, PatchRow.idx.in_(numbers))
        state = "rejected" if rejected else "failed"
        open_ones = update(PatchRow).where(*mine, PatchRow.state != "done")
        session.execute(open_ones.values(state=state, reason=reason[:60]))
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


def _packed(rejected: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return windows as one value that JSON can hold: a list for each column."""
    columns = {name: [window[name] for window in rejected] for name in _WINDOW}
    return columns | {name: [round(value, DIGITS) for value in columns[name]] for name in ("r", "phi")}
