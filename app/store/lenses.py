"""Lenses: which copy it is, what was learned of it, and when."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import and_, delete, func, or_, select, update
from sqlalchemy.orm import Session

from app.errors import BusyError
from app.store.access.owners import ANY_OWNER, LATE, Owner, find_owned, now, owned
from app.store.database import Database, insert_new
from app.store.ids import new_id
from app.store.kinds import identity_key
from app.store.tables import PHOTO_RUNNING, CorrectionRow, EventRow, GarbageRow, LensRow, PhotoRow

TEACHES: Final = and_(
    or_(PhotoRow.state == "counted", PhotoRow.relearning.is_(True)), PhotoRow.deleted_at.is_(None)
)
"""Photos that count, including those that are being estimated anew."""

TRIES: Final = 10
"""How often to look again for a lens that was deleted between insert and select (chosen): each
time its last photo must have been deleted in between."""


@dataclass(frozen=True, slots=True)
class LensName:
    """Which copy of which lens: identified by its serial, or by a label that its owner gives it."""

    maker: str | None
    model: str | None
    serial: str | None
    serial_source: str = "user"
    label: str | None = None


def lens_of_photo(session: Session, photo: PhotoRow, *, single_copy: bool) -> LensRow | None:
    """Return the lens of an inspected photo; a photo that calibrates creates it where there is none."""
    lens_id = photo.given.get("lens_id")
    if lens_id is not None:
        chosen = session.scalar(
            select(LensRow).where(
                LensRow.public_id == lens_id, LensRow.owner_id == photo.owner_id, LensRow.deleted_at.is_(None)
            )
        )
        if chosen is not None:
            return chosen
    if photo.lens_serial is None and not (single_copy and photo.lens_model):
        return None
    key = identity_key(photo.lens_maker, photo.lens_model, photo.lens_serial)
    fresh = _new_lens(
        photo.owner_id,
        key,
        maker=photo.lens_maker,
        model=photo.lens_model,
        serial=photo.lens_serial,
        source=photo.lens_serial_source or "none",
        way=photo.given.get("model"),
    )
    for _ in range(TRIES):
        if photo.calibrate:
            insert_new(session, LensRow, [fresh])
        # locked: on PostgreSQL its last photo may be deleted at this moment, and the lens with it
        lens = session.scalar(
            select(LensRow)
            .where(
                LensRow.owner_id == photo.owner_id, LensRow.identity_key == key, LensRow.deleted_at.is_(None)
            )
            .with_for_update()
        )
        if lens is not None or not photo.calibrate:
            return lens
    return None


def _new_lens(
    owner_id: int,
    key: str,
    *,
    maker: str | None,
    model: str | None,
    serial: str | None,
    source: str,
    way: str | None,
) -> dict[str, Any]:
    return {
        "public_id": new_id(),
        "owner_id": owner_id,
        "identity_key": key,
        "maker": maker,
        "model": model,
        "serial": serial,
        "serial_source": source if serial else "none",
        "way": way or "default",
        "answering_way": way or "default",
        "created_at": now(),
        "version": 0,
        "rebuild_epoch": 0,
        "photo_count": 0,
        "sample_count": 0,
    }


def named(session: Session, owner_id: int, name: LensName, *, way: str | None = None) -> LensRow:
    """Return the lens of a serial, creating it if need be; a label always creates a new lens.

    `way` is how a new lens is learned.
    """
    key = f"label|{new_id()}" if name.label else identity_key(name.maker, name.model, name.serial)
    fresh = _new_lens(
        owner_id,
        key,
        maker=name.maker,
        model=name.model,
        serial=name.serial,
        source=name.serial_source,
        way=way,
    )
    if name.label:
        fresh |= {"label": name.label, "serial_source": "user"}
    same = select(LensRow).where(
        LensRow.owner_id == owner_id, LensRow.identity_key == key, LensRow.deleted_at.is_(None)
    )
    for _ in range(TRIES):
        insert_new(session, LensRow, [fresh])
        lens = session.scalar(same.with_for_update())
        if lens is not None:
            return lens
    raise BusyError(f"{TRIES} times the lens was forgotten just then: name it again")


def delete_corrections(session: Session, photo: PhotoRow) -> None:
    """Remove a photo's corrections; their blobs become garbage."""
    keys = session.scalars(select(CorrectionRow.public_id).where(CorrectionRow.photo_id == photo.id))
    rows = [{"prefix": f"corrections/{key}/", "not_before": now() + LATE} for key in keys]
    insert_new(session, GarbageRow, rows)
    session.execute(delete(CorrectionRow).where(CorrectionRow.photo_id == photo.id))


class LensStore:
    """Lenses of all owners. `ANY_OWNER` asks as the service itself."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def get(self, lens_id: str, owner: Owner) -> LensRow | None:
        """Return one lens, or None."""
        with self._db.reading() as session:
            return find_owned(session, LensRow, lens_id, owner)

    def page(
        self,
        owner: str,
        *,
        before: str | None,
        limit: int,
        model: str | None = None,
        serial: str | None = None,
    ) -> list[LensRow]:
        """Return lenses, newest first, optionally of one model or serial, compared without case."""
        query = owned(LensRow, owner).order_by(LensRow.public_id.desc()).limit(limit)
        if before is not None:
            query = query.where(LensRow.public_id < before)
        if model is not None:
            query = query.where(func.lower(LensRow.model) == model.lower())
        if serial is not None:
            query = query.where(func.lower(LensRow.serial) == serial.lower())
        with self._db.reading() as session:
            return list(session.scalars(query))

    def with_photos_beyond(self, states: Collection[str], lens_ids: Collection[str]) -> set[str]:
        """Return which of these lenses have photos in other states."""
        query = (
            select(LensRow.public_id)
            .join(PhotoRow, PhotoRow.lens_id == LensRow.id)
            .where(LensRow.public_id.in_(lens_ids), PhotoRow.deleted_at.is_(None))
            .where(PhotoRow.state.not_in(states))
            .distinct()
        )
        with self._db.reading() as session:
            return set(session.scalars(query))

    def candidates(self, photo: PhotoRow, limit: int = 10) -> list[LensRow]:
        """Return the owner's lenses that a photo without a serial may belong to."""
        query = select(LensRow).where(LensRow.owner_id == photo.owner_id, LensRow.deleted_at.is_(None))
        if photo.lens_model:
            query = query.where(func.lower(LensRow.model) == photo.lens_model.lower())
        with self._db.reading() as session:
            return list(session.scalars(query.order_by(LensRow.public_id.desc()).limit(limit)))

    def by_identity(self, photo: PhotoRow) -> LensRow | None:
        """Return the lens that the serial of an inspected photo identifies, if it exists by now."""
        if photo.lens_serial is None:
            return None
        key = identity_key(photo.lens_maker, photo.lens_model, photo.lens_serial)
        with self._db.reading() as session:
            return session.scalar(
                select(LensRow).where(
                    LensRow.owner_id == photo.owner_id,
                    LensRow.identity_key == key,
                    LensRow.deleted_at.is_(None),
                )
            )

    def coverage_of(self, lenses: Sequence[LensRow]) -> dict[int, tuple[list[float], list[float]]]:
        """Return the apertures and focal lengths of the counted photos of lenses, by key."""
        keys = [row.id for row in lenses]
        query = (
            select(PhotoRow.lens_id, PhotoRow.aperture, PhotoRow.focal_mm)
            .where(PhotoRow.lens_id.in_(keys), TEACHES)
            .distinct()
        )
        apertures: dict[int, set[float]] = {key: set() for key in keys}
        focals: dict[int, set[float]] = {key: set() for key in keys}
        with self._db.reading() as session:
            for key, aperture, focal in session.execute(query):
                assert key is not None
                apertures[key] |= set() if aperture is None else {aperture}
                focals[key] |= set() if focal is None else {focal}
        return {key: (sorted(apertures[key]), sorted(focals[key])) for key in keys}

    def learned_anew(self, lens: LensRow) -> int:
        """Return how many photos of a lens that changes its way are still being estimated anew."""
        anew = (PhotoRow.relearning.is_(True), PhotoRow.state.in_(("received", *PHOTO_RUNNING)))
        query = select(func.count()).where(PhotoRow.lens_id == lens.id, *anew, PhotoRow.deleted_at.is_(None))
        with self._db.reading() as session:
            return session.scalar(query) or 0

    def lateral_of(self, lens: LensRow) -> list[dict[str, Any]]:
        """Return the lateral colour of each counted photo of a lens that shows it."""
        query = select(PhotoRow.lateral).where(PhotoRow.lens_id == lens.id, TEACHES)
        with self._db.reading() as session:
            return [lateral for lateral in session.scalars(query) if lateral]

    def shape_of(self, lens: LensRow) -> tuple[int, int] | None:
        """Return the commonest height and width of the photos of a lens in pixels, in sensor orientation."""
        count = func.count()
        query = (
            select(PhotoRow.height, PhotoRow.width)
            .where(
                PhotoRow.lens_id == lens.id,
                TEACHES,
                PhotoRow.width.is_not(None),
                PhotoRow.height.is_not(None),
            )
            .group_by(PhotoRow.height, PhotoRow.width)
            .order_by(count.desc(), PhotoRow.width.desc())
            .limit(1)
        )
        with self._db.reading() as session:
            row = session.execute(query).one_or_none()
            return None if row is None else (row[0] or 0, row[1] or 0)

    def history(self, lens: LensRow, *, after: int = 0, limit: int = 1000) -> list[EventRow]:
        """Return the events of a lens beyond version `after`, oldest first."""
        query = (
            select(EventRow)
            .where(EventRow.lens_id == lens.id, EventRow.version > after)
            .order_by(EventRow.version)
            .limit(limit)
        )
        with self._db.reading() as session:
            return list(session.scalars(query))

    def record_metrics(self, lens_id: str, version: int, metrics: dict[str, Any]) -> None:
        """Store the metrics of one version, once: held-out `error`, `coverage`, `bandwidth`."""
        with self._db.writing() as session:
            lens = find_owned(session, LensRow, lens_id, ANY_OWNER)
            if lens is not None:
                session.execute(
                    update(EventRow)
                    .where(
                        EventRow.lens_id == lens.id, EventRow.version == version, EventRow.metrics.is_(None)
                    )
                    .values(metrics=metrics)
                )

    def measured(self) -> list[tuple[str, int, int]]:
        """Return `(lens_id, version, rebuild_epoch)` of the newest versions that were measured."""
        query = (
            select(LensRow.public_id, LensRow.version, LensRow.rebuild_epoch)
            .join(EventRow, (EventRow.lens_id == LensRow.id) & (EventRow.version == LensRow.version))
            .where(EventRow.metrics.is_not(None), LensRow.deleted_at.is_(None), LensRow.sample_count > 0)
        )
        with self._db.reading() as session:
            return [(row[0], row[1], row[2]) for row in session.execute(query)]

    def unmeasured(self, limit: int = 10) -> list[tuple[str, int]]:
        """Return `(lens_id, version)` of the newest versions that were not measured yet."""
        query = (
            select(LensRow.public_id, LensRow.version)
            .join(EventRow, (EventRow.lens_id == LensRow.id) & (EventRow.version == LensRow.version))
            .where(EventRow.metrics.is_(None), LensRow.deleted_at.is_(None), LensRow.sample_count > 0)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [(row[0], row[1]) for row in session.execute(query)]
