"""The samples of a photo: they join its lens, leave it, and move with the photo to another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Literal

from sqlalchemy.orm import Session

from app.store.access.owners import now
from app.store.lens_ways import forget_before, join, locked, settle_way, teaches
from app.store.photo_steps import restart
from app.store.tables import LensRow, PhotoRow
from app.store.versions import drop_samples, new_version, record_event


def give_back(session: Session, photo: PhotoRow, kind: str) -> None:
    """Take the samples of a photo out of its lens, which gets a new version that must be fitted anew.

    The earlier samples of a photo that is `relearning` are deleted.
    """
    assert photo.lens_id is not None
    version = new_version(session, photo.lens_id, rebuild=True)
    dropped = drop_samples(session, photo)
    record_event(session, photo.lens_id, version, kind, photo, samples_added=-dropped)
    if photo.relearning:
        forget_before(session, photo)


def switch(session: Session, photo: PhotoRow, after: Literal["counted", "excluded"]) -> bool:
    """Exclude a counted photo from its lens's model, or include it again; False if it is in another state.

    A photo that was excluded before its lens changed its way starts again; False if its file is gone.
    """
    if photo.state != ("counted" if after == "excluded" else "excluded"):
        return False
    assert photo.lens_id is not None
    if after == "excluded":
        taught = teaches(session, photo)
        photo.state, photo.stage_at = after, now()
        session.flush()
        if taught:
            give_back(session, photo, "photo_excluded")
        settle_way(session, photo.lens_id)
        return True
    if photo.way != locked(session, photo.lens_id).way:
        if photo.file_gone_at is not None:
            return False
        restart(session, photo)
        return True
    photo.state, photo.stage_at = after, now()
    session.flush()
    join(session, photo, "photo_included")
    return True


def may_move(photo: PhotoRow, lens: LensRow) -> bool:
    """Whether a photo can be given to a lens: in a lens of another way a counted photo is estimated anew."""
    return photo.state != "counted" or photo.way == lens.way or photo.file_gone_at is None


def move_photo(session: Session, photo: PhotoRow, lens: LensRow) -> None:
    """Give a finished photo that `may_move` to another lens; both get a new version if it counts."""
    before = photo.lens_id
    if before == lens.id:
        return
    if teaches(session, photo):
        give_back(session, photo, "photo_removed")
    photo.lens_id = lens.id
    photo.given = {**photo.given, "lens_id": lens.public_id}
    session.flush()
    if photo.state == "counted":
        if photo.way == lens.way:
            join(session, photo, "photo_included")
        else:
            restart(session, photo)
    if before is not None:
        settle_way(session, before)


def change_settings(
    session: Session, photo: PhotoRow, given: Mapping[str, Any], columns: Mapping[str, Any]
) -> None:
    """Correct the settings of a photo; if it counts its lens's model is fitted anew."""
    photo.given = {**photo.given, **given}
    for column, value in columns.items():
        setattr(photo, column, value)
    session.flush()
    if teaches(session, photo):
        assert photo.lens_id is not None
        version = new_version(session, photo.lens_id, rebuild=True)
        record_event(session, photo.lens_id, version, "photo_changed", photo, samples_added=0)


def begin_again(
    session: Session,
    photo: PhotoRow,
    given: Mapping[str, Any],
    columns: Mapping[str, Any],
    chosen: LensRow | None,
) -> None:
    """Start a photo anew with the settings and the lens that its owner gives."""
    before = photo.lens_id
    leaves = chosen is not None and chosen.id != before
    if photo.relearning and leaves:
        give_back(session, photo, "photo_removed")
    elif photo.relearning and given:
        change_settings(session, photo, given, columns)
    photo.given = {**photo.given, **given}
    if chosen is not None:  # the lens has its way: an earlier request for a model no longer applies
        kept = {name: value for name, value in photo.given.items() if name != "model"}
        photo.given = {**kept, "lens_id": chosen.public_id}
    restart(session, photo)
    if leaves and before is not None:
        settle_way(session, before)
