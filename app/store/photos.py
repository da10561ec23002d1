"""Photos: received once, moved from state to state, counted exactly once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final, Protocol

from sqlalchemy import case, delete, func, select, update
from sqlalchemy.orm import Session

from app.errors import BusyError
from app.store import lenses
from app.store.database import Database, insert_new
from app.store.lenses import LensName
from app.store.owners import ensure_owner, find, find_to_change, now, owned
from app.store.removal import forget_if_empty
from app.store.versions import new_version, take_samples
from app.tables import (
    PHOTO_FINAL,
    PHOTO_RUNNING,
    GarbageRow,
    LensRow,
    OwnerRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)

WORKED_ON = ("received", *PHOTO_RUNNING)
"""What takes the service's time; a photo that waits for its owner's word takes room only."""

UNFINISHED = (*WORKED_ON, "needs_lens")
TRIES: Final = 100
"""How often an upload looks again for the photo of the same bytes that was deleted when it looked."""

GIVEN_SETTINGS = {
    "aperture": "aperture",
    "focal_length_mm": "focal_mm",
    "focus_distance_m": "focus_m",
    "pixel_pitch_um": "pixel_pitch_um",
}
"""Fields that the owner may give, by the column that they fill."""


class Identity(Protocol):
    """Which copy of which lens, as `lensmodel.photo.LensIdentity` says it."""

    @property
    def maker(self) -> str | None:
        """Who made it."""

    @property
    def model(self) -> str | None:
        """What it is called."""

    @property
    def serial(self) -> str | None:
        """Which copy it is; None where nothing says so."""

    @property
    def serial_source(self) -> str:
        """Where the serial was found."""


LATE = timedelta(minutes=10)
"""Blobs of what is deleted are deleted again after this time: a worker may have written one more."""


@dataclass(frozen=True, slots=True)
class Received:
    """What an upload became: the photo, and whether there is work to do for it."""

    photo: PhotoRow
    fresh: bool


class PhotoStore:
    """Photos of all owners. `owner=None` asks as the service itself."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def expect(self, prefix: str) -> None:
        """Say that blobs will come below `prefix`: garbage in an hour unless a photo claims them."""
        with self._db.writing() as session:
            due = now() + timedelta(hours=1)
            insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": due}])

    def receive(
        self,
        owner: str,
        *,
        public_id: str,
        sha256: str,
        filename: str,
        kind: str,
        byte_size: int,
        blob_key: str,
        calibrate: bool,
        given: Mapping[str, Any],
    ) -> Received:
        """Store an upload, or find the photo with the same bytes.

        A known photo starts again where that makes sense: it had failed or was cancelled, it shall
        calibrate its lens and until now should not, or it waits to be told what it is told now.
        """
        with self._db.writing(durable=True) as session:
            owner_key = ensure_owner(session, owner)
            fresh = {
                "public_id": public_id,
                "owner_id": owner_key,
                "sha256": sha256,
                "filename": filename,
                "kind": kind,
                "byte_size": byte_size,
                "blob_key": blob_key,
                "calibrate": calibrate,
                "given": dict(given),
                "state": "received",
                "received_at": now(),
                "stage_at": now(),
                **{column: given.get(field) for field, column in GIVEN_SETTINGS.items()},
            }
            known, made = _insert_or_find(session, fresh)
            if made:
                prefix = f"{blob_key.rpartition('/')[0]}/"
                session.execute(delete(GarbageRow).where(GarbageRow.prefix == prefix))
                return Received(known, fresh=True)
            told = {**known.given, **given}
            again = (
                known.state in {"failed", "cancelled"}
                or (calibrate and not known.calibrate)
                or (known.state == "needs_lens" and told != known.given)
            )
            if again:
                known.calibrate = calibrate
                known.given = told
                _restart(session, known)
            return Received(known, fresh=again)

    def get(self, photo_id: str, owner: str | None = None) -> PhotoRow | None:
        """Return one photo, or None."""
        with self._db.reading() as session:
            return find(session, PhotoRow, photo_id, owner)

    def lens_of(self, photo: PhotoRow) -> LensRow | None:
        """Return the lens that a photo was taken with, where that is known."""
        if photo.lens_id is None:
            return None
        with self._db.reading() as session:
            return session.get(LensRow, photo.lens_id)

    def page(
        self,
        owner: str,
        *,
        before: str | None,
        limit: int,
        lens_id: str | None = None,
        state: str | None = None,
    ) -> list[PhotoRow]:
        """Return photos, newest first, that came before the photo `before`."""
        query = owned(PhotoRow, owner).order_by(PhotoRow.public_id.desc()).limit(limit)
        if before is not None:
            query = query.where(PhotoRow.public_id < before)
        if lens_id is not None:
            query = query.join(LensRow, LensRow.id == PhotoRow.lens_id).where(LensRow.public_id == lens_id)
        if state is not None:
            query = query.where(PhotoRow.state == state)
        with self._db.reading() as session:
            return list(session.scalars(query))

    def lens_ids(self, photos: Sequence[PhotoRow]) -> dict[int, str]:
        """Return the public ids of the lenses of these photos, by key."""
        keys = {photo.lens_id for photo in photos if photo.lens_id is not None}
        with self._db.reading() as session:
            rows = session.execute(select(LensRow.id, LensRow.public_id).where(LensRow.id.in_(keys)))
            return {row.id: row.public_id for row in rows}

    def load_of(self, owner: str) -> tuple[int, int]:
        """Return how many photos of an owner are to be worked on, and the bytes of all of them."""
        with self._db.reading() as session:
            row = session.execute(
                select(
                    func.count().filter(PhotoRow.state.in_(WORKED_ON)),
                    func.coalesce(func.sum(PhotoRow.byte_size), 0),
                )
                .join(OwnerRow, OwnerRow.id == PhotoRow.owner_id)
                .where(OwnerRow.name == owner, PhotoRow.deleted_at.is_(None))
            ).one()
            return int(row[0]), int(row[1])

    def to_do(self, limit: int = 100) -> list[tuple[str, int, str]]:
        """Return `(photo_id, epoch, owner)` of received photos, oldest first: the intent sweep."""
        return self._in_states(("received",), limit)

    def running(self, limit: int = 1000) -> list[tuple[str, int, str]]:
        """Return `(photo_id, epoch, owner)` of photos that a worker is busy with."""
        return self._in_states(PHOTO_RUNNING, limit)

    def _in_states(self, states: Sequence[str], limit: int) -> list[tuple[str, int, str]]:
        query = (
            select(PhotoRow.public_id, PhotoRow.epoch, OwnerRow.name)
            .join(OwnerRow, OwnerRow.id == PhotoRow.owner_id)
            .where(PhotoRow.state.in_(states), PhotoRow.deleted_at.is_(None))
            .order_by(PhotoRow.id)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [(row[0], row[1], row[2]) for row in session.execute(query)]

    def set_state(
        self,
        photo_id: str,
        from_states: Sequence[str],
        to: str,
        *,
        epoch: int | None = None,
        **fields: object,
    ) -> bool:
        """Move a photo from one of `from_states` to `to`; False where it was in none of them.

        With `epoch` only if the photo was not started anew since: a worker that was away too
        long changes nothing.
        """
        with self._db.writing() as session:
            return _move(session, photo_id, from_states, to, epoch=epoch, **fields)

    def is_live(self, photo_id: str, epoch: int) -> bool:
        """Say whether work for this epoch of the photo is still wanted: the cancel poll."""
        with self._db.reading() as session:
            return (
                session.scalar(
                    select(PhotoRow.id).where(
                        PhotoRow.public_id == photo_id,
                        PhotoRow.epoch == epoch,
                        PhotoRow.state.not_in(PHOTO_FINAL),
                        PhotoRow.deleted_at.is_(None),
                    )
                )
                is not None
            )

    def record_inspection(
        self,
        photo_id: str,
        *,
        width: int,
        height: int,
        identity: Identity,
        aperture: float | None,
        focal_mm: float | None,
        focus_m: float | None,
        pixel_pitch_um: float | None,
        orientation: int | None = None,
        camera_maker: str | None = None,
        camera_model: str | None = None,
        iso: float | None = None,
        exposure_s: float | None = None,
        taken_at: datetime | None = None,
    ) -> None:
        """Store what the header says; what the owner gave stays as he gave it."""
        read = {
            "aperture": aperture,
            "focal_mm": focal_mm,
            "focus_m": focus_m,
            "pixel_pitch_um": pixel_pitch_um,
        }
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, None)
            if photo is None:
                return
            for field, column in GIVEN_SETTINGS.items():
                value = photo.given.get(field)
                setattr(photo, column, read[column] if value is None else value)
            serial = photo.given.get("lens_serial")
            photo.width, photo.height, photo.orientation = width, height, orientation
            photo.camera_maker, photo.camera_model = camera_maker, camera_model
            photo.lens_maker = photo.given.get("lens_maker") or identity.maker
            photo.lens_model = photo.given.get("lens_model") or identity.model
            photo.lens_serial = serial or identity.serial
            photo.lens_serial_source = "user" if serial else identity.serial_source
            photo.iso, photo.exposure_s, photo.taken_at = iso, exposure_s, taken_at

    def record_lateral(self, photo_id: str, lateral: dict[str, Any]) -> None:
        """Store the lateral colour that a photo shows."""
        with self._db.writing() as session:
            session.execute(update(PhotoRow).where(PhotoRow.public_id == photo_id).values(lateral=lateral))

    def assign_lens(self, photo_id: str, *, single_copy: bool = False) -> LensRow | None:
        """Find or make the lens of an inspected photo; None if nothing says which copy it was.

        Order: the lens that the owner named, then the serial (his or the file's), then, only
        with `single_copy`, the model alone. Photos that are merely stored join a lens that
        exists but make none.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, None)
            if photo is None:
                return None
            lens = lenses.lens_of_photo(session, photo, single_copy=single_copy)
            if lens is not None:
                photo.lens_id = lens.id
                _widen(lens, photo)
            return lens

    def change(
        self,
        photo_id: str,
        owner: str,
        given: Mapping[str, Any],
        *,
        lens: LensName | str | None = None,
        excluded: bool | None = None,
    ) -> bool:
        """Take over what the owner says now: settings, the lens or its id, whether the photo counts.

        All of it, or nothing and False where the photo cannot be excluded or included. A photo that has
        a result changes its lens's model at once, any other starts again.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None:
                return False
            if excluded is not None:
                wish: Final = "excluded" if excluded else "counted"
                if photo.state != wish and not lenses.switch(session, photo, wish):
                    return False
            chosen = None
            if isinstance(lens, LensName):
                chosen = lenses.named(session, photo.owner_id, lens)
            elif lens is not None:
                chosen = find(session, LensRow, lens, owner)
            if photo.state in {"counted", "stored", "excluded"}:
                if given:
                    columns = {GIVEN_SETTINGS[name]: value for name, value in given.items()}
                    lenses.change_settings(session, photo, given, columns)
                if chosen is not None:
                    lenses.move(session, photo, chosen)
            elif given or chosen is not None:
                named = {} if chosen is None else {"lens_id": chosen.public_id}
                photo.given = {**photo.given, **given, **named}
                _restart(session, photo)
            return True

    def fail(self, photo_id: str, epoch: int, code: str, detail: str) -> bool:
        """End a photo that is being worked on with a reason; its samples never count."""
        with self._db.writing() as session:
            fields = {"error_code": code, "error_detail": detail, "finished_at": now()}
            failed = _move(session, photo_id, ("received", *PHOTO_RUNNING), "failed", epoch=epoch, **fields)
            if failed:
                _let_go(session, photo_id)
            return failed

    def retry(self, photo_id: str, owner: str | None = None) -> bool:
        """Start a failed or cancelled photo anew; False if it is in another state."""
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None or photo.state not in {"failed", "cancelled"}:
                return False
            _restart(session, photo)
            return True

    def failed_by(self, owner: str, code: str, limit: int) -> list[str]:
        """Return the photos that ended with a code, oldest first."""
        query = (
            owned(PhotoRow, owner)
            .where(PhotoRow.state == "failed", PhotoRow.error_code == code)
            .order_by(PhotoRow.id)
            .limit(limit)
        )
        with self._db.reading() as session:
            return [row.public_id for row in session.scalars(query)]

    def cancel(self, photo_id: str, owner: str | None = None) -> bool:
        """Cancel an unfinished photo; False if it was finished already.

        The state is the truth: whatever still runs finds the photo cancelled and changes nothing.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None or not _move(session, photo_id, UNFINISHED, "cancelled", finished_at=now()):
                return False
            _drop_patches(session, photo)
            _let_go(session, photo_id)
            return True

    def finish(self, photo_id: str, epoch: int) -> int | None:
        """Count a photo: its samples join the model and the lens's version grows by one.

        Returns the new version, or None if the photo was counted, cancelled or started anew
        meanwhile. One transaction: it happens wholly and once, however often it is tried.
        """
        with self._db.writing() as session:
            done = {"finished_at": now(), "counted_at": now()}
            if not _move(session, photo_id, ("estimating",), "counted", epoch=epoch, **done):
                return None
            photo = session.scalars(select(PhotoRow).where(PhotoRow.public_id == photo_id)).one()
            if photo.lens_id is None:
                raise ValueError(f"photo {photo_id} has no lens: assign one before it is counted")
            version = new_version(session, photo.lens_id)
            added = take_samples(session, photo, version)
            lenses.record_event(session, photo.lens_id, version, "photo_added", photo, samples_added=added)
            return version

    def delete(self, photo_id: str, owner: str) -> str | None:
        """Forget a photo, its patches and samples; return the prefix of its blobs.

        The row stays, emptied, so that the lens's history can name it.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None:
                return None
            if photo.state == "counted":
                lenses.give_back(session, photo, "photo_removed")
            session.execute(delete(SampleRow).where(SampleRow.photo_id == photo.id))
            session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
            lenses.delete_corrections(session, photo)
            photo.deleted_at = now()
            photo.state = "cancelled" if photo.state in UNFINISHED else photo.state
            photo.given, photo.lens_serial, photo.filename, photo.sha256 = {}, None, "", ""
            photo.windows, photo.windows_rejected = None, 0
            forget_if_empty(session, photo)
            prefix = folder_of(photo)
            insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": now() + LATE}])
            return prefix


def folder_of(photo: PhotoRow) -> str:
    """Return the prefix of a photo's blobs."""
    return f"{photo.blob_key.rpartition('/')[0]}/"


def statistics_of(photo: PhotoRow) -> str:
    """Return the prefix of what the patches of this epoch of a photo say besides their kernels."""
    return f"{folder_of(photo)}statistics/e{photo.epoch}/"


def settings_of(photo: PhotoRow) -> dict[str, Any]:
    """Return how the lens was set, as tasks read it."""
    return {"aperture": photo.aperture, "focal_mm": photo.focal_mm, "focus_m": photo.focus_m}


def _let_go(session: Session, photo_id: str) -> None:
    """Forget the lens that only a photo without a result speaks of: its serial is nobody's business now."""
    photo = session.scalars(
        select(PhotoRow).where(PhotoRow.public_id == photo_id).execution_options(populate_existing=True)
    ).one()
    forget_if_empty(session, photo)


def _insert_or_find(session: Session, fresh: dict[str, Any]) -> tuple[PhotoRow, bool]:
    """Insert a photo, or find the one with the same bytes; True if inserted.

    On PostgreSQL another transaction may delete that one after it kept ours out, and before we see it.
    """
    for _ in range(TRIES):
        made = insert_new(session, PhotoRow, [fresh]) == 1
        known = _known(session, fresh["owner_id"], fresh["sha256"])
        if known is not None:
            return known, made
    raise BusyError(f"{TRIES} times the photo of the same bytes came and went: send it again")


def _known(session: Session, owner_key: int, sha256: str) -> PhotoRow | None:
    return session.scalar(
        select(PhotoRow)
        .where(PhotoRow.owner_id == owner_key, PhotoRow.sha256 == sha256, PhotoRow.deleted_at.is_(None))
        .with_for_update()
    )


def _drop_patches(session: Session, photo: PhotoRow) -> None:
    """Forget the patches of an epoch with their samples; a worker may write one more blob of them."""
    session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
    insert_new(session, GarbageRow, [{"prefix": statistics_of(photo), "not_before": now() + LATE}])


def _restart(session: Session, photo: PhotoRow) -> None:
    """Begin a new epoch of a photo that does not count: work of the old one, if any still runs, is void."""
    _drop_patches(session, photo)
    photo.epoch += 1
    photo.state, photo.stage_at = "received", now()
    photo.error_code = photo.error_detail = photo.started_at = photo.finished_at = photo.counted_at = None
    photo.attempt = photo.patches_total = photo.patches_done = photo.patches_rejected = 0
    photo.windows, photo.windows_rejected = None, 0


def _move(
    session: Session,
    photo_id: str,
    from_states: Sequence[str],
    to: str,
    *,
    epoch: int | None = None,
    **fields: object,
) -> bool:
    conditions = [
        PhotoRow.public_id == photo_id,
        PhotoRow.state.in_(from_states),
        PhotoRow.deleted_at.is_(None),
    ]
    if epoch is not None:
        conditions.append(PhotoRow.epoch == epoch)
    since = case((PhotoRow.state == to, PhotoRow.stage_at), else_=now())
    changes = {"state": to, "stage_at": since, **fields}
    statement = update(PhotoRow).where(*conditions).values(**changes)
    return session.connection().execute(statement).rowcount == 1


def _widen(lens: LensRow, photo: PhotoRow) -> None:
    lens.maker = lens.maker or photo.lens_maker
    lens.model = lens.model or photo.lens_model
