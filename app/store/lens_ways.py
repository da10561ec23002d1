"""A lens that changes its way: its photos are estimated anew while the old samples still count.

A lens answers from samples of one way, its `answering_way`. When its owner chooses another `way`, each
counted photo begins a new epoch and is `relearning`: its earlier samples still count. Once no such photo is
being worked on any more, one transaction replaces all samples. So samples of two ways never count together,
whichever process dies when, and until then nothing is lost: the old way can be chosen again at any moment.
"""

from __future__ import annotations

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from app.store.access.owners import now
from app.store.patches import recount_patches
from app.store.photo_steps import WORKED_ON, drop_patches, restart
from app.store.tables import PHOTO_RUNNING, EventRow, LensRow, PatchRow, PhotoRow
from app.store.versions import new_version, record_event, recount_samples, take_samples


def locked(session: Session, lens_id: int) -> LensRow:
    """Return the present row of a lens, locked until the transaction ends."""
    query = select(LensRow).where(LensRow.id == lens_id).with_for_update()
    return session.scalars(query.execution_options(populate_existing=True)).one()


def photos_of(session: Session, lens: LensRow) -> list[PhotoRow]:
    """Return the photos of a lens, locked until the transaction ends."""
    query = select(PhotoRow).where(PhotoRow.lens_id == lens.id, PhotoRow.deleted_at.is_(None))
    return list(session.scalars(query.order_by(PhotoRow.id).with_for_update()))


def teaches(session: Session, photo: PhotoRow) -> bool:
    """Whether samples of a photo count: those of this epoch, or those of an earlier one."""
    if photo.relearning:
        return True
    if photo.state != "counted" or photo.lens_id is None:
        return False
    return photo.way == locked(session, photo.lens_id).answering_way


def join(session: Session, photo: PhotoRow, kind: str) -> int | None:
    """Let the samples of a counted photo join its lens, at once or when the lens has changed its way.

    Returns the new version of the lens, None where it has to wait.
    """
    assert photo.lens_id is not None
    lens = locked(session, photo.lens_id)
    if lens.way != lens.answering_way:
        return settle_way(session, lens.id)
    return _add(session, photo, kind)


def _add(session: Session, photo: PhotoRow, kind: str) -> int:
    assert photo.lens_id is not None
    version = new_version(session, photo.lens_id, rebuild=kind != "photo_added")
    added = take_samples(session, photo, version)
    record_event(session, photo.lens_id, version, kind, photo, samples_added=added)
    return version


def choose_way(session: Session, lens: LensRow, way: str) -> int:
    """Choose the way of a lens; its counted photos start again, and so do those that are being estimated.

    Returns how many photos cannot because their files are gone; then nothing changes.
    """
    if lens.way == way:
        return 0
    photos = photos_of(session, lens)
    returns = way == lens.answering_way
    counted = [photo for photo in photos if photo.state == "counted" and photo.way != way]
    missing = sum(photo.file_gone_at is not None for photo in counted)
    if missing:
        return missing
    lens.way = way
    if lens.sample_count == 0:
        lens.answering_way = way
    for photo in photos:
        if photo.relearning:
            _take_back(session, photo, way)
        elif photo in counted:
            photo.relearning = not returns  # else it was waiting to join in the way that is given up
            photo.given = {**photo.given, "lens_id": lens.public_id}
            restart(session, photo)
        elif photo.state in PHOTO_RUNNING:
            restart(session, photo)
    session.flush()
    return 0


def settle_way(session: Session, lens_id: int) -> int | None:
    """Let a lens answer in the way that was chosen, once no photo is being estimated in it any more.

    Returns the new version of the lens, None where nothing changes. Where no photo could be estimated in the
    new way, the lens still answers in the old one.
    """
    lens = locked(session, lens_id)
    if lens.deleted_at is not None or lens.way == lens.answering_way:
        return None
    if lens.sample_count == 0:
        lens.answering_way = lens.way
    of_lens = (PhotoRow.lens_id == lens.id, PhotoRow.deleted_at.is_(None))
    photos = list(
        session.scalars(
            select(PhotoRow).where(*of_lens).order_by(PhotoRow.id).execution_options(populate_existing=True)
        )
    )
    ready = [photo for photo in photos if photo.state == "counted" and photo.way == lens.way]
    if not ready or any(photo.relearning and photo.state in WORKED_ON for photo in photos):
        return None
    samples_before, lens.answering_way = lens.sample_count, lens.way
    relearned = [photo for photo in ready if photo.relearning]
    version = new_version(session, lens.id, rebuild=True)
    for photo in photos:
        if photo.relearning:
            forget_before(session, photo)
    for photo in relearned:
        take_samples(session, photo, version)
    recount_samples(session, lens.id)
    session.refresh(lens)
    record_event(
        session, lens.id, version, "model_changed", None, samples_added=lens.sample_count - samples_before
    )
    for photo in ready:
        if photo not in relearned:
            version = _add(session, photo, "photo_included" if _has_joined(session, photo) else "photo_added")
    return version


def _has_joined(session: Session, photo: PhotoRow) -> bool:
    """Whether this epoch of a photo was added before: to this lens until it was excluded, or to another."""
    event = select(EventRow.id).where(
        EventRow.photo_public_id == photo.public_id,
        EventRow.epoch == photo.epoch,
        EventRow.kind == "photo_added",
    )
    return session.scalar(event.limit(1)) is not None


def _take_back(session: Session, photo: PhotoRow, way: str) -> None:
    """Undo the restart of a photo; its earlier samples never ceased to count."""
    drop_patches(session, photo)
    photo.epoch += 1  # work of the epoch that is given up is void
    session.execute(update(PatchRow).where(PatchRow.photo_id == photo.id).values(epoch=photo.epoch))
    photo.way, photo.relearning = way, False
    photo.state = "counted"
    photo.stage_at = photo.finished_at = photo.counted_at = now()
    photo.error_code = photo.error_detail = None
    session.flush()
    recount_patches(session, photo)


def forget_before(session: Session, photo: PhotoRow) -> None:
    """Delete the patches and samples of a photo that are not of this epoch."""
    session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id, PatchRow.epoch != photo.epoch))
    photo.relearning = False
    session.flush()
