"""The version of a lens: grows with every change of its samples, under the lens's row lock."""

from __future__ import annotations

from datetime import timedelta
from typing import Final

from sqlalchemy import func, select, update
from sqlalchemy.orm import Session

from app.store.access.owners import now
from app.store.database import insert_new
from app.store.tables import EventRow, GarbageRow, LensRow, PatchRow, PhotoRow, SampleRow

STILL_WRITTEN: Final = timedelta(minutes=30)
"""How long the previous version is kept (chosen): a worker may still be reporting of it."""


def new_version(session: Session, lens_id: int, *, rebuild: bool = False) -> int:
    """Raise the version by one and return it.

    The UPDATE locks the lens's row until the transaction ends, so that versions and the samples
    that belong to them become visible in the same order. `rebuild` says that samples went away
    or changed: models in memory must be fitted anew instead of extended.
    """
    raised = 1 if rebuild else 0
    version, epoch, public_id = session.execute(
        update(LensRow)
        .where(LensRow.id == lens_id)
        .values(version=LensRow.version + 1, rebuild_epoch=LensRow.rebuild_epoch + raised)
        .returning(LensRow.version, LensRow.rebuild_epoch, LensRow.public_id)
    ).one()
    if version > 1:  # before the first there was nothing to report
        outdated = reports_prefix(public_id, version - 1, epoch - raised)
        insert_new(session, GarbageRow, [{"prefix": outdated, "not_before": now() + STILL_WRITTEN}])
    return int(version)


REPORTS_ROOT: Final = "models/"


def reports_prefix(lens_id: str, version: int, epoch: int) -> str:
    """Return the prefix of what workers make of the samples of one version of a lens."""
    return f"{REPORTS_ROOT}{lens_id}/{version}-{epoch}/"


def report_key(lens_id: str, version: int, epoch: int) -> str:
    """Return the key of the report of that version."""
    return f"{reports_prefix(lens_id, version, epoch)}report.json"


def take_samples(session: Session, photo: PhotoRow, version: int) -> int:
    """Let the samples of this epoch of a photo join its lens in `version`; return how many."""
    newest = select(PatchRow.id).where(PatchRow.photo_id == photo.id, PatchRow.epoch == photo.epoch)
    joined = (
        session.connection()
        .execute(
            update(SampleRow)
            .where(SampleRow.photo_id == photo.id, SampleRow.patch_id.in_(newest))
            .values(lens_id=photo.lens_id, version_added=version)
        )
        .rowcount
    )
    assert photo.lens_id is not None
    recount_samples(session, photo.lens_id)
    return joined


def drop_samples(session: Session, photo: PhotoRow) -> int:
    """Take the samples of a photo out of its lens, without deleting them; return how many."""
    dropped = (
        session.connection()
        .execute(
            update(SampleRow).where(SampleRow.photo_id == photo.id).values(lens_id=None, version_added=None)
        )
        .rowcount
    )
    assert photo.lens_id is not None
    recount_samples(session, photo.lens_id)
    return dropped


def recount_samples(session: Session, lens_id: int) -> None:
    """Count the samples and photos of a lens anew: recomputed, never incremented."""
    samples, photos = session.execute(
        select(func.count(), func.count(SampleRow.photo_id.distinct())).where(SampleRow.lens_id == lens_id)
    ).one()
    session.execute(
        update(LensRow).where(LensRow.id == lens_id).values(sample_count=samples, photo_count=photos)
    )


def record_event(
    session: Session, lens_id: int, version: int, kind: str, photo: PhotoRow | None, *, samples_added: int
) -> None:
    """Write one line of the lens's history."""
    counts = session.execute(
        select(LensRow.sample_count, LensRow.photo_count, LensRow.answering_way).where(LensRow.id == lens_id)
    ).one()
    session.add(
        EventRow(
            lens_id=lens_id,
            version=version,
            kind=kind,
            photo_public_id=None if photo is None else photo.public_id,
            epoch=0 if photo is None else photo.epoch,
            samples_added=samples_added,
            samples=counts[0],
            photos=counts[1],
            way=counts[2],
            created_at=now(),
        )
    )
