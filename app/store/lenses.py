"""Lenses: which copy it is, what was learned of it, and its version, which grows when its samples change.

The version grows under the lens's row lock, so that versions and the samples that belong to them become
visible in the same order.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

from sqlalchemy import Select, delete, func, select, update
from sqlalchemy.orm import Session

from app.store.database import Repository, changed, insert_or_find, new_id, reads, writes
from app.store.owners import (
    ANY_OWNER,
    Owner,
    discard,
    ensure_owner,
    find_owned,
    find_to_change,
    is_id,
    now,
    owned,
    page_of,
)
from app.store.samples import COLUMNS, LensState, sample_in
from app.store.tables import (
    CORRECTION_ACTIVE,
    ENDED_BADLY,
    PHOTO_WORKED_ON,
    CorrectionRow,
    EventRow,
    LensRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)
from lensmodel.core.names import name_key, serial_key
from lensmodel.core.psf import PsfSample

TEACHES: Final = PhotoRow.state == "counted"

# How long the previous version is kept (chosen): a worker may still be reporting of it
STILL_WRITTEN: Final = timedelta(minutes=30)
# Whether an event lets the samples of its photo join the model, or takes them out
_JOINS: Final = {
    "photo_added": True,
    "photo_included": True,
    "photo_excluded": False,
    "photo_removed": False,
}


@dataclass(frozen=True, slots=True)
class LensName:
    """Which copy of which lens: identified by its serial, or by a label that its owner gives it."""

    maker: str | None
    model: str | None
    serial: str | None
    serial_source: str = "user"
    label: str | None = None


def identity_key(maker: str | None, model: str | None, serial: str | None) -> str:
    """Return the key by which two photos are known to show the same copy."""
    return f"{name_key(maker)}|{name_key(model)}|{serial_key(serial)}"


class Lenses(Repository):
    """Lenses of all owners and their samples. `ANY_OWNER` asks as the service itself."""

    @reads
    def get(self, session: Session, lens_id: str, owner: Owner) -> LensRow | None:
        """Return one lens, or None."""
        return find_owned(session, LensRow, lens_id, owner)

    @reads
    def page(
        self,
        session: Session,
        owner: str,
        *,
        before: str | None,
        limit: int,
        model: str | None = None,
        serial: str | None = None,
    ) -> list[LensRow]:
        """Return lenses, newest first, optionally of one model or serial, compared without case."""
        wanted = ((LensRow.model, model), (LensRow.serial, serial))
        same = [func.lower(column) == value.lower() for column, value in wanted if value is not None]
        return page_of(session, LensRow, owner, *same, before=before, limit=limit)

    @reads
    def with_photos_beyond(
        self, session: Session, states: Collection[str], lens_ids: Collection[str]
    ) -> set[str]:
        """Return which of these lenses have photos in other states."""
        query = (
            select(LensRow.public_id)
            .join(PhotoRow, PhotoRow.lens_id == LensRow.id)
            .where(LensRow.public_id.in_(lens_ids))
            .where(PhotoRow.state.not_in(states))
        )
        return set(session.scalars(query.distinct()))

    @reads
    def by_identity(self, session: Session, photo: PhotoRow) -> LensRow | None:
        """Return the lens that the serial of an inspected photo identifies, if it exists by now."""
        if photo.lens_serial is None:
            return None
        key = identity_key(photo.lens_maker, photo.lens_model, photo.lens_serial)
        return session.scalar(select(LensRow).where(*_same(photo.owner_id, key)))

    @reads
    def coverage_of(
        self, session: Session, lenses: Sequence[LensRow]
    ) -> dict[int, tuple[list[float], list[float]]]:
        """Return the apertures and focal lengths of the counted photos of lenses, by key."""
        keys = [row.id for row in lenses]
        query = select(PhotoRow.lens_id, PhotoRow.aperture, PhotoRow.focal_mm).where(
            PhotoRow.lens_id.in_(keys), TEACHES
        )
        rows = session.execute(query.distinct()).all()
        return {
            key: (
                sorted({aperture for lens, aperture, _ in rows if lens == key and aperture is not None}),
                sorted({focal for lens, _, focal in rows if lens == key and focal is not None}),
            )
            for key in keys
        }

    @reads
    def lateral_of(self, session: Session, lens: LensRow) -> list[dict[str, Any]]:
        """Return the lateral colour of each counted photo of a lens that shows it."""
        query = select(PhotoRow.lateral).where(PhotoRow.lens_id == lens.id, TEACHES)
        return [lateral for lateral in session.scalars(query) if lateral]

    @reads
    def shape_of(self, session: Session, lens: LensRow) -> tuple[int, int] | None:
        """Return the commonest height and width of the photos of a lens in pixels, in sensor orientation."""
        query = (
            select(PhotoRow.height, PhotoRow.width)
            .where(PhotoRow.lens_id == lens.id, TEACHES)
            .where(PhotoRow.width.is_not(None), PhotoRow.height.is_not(None))
            .group_by(PhotoRow.height, PhotoRow.width)
            .order_by(func.count().desc(), PhotoRow.width.desc())
            .limit(1)
        )
        row = session.execute(query).one_or_none()
        return None if row is None else (row[0] or 0, row[1] or 0)

    @reads
    def history(
        self, session: Session, lens: LensRow, *, after: int = 0, limit: int = 1000
    ) -> list[EventRow]:
        """Return the events of a lens beyond version `after`, oldest first."""
        query = select(EventRow).where(EventRow.lens_id == lens.id, EventRow.version > after)
        return list(session.scalars(query.order_by(EventRow.version).limit(limit)))

    # --- samples ----------------------------------------------------------------------------------

    def state_of(self, lens_id: str, owner: Owner) -> LensState | None:
        """Return the version of a lens by one read; None if the owner has no such lens."""
        # Without a session, which costs time: part of every request that a cached model answers
        if not is_id(lens_id):
            return None
        with self.database.reader.connect() as connection:
            row = connection.execute(_state(lens_id, owner)).one_or_none()
            return None if row is None else LensState(*row)

    def samples_of(
        self, lens_id: str, *, after_version: int = 0, up_to_version: int | None = None
    ) -> tuple[LensState, list[PsfSample]]:
        """Return the state of a lens and its samples that joined after a version."""
        # Both are of one moment. Versions grow under the lens's row lock, so no sample of a version that was
        # seen can turn up later.
        query = (
            select(SampleRow.id, *COLUMNS)
            .join(PhotoRow, PhotoRow.id == SampleRow.photo_id)
            .join(PatchRow, PatchRow.id == SampleRow.patch_id)
            .join(LensRow, LensRow.id == SampleRow.lens_id)
            .where(LensRow.public_id == lens_id, SampleRow.version_added > after_version)
            .order_by(SampleRow.version_added, SampleRow.id)
        )
        if up_to_version is not None:
            query = query.where(SampleRow.version_added <= up_to_version)
        with self.database.reading() as session:
            state = session.execute(_state(lens_id, ANY_OWNER)).one_or_none()
            if state is None:
                return LensState(0, 0), []
            rows = session.execute(query)
            return LensState(*state), [sample_in(row) for row in rows]

    # --- measuring --------------------------------------------------------------------------------

    @writes
    def record_metrics(self, session: Session, lens_id: str, version: int, metrics: dict[str, Any]) -> None:
        """Store the metrics of one version, once: held-out `error` and `coverage`."""
        lens = find_owned(session, LensRow, lens_id, ANY_OWNER)
        if lens is not None:
            of_version = (EventRow.lens_id == lens.id, EventRow.version == version)
            statement = update(EventRow).where(*of_version, EventRow.metrics.is_(None))
            session.execute(statement.values(metrics=metrics))

    def fail(self, lens_id: str, version: int, code: str, detail: str) -> None:
        """Record that a version could not be measured, and why."""
        del detail
        self.record_metrics(lens_id, version, {"error": None, "coverage": None, "problem": code})

    # --- changes ----------------------------------------------------------------------------------

    @writes
    def create(self, session: Session, owner: str, label: str) -> str:
        """Create a lens of that name; return its id."""
        name = LensName(None, None, None, label=label)
        return named(session, ensure_owner(session, owner), name).public_id

    @writes
    def rename(self, session: Session, lens_id: str, owner: str, label: str | None) -> bool:
        """Set or remove the name that an owner gives a lens; False if there is no such lens."""
        lens = find_to_change(session, LensRow, lens_id, owner)
        if lens is not None:
            lens.label = label
        return lens is not None

    @writes
    def merge(self, session: Session, lens_id: str, into: str, owner: str) -> bool:
        """Give all photos of a lens to another one and forget it: they were one copy all along."""
        # False if one of the two does not exist, or photos of the first are still being learned from. Always
        # locked in the same order: two merges at once must not wait for each other
        rows = {key: find_to_change(session, LensRow, key, owner) for key in sorted((lens_id, into))}
        lens, target = rows[lens_id], rows[into]
        if lens is None or target is None or lens.id == target.id:
            return False
        query = select(PhotoRow).where(PhotoRow.lens_id == lens.id)
        photos = list(session.scalars(query.order_by(PhotoRow.id).with_for_update()))
        if any(photo.state in PHOTO_WORKED_ON for photo in photos):
            return False
        for photo in photos:
            move_photo(session, photo, target)
        target.complete(lens.maker, lens.model)
        _forget(session, lens)
        return True

    @writes
    def delete(self, session: Session, lens_id: str, owner: Owner) -> bool:
        """Delete a lens with all that was learned of it; its photos stay and can be corrected with another.

        Work on photos that would teach it is cancelled. False if there is no such lens.
        """
        lens = find_to_change(session, LensRow, lens_id, owner)
        if lens is None:
            return False
        for photo in session.scalars(select(PhotoRow).where(PhotoRow.lens_id == lens.id).with_for_update()):
            _unlearn(session, photo)
        session.execute(
            update(CorrectionRow)
            .where(CorrectionRow.lens_public_id == lens_id, CorrectionRow.state.in_(CORRECTION_ACTIVE))
            .values(state="cancelled", stage_at=now(), finished_at=now())
        )
        _forget(session, lens)
        return True


def _state(lens_id: str, owner: Owner) -> Select[int, int]:
    query = owned(LensRow, owner).where(LensRow.public_id == lens_id)
    return query.with_only_columns(LensRow.version, LensRow.rebuild_epoch)


# --- identity -------------------------------------------------------------------------------------


def lens_of_photo(session: Session, photo: PhotoRow, *, single_copy: bool) -> LensRow | None:
    """Return the lens of an inspected photo; a photo that calibrates creates it where there is none."""
    lens_id = photo.given.get("lens_id")
    if lens_id is not None:
        query = select(LensRow).where(LensRow.public_id == lens_id, LensRow.owner_id == photo.owner_id)
        chosen = session.scalar(query.with_for_update())
        if chosen is not None:
            return chosen
    if photo.lens_serial is None and not (single_copy and photo.lens_model):
        return None
    name = LensName(photo.lens_maker, photo.lens_model, photo.lens_serial, photo.lens_serial_source or "none")
    if photo.calibrate:
        return named(session, photo.owner_id, name)
    key = identity_key(name.maker, name.model, name.serial)
    return session.scalar(select(LensRow).where(*_same(photo.owner_id, key)).with_for_update())


def _same(owner_id: int, key: str) -> tuple[Any, ...]:
    return LensRow.owner_id == owner_id, LensRow.identity_key == key


def named(session: Session, owner_id: int, name: LensName) -> LensRow:
    """Return the lens of a serial, creating it if need be; a label always creates a new lens."""
    key = f"label|{new_id()}" if name.label else identity_key(name.maker, name.model, name.serial)
    fresh = {
        "public_id": new_id(),
        "owner_id": owner_id,
        "identity_key": key,
        "maker": name.maker,
        "model": name.model,
        "serial": name.serial,
        "serial_source": "user" if name.label else name.serial_source if name.serial else "none",
        "label": name.label,
        "created_at": now(),
    }
    # locked: on PostgreSQL its last photo may be deleted at this moment, and the lens with it
    query = select(LensRow).where(*_same(owner_id, key)).with_for_update()
    return insert_or_find(session, LensRow, fresh, query, "lens")[0]


# --- samples and versions -------------------------------------------------------------------------


def note_change(session: Session, photo: PhotoRow, kind: str) -> int:
    """Give the lens of a photo a new version, which `kind` explains; return it."""
    # The lens's row is locked until the transaction ends. Its samples and photos are counted anew, never
    # incremented.
    query = select(LensRow).where(LensRow.id == photo.lens_id).with_for_update()
    lens = session.scalars(query.execution_options(populate_existing=True)).one()
    if lens.version:  # before the first there was nothing to report
        discard(session, _reports_prefix(lens), after=STILL_WRITTEN)
    lens.version += 1
    # where samples went away or changed, models in memory are fitted anew instead of extended
    lens.rebuild_epoch += kind != "photo_added"
    change = 0
    if kind in _JOINS:
        belongs = (lens.id, lens.version) if _JOINS[kind] else (None, None)
        samples = dict(zip(("lens_id", "version_added"), belongs, strict=True))
        change = changed(session, update(SampleRow).where(SampleRow.photo_id == photo.id).values(samples))
    lens.sample_count, lens.photo_count = session.execute(
        select(func.count(), func.count(SampleRow.photo_id.distinct())).where(SampleRow.lens_id == lens.id)
    ).one()
    session.add(
        EventRow(
            lens_id=lens.id,
            version=lens.version,
            kind=kind,
            photo_public_id=photo.public_id,
            epoch=photo.epoch,
            samples_added=change if _JOINS.get(kind) else -change,
            samples=lens.sample_count,
            photos=lens.photo_count,
            created_at=now(),
        )
    )
    return lens.version


def switch(session: Session, photo: PhotoRow, *, excluded: bool) -> bool:
    """Exclude a counted photo from its lens's model, or include it again; False if it is in neither state."""
    after = "excluded" if excluded else "counted"
    if photo.state not in {"counted", "excluded"} or photo.state == after:
        return photo.state == after
    photo.state, photo.stage_at = after, now()
    note_change(session, photo, "photo_excluded" if excluded else "photo_included")
    return True


def move_photo(session: Session, photo: PhotoRow, lens: LensRow) -> None:
    """Give a finished photo to another lens; both get a new version if it counts."""
    if photo.lens_id == lens.id:
        return
    if photo.state == "counted":
        note_change(session, photo, "photo_removed")
    photo.lens_id = lens.id
    photo.given = {**photo.given, "lens_id": lens.public_id}
    if photo.state == "counted":
        note_change(session, photo, "photo_included")


def _reports_prefix(lens: LensRow) -> str:
    return f"models/{lens.public_id}/{lens.version}-{lens.rebuild_epoch}/"


def report_key(lens_id: str, version: int, epoch: int) -> str:
    """Return the key of the report that a worker makes of one version of a lens."""
    return f"models/{lens_id}/{version}-{epoch}/report.json"


# --- deletion -------------------------------------------------------------------------------------


def forget_if_empty(session: Session, photo: PhotoRow, *, gone: bool = False) -> None:
    """Detach a photo that teaches nothing from its lens; delete the lens if no other photo refers to it."""
    # A lens that the owner named stays as long as there is any photo of it, even a failed one
    lens = session.scalar(select(LensRow).where(LensRow.id == photo.lens_id).with_for_update())
    if lens is None:
        return
    others = select(PhotoRow.id).where(PhotoRow.lens_id == lens.id, PhotoRow.id != photo.id)
    named_by_owner = lens.label is not None or lens.serial_source == "user"
    if not named_by_owner:
        others = others.where(PhotoRow.state.not_in(ENDED_BADLY))
    if (gone or not named_by_owner) and session.scalar(others.limit(1)) is None:
        _forget(session, lens)


def _unlearn(session: Session, photo: PhotoRow) -> None:
    if photo.state in PHOTO_WORKED_ON:
        photo.state, photo.finished_at = "cancelled", now()
    elif photo.state in {"counted", "excluded"}:
        photo.state, photo.calibrate = "stored", False
    photo.stage_at = now()
    photo.lens_id = None
    photo.given = {name: value for name, value in photo.given.items() if name != "lens_id"}
    forget_patches(session, photo)


def forget_patches(session: Session, photo: PhotoRow) -> None:
    """Delete the patches and samples of a photo."""
    session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))  # and by the key its samples
    photo.patches_total = photo.patches_done = photo.patches_rejected = 0
    photo.windows, photo.windows_rejected = None, 0


def _forget(session: Session, lens: LensRow) -> None:
    """Delete a lens that no photo counts for any more, with its history; its reports become garbage."""
    discard(session, f"models/{lens.public_id}/", after=STILL_WRITTEN)
    session.delete(lens)
    session.flush()
