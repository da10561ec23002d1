"""What must hold in the tables at every moment, whichever process dies when; for tests and for operators.

Each check is one query that returns the rows which break it: none on a sound installation. Some can repair
them by the same steps as the service itself: a repaired lens gets a new version.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, TypeAlias

from sqlalchemy import ColumnElement, Select, and_, exists, func, or_, select, text
from sqlalchemy.orm import Session

from app.store.lenses import give_back, join, recount_samples
from app.store.patches import recount_patches
from app.store.tables import CorrectionRow, EventRow, LensRow, PatchRow, PhotoRow, SampleRow

Find: TypeAlias = Callable[[Session], Sequence[str]]
Mend: TypeAlias = Callable[[Session, str], None]

_ALIVE: Final = PhotoRow.deleted_at.is_(None)
_COUNTS: Final = and_(PhotoRow.state == "counted", _ALIVE)


@dataclass(frozen=True, slots=True)
class Invariant:
    """One thing that must hold.

    Parameters
    ----------
    name : str
        Its name.
    sentence : str
        What holds.
    find : callable
        Returns the public ids of what breaks it.
    mend : callable, optional
        Repairs one of these, in the transaction of the session.
    remedy : str
        What to do where `mend` is not given.
    """

    name: str
    sentence: str
    find: Find
    mend: Mend | None = None
    remedy: str = "restore the last backup, and report it"


def _ids(query: Select[str]) -> Find:
    def find(session: Session) -> Sequence[str]:
        return list(session.scalars(query.limit(1000)))

    return find


def _integrity(session: Session) -> Sequence[str]:
    """Let SQLite check its whole file; a database server checks its own pages."""
    if session.get_bind().dialect.name != "sqlite":
        return []
    messages = [str(row[0]) for row in session.execute(text("PRAGMA integrity_check"))]
    foreign = [f"{row[0]} row {row[1]}" for row in session.execute(text("PRAGMA foreign_key_check"))]
    return [line for line in messages if line != "ok"] + foreign


def _events() -> Select[str]:
    numbered = (
        select(func.count(EventRow.id))
        .where(EventRow.lens_id == LensRow.id)
        .correlate(LensRow)
        .scalar_subquery()
    )
    last = (
        select(func.coalesce(func.max(EventRow.version), 0))
        .where(EventRow.lens_id == LensRow.id)
        .correlate(LensRow)
        .scalar_subquery()
    )
    return select(LensRow.public_id).where(
        LensRow.deleted_at.is_(None), or_(LensRow.version != numbered, LensRow.version != last)
    )


def _totals() -> Select[str]:
    counted = (
        select(
            SampleRow.lens_id.label("lens"),
            func.count().label("samples"),
            func.count(SampleRow.photo_id.distinct()).label("photos"),
        )
        .where(SampleRow.lens_id.is_not(None))
        .group_by(SampleRow.lens_id)
        .subquery()
    )
    return (
        select(LensRow.public_id)
        .outerjoin(counted, counted.c.lens == LensRow.id)
        .where(
            or_(
                LensRow.sample_count != func.coalesce(counted.c.samples, 0),
                LensRow.photo_count != func.coalesce(counted.c.photos, 0),
            )
        )
    )


def _recount_lens(session: Session, lens_id: str) -> None:
    lens = session.scalars(select(LensRow).where(LensRow.public_id == lens_id).with_for_update()).one()
    recount_samples(session, lens.id)


def _joined() -> Select[str]:
    event = (
        select(EventRow.id)
        .where(
            EventRow.lens_id == PhotoRow.lens_id,
            EventRow.photo_public_id == PhotoRow.public_id,
            EventRow.kind.in_(("photo_added", "photo_included")),
        )
        .correlate(PhotoRow)
    )
    return select(PhotoRow.public_id).where(_COUNTS, ~exists(event))


def _votes() -> Select[str]:
    """Photos with a sample that counts and must not, or that must count and does not."""
    rightly: ColumnElement[bool] = and_(
        SampleRow.lens_id == PhotoRow.lens_id,
        SampleRow.version_added.is_not(None),
        SampleRow.version_added <= LensRow.version,
    )
    must: ColumnElement[bool] = and_(_COUNTS, PatchRow.epoch == PhotoRow.epoch)
    return (
        select(PhotoRow.public_id)
        .join(SampleRow, SampleRow.photo_id == PhotoRow.id)
        .join(PatchRow, PatchRow.id == SampleRow.patch_id)
        .outerjoin(LensRow, LensRow.id == SampleRow.lens_id)
        .where(
            or_(
                and_(must, or_(SampleRow.lens_id.is_(None), ~rightly)),
                and_(~must, SampleRow.lens_id.is_not(None)),
            )
        )
        .distinct()
    )


def _vote_anew(session: Session, photo_id: str) -> None:
    """Take all samples of a photo out of any lens; let them join its own, if the photo counts."""
    photo = session.scalars(select(PhotoRow).where(PhotoRow.public_id == photo_id).with_for_update()).one()
    held = select(SampleRow.lens_id).where(SampleRow.photo_id == photo.id, SampleRow.lens_id.is_not(None))
    for lens_id in sorted({key for key in session.scalars(held.distinct()) if key is not None}):
        true_lens_id, photo.lens_id = photo.lens_id, lens_id
        session.flush()
        give_back(session, photo, "photo_removed")
        photo.lens_id = true_lens_id
        session.flush()
    if photo.lens_id is not None and photo.state == "counted" and photo.deleted_at is None:
        join(session, photo, "photo_included")


def _sampled() -> Select[str]:
    """Photos with a patch that is done and has no sample, or has one and is not done."""
    sample = select(SampleRow.id).where(SampleRow.patch_id == PatchRow.id).correlate(PatchRow)
    return (
        select(PhotoRow.public_id)
        .join(PatchRow, PatchRow.photo_id == PhotoRow.id)
        .where(
            _ALIVE,
            or_(
                and_(PatchRow.state == "done", ~exists(sample)),
                and_(PatchRow.state != "done", exists(sample)),
            ),
        )
        .distinct()
    )


def _progress() -> Select[str]:
    def number(*states: str) -> ColumnElement[int]:
        return func.coalesce(
            select(func.count(PatchRow.id))
            .where(
                PatchRow.photo_id == PhotoRow.id, PatchRow.epoch == PhotoRow.epoch, PatchRow.state.in_(states)
            )
            .correlate(PhotoRow)
            .scalar_subquery(),
            0,
        )

    used = ("pending", "running", "done", "failed", "cancelled")
    return select(PhotoRow.public_id).where(
        _ALIVE,
        PhotoRow.state.in_(("estimating", "counted", "excluded")),
        or_(
            PhotoRow.patches_done != number("done", "failed"),
            PhotoRow.patches_total != number(*used),
            PhotoRow.patches_rejected != number("rejected") + PhotoRow.windows_rejected,
        ),
    )


def _recount_photo(session: Session, photo_id: str) -> None:
    photo = session.scalars(select(PhotoRow).where(PhotoRow.public_id == photo_id).with_for_update()).one()
    recount_patches(session, photo)


def _ended() -> Select[str]:
    gone = select(LensRow.id).where(LensRow.id == PhotoRow.lens_id, LensRow.deleted_at.is_not(None))
    counted = or_(PhotoRow.lens_id.is_(None), PhotoRow.counted_at.is_(None), exists(gone.correlate(PhotoRow)))
    return select(PhotoRow.public_id).where(
        _ALIVE,
        or_(
            and_(PhotoRow.state == "counted", counted),
            and_(
                PhotoRow.state == "failed", or_(PhotoRow.error_code.is_(None), PhotoRow.finished_at.is_(None))
            ),
        ),
    )


def _other_model() -> Select[str]:
    return (
        select(PhotoRow.public_id)
        .join(LensRow, LensRow.id == PhotoRow.lens_id)
        .where(PhotoRow.state.in_(("counted", "excluded")), PhotoRow.way != LensRow.way, _ALIVE)
    )


def _forgotten() -> Select[str]:
    sample = select(SampleRow.id).where(SampleRow.photo_id == PhotoRow.id).correlate(PhotoRow)
    patch = select(PatchRow.id).where(PatchRow.photo_id == PhotoRow.id).correlate(PhotoRow)
    return select(PhotoRow.public_id).where(
        PhotoRow.deleted_at.is_not(None),
        or_(PhotoRow.sha256 != "", PhotoRow.filename != "", exists(sample), exists(patch)),
    )


def _forgotten_lenses() -> Select[str]:
    return select(LensRow.public_id).where(
        LensRow.deleted_at.is_not(None),
        or_(LensRow.serial.is_not(None), LensRow.label.is_not(None), LensRow.sample_count != 0),
    )


def _foreign_lens() -> Select[str]:
    return (
        select(PhotoRow.public_id)
        .join(LensRow, LensRow.id == PhotoRow.lens_id)
        .where(LensRow.owner_id != PhotoRow.owner_id)
    )


def _foreign_photo() -> Select[str]:
    return (
        select(CorrectionRow.public_id)
        .join(PhotoRow, PhotoRow.id == CorrectionRow.photo_id)
        .where(CorrectionRow.owner_id != PhotoRow.owner_id)
    )


INVARIANTS: Final = (
    Invariant("database", "the database is whole", _integrity),
    Invariant("versions", "the version of a lens is the number of its events", _ids(_events())),
    Invariant("totals", "lenses count their samples and photos rightly", _ids(_totals()), _recount_lens),
    Invariant("joined", "each counted photo joined its lens by an event", _ids(_joined())),
    Invariant("votes", "exactly the samples of counted photos count", _ids(_votes()), _vote_anew),
    Invariant("samples", "patches are done exactly if they have samples", _ids(_sampled())),
    Invariant("progress", "photos count their patches rightly", _ids(_progress()), _recount_photo),
    Invariant("endings", "counted photos have a lens, failed ones a reason", _ids(_ended())),
    Invariant("models", "photos count for lenses of their model", _ids(_other_model())),
    Invariant("forgotten photos", "nothing is kept of deleted photos", _ids(_forgotten())),
    Invariant("forgotten lenses", "nothing is kept of deleted lenses", _ids(_forgotten_lenses())),
    Invariant("owners of lenses", "photos teach lenses of their owner", _ids(_foreign_lens())),
    Invariant("owners of photos", "corrections are of photos of their owner", _ids(_foreign_photo())),
)
