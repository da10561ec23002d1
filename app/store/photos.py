"""Photos: received once, moved from state to state, counted exactly once."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final, Literal

from sqlalchemy import case, delete, func, select, update
from sqlalchemy.orm import Session

from app.errors import BusyError, ConflictError, UnknownPhotoError
from app.store import lenses
from app.store.database import Database, insert_new
from app.store.lenses import LensName, delete_corrections, forget_if_empty, give_back, join, may_move
from app.store.owners import ANY_OWNER, LATE, Owner, ensure_owner, find_owned, find_to_change, now, owned
from app.store.tables import (
    PHOTO_FINAL,
    PHOTO_RUNNING,
    PROFILE_FILE,
    CorrectionRow,
    GarbageRow,
    LensRow,
    OwnerRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)

WORKED_ON: Final = ("received", *PHOTO_RUNNING)
"""States that cost computing time; a photo that waits for its owner costs space only."""

UNFINISHED: Final = (*WORKED_ON, "needs_lens")
GIVEN_SETTINGS: Final = {
    "aperture": "aperture",
    "focal_length_mm": "focal_mm",
    "focus_distance_m": "focus_m",
    "pixel_pitch_um": "pixel_pitch_um",
}
"""Fields that the owner may give, with the column that each fills."""

FALLBACKS: Final = "fallbacks"
"""Key in `PhotoRow.given` of the settings that came with the file: the header's own go before them. Settings
under their own names are corrections made since and go before the header."""

DESCRIPTION: Final = (
    *("lens_maker", "lens_model", "lens_serial", "lens_serial_source", "camera_maker", "camera_model"),
    *("aperture", "focal_mm", "focus_m", "pixel_pitch_um", "iso", "exposure_s", "taken_at", "lateral"),
    *("width", "height", "orientation", "location", "error_detail", "body_key"),
)
"""Columns that describe a photo; all are emptied when it is deleted."""


TRIES: Final = 100
"""How often an upload looks again for the photo of the same bytes that was deleted between insert and select
(chosen: 80 simultaneous uploads and deletions of the same bytes on PostgreSQL all end)."""

SPARE: Final = timedelta(hours=1)
"""Time between the end of the longest upload and the deletion of one that was broken off (chosen): clocks of
several machines differ by less."""


FILE_KEPT: Final = timedelta(days=1)
"""How long the file of a photo is kept for a first correction, or for a retry after an outage (chosen):
its owner looks again within a day."""

GRACE: Final = timedelta(hours=1)
"""With `keep_photos=corrections`: how long a photo that has just calibrated its lens can still be corrected
(chosen): who sent photos to correct them asks for it in the same sitting."""


@dataclass(frozen=True, slots=True)
class NewCopy:
    """A new copy of the lens that photos say they were taken with, by the name that its owner gives it."""

    label: str


@dataclass(frozen=True, slots=True)
class Received:
    """Result of an upload: the photo, and whether there is work to do for it."""

    photo: PhotoRow
    fresh: bool
    wants_file: bool = False
    """Whether the photo is known without its file, which has now come again."""


class PhotoStore:
    """Photos of all owners. `ANY_OWNER` asks as the service itself."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def get(self, photo_id: str, owner: Owner) -> PhotoRow | None:
        """Return one photo, or None."""
        with self._db.reading() as session:
            return find_owned(session, PhotoRow, photo_id, owner)

    def newest_file(self) -> str | None:
        """Return the key of the file of the newest photo, or None where there is no file."""
        kept = (PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None))
        with self._db.reading() as session:
            return session.scalar(
                select(PhotoRow.blob_key).where(*kept).order_by(PhotoRow.id.desc()).limit(1)
            )

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
        query = owned(PhotoRow, owner).where(PhotoRow.kind != PROFILE_FILE)
        query = query.order_by(PhotoRow.public_id.desc()).limit(limit)
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

    def load_of(self, owner: str) -> tuple[int, int, int]:
        """Return `(unfinished photos, bytes of stored files and results, all photos)` of an owner."""
        results = (
            select(func.coalesce(func.sum(CorrectionRow.result_bytes), 0))
            .join(OwnerRow, OwnerRow.id == CorrectionRow.owner_id)
            .where(OwnerRow.name == owner, CorrectionRow.state == "succeeded")
        )
        with self._db.reading() as session:
            made = session.scalar(results) or 0
            row = session.execute(
                select(
                    func.count().filter(PhotoRow.state.in_(WORKED_ON)),
                    func.coalesce(func.sum(PhotoRow.byte_size).filter(PhotoRow.file_gone_at.is_(None)), 0),
                    func.count(),
                )
                .join(OwnerRow, OwnerRow.id == PhotoRow.owner_id)
                .where(OwnerRow.name == owner, PhotoRow.deleted_at.is_(None))
            ).one()
            return int(row[0]), int(row[1]) + int(made), int(row[2])

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

    def unneeded(self, policy: str, limit: int = 100) -> list[str]:
        """Return photos whose file is to be given up, as the setting `keep_photos` says.

        Never one that is being worked on, waits for its lens, or failed in an outage and may be retried.
        """
        if policy == "always":
            return []
        jobs = select(CorrectionRow.id).where(CorrectionRow.photo_id == PhotoRow.id)
        busy = jobs.where(CorrectionRow.state.in_(("queued", "running"))).exists()
        ended, day = PhotoRow.finished_at, now() - FILE_KEPT
        learned = PhotoRow.state.in_(("counted", "excluded", "cancelled")) | (
            (PhotoRow.state == "failed") & ((PhotoRow.error_code != "outage") | (ended < day))
        )
        if policy == "never":
            disposable = learned | ((PhotoRow.state == "stored") & (jobs.exists() | (ended < day)))
        else:
            disposable = learned & ~jobs.exists() & (ended < now() - GRACE)
        query = (
            select(PhotoRow.public_id)
            .where(PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None), disposable, ~busy)
            .limit(limit)
        )
        with self._db.reading() as session:
            return list(session.scalars(query))

    def read_profiles(self, limit: int = 100) -> list[str]:
        """Return the files of samples that were read, or refused, a day ago."""
        query = select(PhotoRow.public_id).where(
            PhotoRow.kind == PROFILE_FILE,
            PhotoRow.deleted_at.is_(None),
            PhotoRow.finished_at < now() - FILE_KEPT,
        )
        with self._db.reading() as session:
            return list(session.scalars(query.limit(limit)))

    def unsearched(self, limit: int = 100) -> list[PhotoRow]:
        """Return photos nobody works on whose file may still say where they were taken.

        Such are those that failed before they were searched, and files that came again.
        """
        query = (
            select(PhotoRow)
            .where(
                *(
                    PhotoRow.deleted_at.is_(None),
                    PhotoRow.file_gone_at.is_(None),
                    PhotoRow.location.is_(None),
                    PhotoRow.kind != PROFILE_FILE,
                ),
                PhotoRow.state.not_in(WORKED_ON),
            )
            .limit(limit)
        )
        with self._db.reading() as session:
            return list(session.scalars(query))

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

    def existing(self, photo_ids: Iterable[str]) -> set[str]:
        """Return which of these photos are not deleted and still have their file."""
        query = select(PhotoRow.public_id).where(
            PhotoRow.public_id.in_(list(photo_ids)),
            PhotoRow.deleted_at.is_(None),
            PhotoRow.file_gone_at.is_(None),
        )
        with self._db.reading() as session:
            return set(session.scalars(query))

    def expect(self, prefix: str, *, within: timedelta) -> None:
        """Announce blobs below `prefix`: garbage an hour after that time unless a photo claims them."""
        with self._db.writing() as session:
            due = now() + within + SPARE
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
        may_be_new: bool = True,
    ) -> Received:
        """Store an upload that was announced by `expect`, or find the photo with the same bytes.

        A known photo starts again where that makes sense: it had failed or was cancelled, it is now to
        calibrate its lens and was not before, or it waited for settings that are now given.
        """
        with self._db.writing(durable=True) as session:
            owner_key = ensure_owner(session, owner, may_be_new=may_be_new)
            fresh = {
                "public_id": public_id,
                "owner_id": owner_key,
                "sha256": sha256,
                "filename": filename,
                "kind": kind,
                "byte_size": byte_size,
                "blob_key": blob_key,
                "calibrate": calibrate,
                "given": _of_upload(given),
                "state": "received",
                "received_at": now(),
                "stage_at": now(),
                **{column: given.get(field) for field, column in GIVEN_SETTINGS.items()},
            }
            known, created = _insert_or_find(session, fresh)
            if created:
                _keep_announced(session, f"{blob_key.rpartition('/')[0]}/")
                return Received(known, fresh=True)
            merged = _of_upload(given, known.given)
            again = (
                known.state in {"failed", "cancelled"}
                or (calibrate and not known.calibrate)
                or (known.state == "needs_lens" and merged != known.given)
                or (known.kind == PROFILE_FILE and known.state == "stored")
            )
            if again:
                known.calibrate = calibrate
                known.given = merged
                if known.file_gone_at is None:  # else once the file is stored: a worker would look for it
                    restart(session, known)
            return Received(known, fresh=again, wants_file=known.file_gone_at is not None)

    def give_up_file(self, photo_id: str, names: Sequence[str]) -> bool:
        """Give up the file of a photo and pictures of it; False if it is still needed, or gone already.

        The row says so before the blobs are deleted, and their keys become garbage: no blob is left behind.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
            busy = CorrectionRow.state.in_(("queued", "running"))
            if photo is None or photo.file_gone_at is not None or photo.state in UNFINISHED:
                return False
            unfinished = select(CorrectionRow.id).where(CorrectionRow.photo_id == photo.id, busy)
            if session.scalar(unfinished.limit(1)) is not None:
                return False
            photo.file_gone_at = now()
            keys = [photo.blob_key, *(f"{photo_folder(photo)}{name}" for name in names)]
            insert_new(session, GarbageRow, [{"prefix": key, "not_before": now()} for key in keys])
            return True

    def restore_file(self, photo_id: str, blob_key: str, *, again: bool = False) -> None:
        """Record that the file of a photo was stored again under a new key; with `again` start it anew."""
        with self._db.writing(durable=True) as session:
            photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
            if photo is None:
                return
            photo.blob_key, photo.file_gone_at = blob_key, None
            photo.location = photo.file_sha256 = None
            if again:
                restart(session, photo)

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

        With `epoch` only if the photo was not started anew since: a worker that lost its lease changes
        nothing.
        """
        with self._db.writing() as session:
            return change_state(session, photo_id, from_states, to, epoch=epoch, **fields)

    def record_inspection(self, photo_id: str, identity: LensName, **header: object) -> None:
        """Store what the header says; the owner's corrections go before it, settings of the upload after."""
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
            if photo is None:
                return
            settings = {column: header.pop(column, None) for column in GIVEN_SETTINGS.values()}
            for field, column in GIVEN_SETTINGS.items():
                setattr(photo, column, _setting(photo, field, settings[column]))
            for column, value in header.items():
                setattr(photo, column, value)
            serial = photo.given.get("lens_serial")
            photo.lens_maker = photo.given.get("lens_maker") or identity.maker
            photo.lens_model = photo.given.get("lens_model") or identity.model
            photo.lens_serial = serial or identity.serial
            photo.lens_serial_source = "user" if serial else identity.serial_source

    def record_lateral(self, photo_id: str, epoch: int, lateral: dict[str, Any]) -> None:
        """Store the lateral colour that a photo shows, unless it was deleted or started anew meanwhile."""
        current = (PhotoRow.public_id == photo_id, PhotoRow.epoch == epoch, PhotoRow.deleted_at.is_(None))
        with self._db.writing() as session:
            session.execute(update(PhotoRow).where(*current).values(lateral=lateral))

    def record_location(
        self, photo: PhotoRow, location: str, *, key: str | None = None, digest: str | None = None
    ) -> bool:
        """Record whether the file of a photo said where it was taken; False if it has another file by now.

        With `key` and `digest` a file without the place, of that SHA-256, is stored there: it becomes the
        file of the photo, and the one before garbage once nobody reads it any more.
        """
        current = (PhotoRow.public_id == photo.public_id, PhotoRow.blob_key == photo.blob_key)
        changed = {} if key is None else {"blob_key": key, "file_sha256": digest}
        with self._db.writing(durable=True) as session:
            statement = update(PhotoRow).where(*current, PhotoRow.deleted_at.is_(None))
            recorded = session.connection().execute(statement.values(location=location, **changed))
            if recorded.rowcount != 1:
                return False
            if key is not None:
                old = {"prefix": photo.blob_key, "not_before": now() + LATE}
                insert_new(session, GarbageRow, [old])
            return True

    def assign_lens(self, photo_id: str, *, single_copy: bool = False) -> LensRow | None:
        """Return the lens of an inspected photo, created if need be; None if its copy is unknown.

        Order: the lens that the owner named, then the serial (given by the owner, else of the file), then,
        only with `single_copy`, the model alone. Photos that are merely stored join a lens that exists
        but create none.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
            if photo is None:
                return None
            lens = lenses.lens_of_photo(session, photo, single_copy=single_copy)
            if lens is not None:
                photo.lens_id, photo.way = lens.id, lens.way
                lens.complete(photo.lens_maker, photo.lens_model)
                if photo.calibrate and photo.given.get("model") == lens.way:  # the request is fulfilled
                    photo.given = {name: value for name, value in photo.given.items() if name != "model"}
            return lens

    def change(
        self,
        photo_id: str,
        owner: str,
        given: Mapping[str, Any],
        *,
        lens: LensName | str | None = None,
        excluded: bool | None = None,
        calibrate: bool = False,
    ) -> bool:
        """Apply what the owner changes: settings, the lens or its id, whether the photo counts.

        With `calibrate` a photo that was merely stored starts again, to teach its lens.

        All of it or nothing; False where the photo cannot be excluded or included. A photo that has a
        result changes its lens's model at once, any other starts again.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None:
                return False
            if excluded is not None:
                wanted: Final[Literal["excluded", "counted"]] = "excluded" if excluded else "counted"
                if photo.state != wanted and not lenses.switch(session, photo, wanted):
                    return False
            chosen = _chosen(session, photo, lens, owner)
            begins = calibrate and not photo.calibrate
            if begins and photo.file_gone_at is not None:
                return False
            return _changed(session, photo, given, chosen, begins=begins)

    def change_several(
        self, photo_ids: Sequence[str], owner: str, given: Mapping[str, Any], lens: str | NewCopy | None
    ) -> None:
        """Apply the same settings and lens to several photos: to all or, where one refuses, to none.

        A new copy becomes the lens of them all.
        """
        with self._db.writing() as session:
            # always locked in the same order: two such changes must not wait for each other
            rows = {key: find_to_change(session, PhotoRow, key, owner) for key in sorted(set(photo_ids))}
            chosen: LensRow | None = None
            for key in photo_ids:
                photo = rows[key]
                if photo is None:
                    raise UnknownPhotoError(f"there is no photo {key[:60]}: nothing was changed")
                if chosen is None and isinstance(lens, NewCopy):
                    name = LensName(photo.lens_maker, photo.lens_model, None, label=lens.label)
                    chosen = _chosen(session, photo, name, owner)
                elif chosen is None and isinstance(lens, str):
                    chosen = _chosen(session, photo, lens, owner)
                if not _changed(session, photo, given, chosen):
                    raise ConflictError(
                        f"photo {key} was learned from for another model than that of the lens: leave it "
                        "out; nothing was changed"
                    )

    def fail(self, photo_id: str, epoch: int, code: str, detail: str) -> bool:
        """End a photo that is being worked on with a reason; its samples never count."""
        with self._db.writing() as session:
            fields = {"error_code": code, "error_detail": detail, "finished_at": now()}
            failed = change_state(
                session, photo_id, ("received", *PHOTO_RUNNING), "failed", epoch=epoch, **fields
            )
            if failed:
                _let_go(session, photo_id)
            return failed

    def retry(self, photo_id: str, owner: Owner) -> bool:
        """Start a failed or cancelled photo anew; False if it is in another state."""
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None or photo.state not in {"failed", "cancelled"}:
                return False
            restart(session, photo)
            return True

    def cancel(self, photo_id: str, owner: Owner) -> bool:
        """Cancel an unfinished photo; False if it was finished already.

        Work that still runs sees the state and changes nothing.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None or not change_state(
                session, photo_id, UNFINISHED, "cancelled", finished_at=now()
            ):
                return False
            session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
            _let_go(session, photo_id)
            return True

    def finish(self, photo_id: str, epoch: int) -> int | None:
        """Count a photo: its samples join the model and the lens's version grows by one.

        Returns the new version, or None if the photo was counted, cancelled or started anew meanwhile. One
        transaction: it happens entirely and once, however often it is tried.
        """
        with self._db.writing() as session:
            done = {"finished_at": now(), "counted_at": now()}
            if not change_state(session, photo_id, ("estimating",), "counted", epoch=epoch, **done):
                return None
            photo = session.scalars(select(PhotoRow).where(PhotoRow.public_id == photo_id)).one()
            if photo.lens_id is None:
                raise ValueError(f"photo {photo_id} has no lens: assign one before it is counted")
            return join(session, photo, "photo_added")

    def delete(self, photo_id: str, owner: Owner) -> str | None:
        """Forget a photo, its patches and samples; return the prefix of its blobs.

        The row stays, emptied, because the lens's history refers to it.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None:
                return None
            if photo.state == "counted":
                give_back(session, photo, "photo_removed")
            session.execute(delete(SampleRow).where(SampleRow.photo_id == photo.id))
            session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
            delete_corrections(session, photo)
            photo.deleted_at = now()
            photo.state = "cancelled" if photo.state in UNFINISHED else photo.state
            _erase_description(photo)
            photo.windows, photo.windows_rejected = None, 0
            forget_if_empty(session, photo)
            prefix = photo_folder(photo)
            insert_new(session, GarbageRow, [{"prefix": prefix, "not_before": now() + LATE}])
            return prefix


def _keep_announced(session: Session, prefix: str) -> None:
    """Let blobs be garbage no longer; refuse those that a worker deletes already."""
    announced = (GarbageRow.prefix == prefix, GarbageRow.claimed.is_(False))
    if session.scalar(delete(GarbageRow).where(*announced).returning(GarbageRow.prefix)) is None:
        raise BusyError("the upload took too long, and what had come of it was deleted: send it again")


def _insert_or_find(session: Session, fresh: dict[str, Any]) -> tuple[PhotoRow, bool]:
    """Insert a photo, or find the one with the same bytes; True if inserted.

    On PostgreSQL another transaction may delete that one after it blocked our insert and before our select.
    """
    for _ in range(TRIES):
        created = insert_new(session, PhotoRow, [fresh]) == 1
        known = _known(session, fresh["owner_id"], fresh["sha256"])
        if known is not None:
            return known, created
    raise BusyError(f"{TRIES} times the photo of the same bytes came and went: send it again")


def _known(session: Session, owner_key: int, sha256: str) -> PhotoRow | None:
    return session.scalar(
        select(PhotoRow)
        .where(PhotoRow.owner_id == owner_key, PhotoRow.sha256 == sha256, PhotoRow.deleted_at.is_(None))
        .with_for_update()
    )


def _changed(
    session: Session,
    photo: PhotoRow,
    given: Mapping[str, Any],
    chosen: LensRow | None,
    *,
    begins: bool = False,
) -> bool:
    """Change the settings and the lens of a photo; False where it cannot be given to that lens."""
    if chosen is not None and not may_move(photo, chosen):
        return False
    columns = {GIVEN_SETTINGS[name]: value for name, value in given.items()}
    photo.calibrate |= begins
    if photo.state in {"counted", "stored", "excluded"} and not begins:
        if given:
            _correct_settings(session, photo, given, columns)
        if chosen is not None:
            lenses.move_photo(session, photo, chosen)
    elif begins or given or chosen is not None:
        photo.given = {**photo.given, **given}
        if chosen is not None:  # the lens has its model: an earlier request for one no longer applies
            kept = {name: value for name, value in photo.given.items() if name != "model"}
            photo.given = {**kept, "lens_id": chosen.public_id}
        restart(session, photo)
    return True


def _correct_settings(
    session: Session, photo: PhotoRow, given: Mapping[str, Any], columns: Mapping[str, Any]
) -> None:
    """Correct the settings of a finished photo; if it counts its lens's model is fitted anew."""
    photo.given = {**photo.given, **given}
    for column, value in columns.items():
        setattr(photo, column, value)
    session.flush()
    if photo.state == "counted":
        assert photo.lens_id is not None
        version = lenses.new_version(session, photo.lens_id, rebuild=True)
        lenses.record_event(session, photo.lens_id, version, "photo_changed", photo, samples_added=0)


def _chosen(session: Session, photo: PhotoRow, lens: LensName | str | None, owner: str) -> LensRow | None:
    """Return the lens that an owner describes or whose id is given; None where neither is."""
    if isinstance(lens, LensName):
        return lenses.named(session, photo.owner_id, lens, way=photo.given.get("model", photo.way))
    return None if lens is None else find_owned(session, LensRow, lens, owner)


def photo_folder(photo: PhotoRow) -> str:
    """Return the prefix of a photo's blobs."""
    return f"{photo.blob_key.rpartition('/')[0]}/"


def stored_settings(photo: PhotoRow) -> dict[str, Any]:
    """Return the lens settings of a photo, as tasks read them."""
    return {"aperture": photo.aperture, "focal_mm": photo.focal_mm, "focus_m": photo.focus_m}


def _of_upload(fields: Mapping[str, Any], before: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Return the fields of an upload, after those of `before`, as `PhotoRow.given` holds them."""
    known = before or {}
    fallbacks = {name: value for name, value in fields.items() if name in GIVEN_SETTINGS}
    merged = {**known, **{name: value for name, value in fields.items() if name not in GIVEN_SETTINGS}}
    return {**merged, FALLBACKS: {**known.get(FALLBACKS, {}), **fallbacks}} if fallbacks else merged


def _setting(photo: PhotoRow, field: str, header: object) -> object:
    """Return a setting by precedence: corrected by the owner, in the header, given with the file."""
    ranked = (photo.given.get(field), header, photo.given.get(FALLBACKS, {}).get(field))
    return next((value for value in ranked if value is not None), None)


def _erase_description(photo: PhotoRow) -> None:
    """Erase all that the file and its owner said of a deleted photo."""
    photo.given, photo.filename, photo.sha256 = {}, "", ""
    for column in DESCRIPTION:
        setattr(photo, column, None)


def _let_go(session: Session, photo_id: str) -> None:
    """Forget a lens that only a photo without a result refers to, and with it its serial."""
    photo = session.scalars(
        select(PhotoRow).where(PhotoRow.public_id == photo_id).execution_options(populate_existing=True)
    ).one()
    forget_if_empty(session, photo)


def restart(session: Session, photo: PhotoRow) -> None:
    """Begin a new epoch of a photo: its samples are deleted, work of the old one that still runs is void."""
    session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
    photo.epoch += 1
    photo.state, photo.stage_at = "received", now()
    photo.error_code = photo.error_detail = photo.started_at = photo.finished_at = photo.counted_at = None
    photo.attempt = photo.patches_total = photo.patches_done = photo.patches_rejected = 0
    photo.windows, photo.windows_rejected = None, 0


def change_state(
    session: Session,
    photo_id: str,
    from_states: Sequence[str],
    to: str,
    *,
    epoch: int | None = None,
    **fields: object,
) -> bool:
    """Move a photo from one of `from_states` to `to`; False where it was in none of them."""
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
