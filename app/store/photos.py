"""Photos: received once, moved from state to state, counted exactly once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, Final

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session

from app.errors import BusyError, ConflictError, UnknownPhotoError
from app.store import lens_ways, lenses, sample_moves
from app.store.access.owners import ANY_OWNER, LATE, Owner, ensure_owner, find_owned, find_to_change, now
from app.store.database import insert_new
from app.store.lenses import LensName
from app.store.photo_reads import PhotoReads
from app.store.photo_steps import (
    GIVEN_SETTINGS,
    UNFINISHED,
    CopyIdentity,
    change_state,
    drop_patches,
    erase_description,
    let_go,
    of_upload,
    photo_folder,
    restart,
    setting,
    widen,
)
from app.store.removal import forget_if_empty
from app.store.tables import (
    PHOTO_RUNNING,
    PROFILE_FILE,
    CorrectionRow,
    GarbageRow,
    LensRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)

TRIES: Final = 100
"""How often an upload looks again for the photo of the same bytes that was deleted between insert and select
(chosen: 80 simultaneous uploads and deletions of the same bytes on PostgreSQL all end)."""


SPARE: Final = timedelta(hours=1)
"""Time between the end of the longest upload and the deletion of one that was broken off (chosen): clocks of
several machines differ by less."""


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


class PhotoStore(PhotoReads):
    """Photos of all owners. `ANY_OWNER` asks as the service itself."""

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
                "given": of_upload(given),
                "state": "received",
                "received_at": now(),
                "stage_at": now(),
                **{column: given.get(field) for field, column in GIVEN_SETTINGS.items()},
            }
            known, created = _insert_or_find(session, fresh)
            if created:
                _keep_announced(session, f"{blob_key.rpartition('/')[0]}/")
                return Received(known, fresh=True)
            merged = of_upload(given, known.given)
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

    def record_inspection(
        self,
        photo_id: str,
        *,
        width: int,
        height: int,
        identity: CopyIdentity,
        aperture: float | None,
        focal_mm: float | None,
        focus_m: float | None,
        pixel_pitch_um: float | None,
        orientation: int | None = None,
        camera_maker: str | None = None,
        camera_model: str | None = None,
        body_key: str | None = None,
        iso: float | None = None,
        exposure_s: float | None = None,
        taken_at: datetime | None = None,
    ) -> None:
        """Store what the header says; the owner's corrections go before it, settings of the upload after."""
        header = {
            "aperture": aperture,
            "focal_mm": focal_mm,
            "focus_m": focus_m,
            "pixel_pitch_um": pixel_pitch_um,
        }
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
            if photo is None:
                return
            for field, column in GIVEN_SETTINGS.items():
                setattr(photo, column, setting(photo, field, header[column]))
            serial = photo.given.get("lens_serial")
            photo.width, photo.height, photo.orientation = width, height, orientation
            photo.camera_maker, photo.camera_model, photo.body_key = camera_maker, camera_model, body_key
            photo.lens_maker = photo.given.get("lens_maker") or identity.maker
            photo.lens_model = photo.given.get("lens_model") or identity.model
            photo.lens_serial = serial or identity.serial
            photo.lens_serial_source = "user" if serial else identity.serial_source
            photo.iso, photo.exposure_s, photo.taken_at = iso, exposure_s, taken_at

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
                widen(lens, photo)
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
                wanted_state: Final = "excluded" if excluded else "counted"
                if photo.state != wanted_state and not sample_moves.switch(session, photo, wanted_state):
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
                        f"photo {key} was learned from for another model than that of the lens, and its file "
                        "is no longer kept: leave it out; nothing was changed"
                    )

    def fail(self, photo_id: str, epoch: int, code: str, detail: str) -> bool:
        """End a photo that is being worked on with a reason; its samples never count."""
        with self._db.writing() as session:
            fields = {"error_code": code, "error_detail": detail, "finished_at": now()}
            failed = change_state(
                session, photo_id, ("received", *PHOTO_RUNNING), "failed", epoch=epoch, **fields
            )
            if failed:
                _ended(session, photo_id)
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
            drop_patches(session, photo)
            _ended(session, photo_id)
            return True

    def finish(self, photo_id: str, epoch: int) -> int | None:
        """Count a photo: its samples join the model and the lens's version grows by one.

        Returns the new version, or None if the photo was counted, cancelled or started anew
        meanwhile, or waits until its lens has changed its way. One transaction: it happens entirely and
        once, however often it is tried.
        """
        with self._db.writing() as session:
            done = {"finished_at": now(), "counted_at": now()}
            if not change_state(session, photo_id, ("estimating",), "counted", epoch=epoch, **done):
                return None
            photo = session.scalars(select(PhotoRow).where(PhotoRow.public_id == photo_id)).one()
            if photo.lens_id is None:
                raise ValueError(f"photo {photo_id} has no lens: assign one before it is counted")
            if photo.way != lens_ways.locked(session, photo.lens_id).way:
                restart(session, photo)
                return None
            return lens_ways.join(session, photo, "photo_added")

    def delete(self, photo_id: str, owner: Owner) -> str | None:
        """Forget a photo, its patches and samples; return the prefix of its blobs.

        The row stays, emptied, because the lens's history refers to it.
        """
        with self._db.writing() as session:
            photo = find_to_change(session, PhotoRow, photo_id, owner)
            if photo is None:
                return None
            lens_id = photo.lens_id
            if lens_ways.teaches(session, photo):
                sample_moves.give_back(session, photo, "photo_removed")
            session.execute(delete(SampleRow).where(SampleRow.photo_id == photo.id))
            session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
            lenses.delete_corrections(session, photo)
            photo.deleted_at = now()
            photo.state = "cancelled" if photo.state in UNFINISHED else photo.state
            erase_description(photo)
            photo.windows, photo.windows_rejected = None, 0
            forget_if_empty(session, photo)
            if lens_id is not None:
                lens_ways.settle_way(session, lens_id)
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
    if chosen is not None and not sample_moves.may_move(photo, chosen):
        return False
    columns = {GIVEN_SETTINGS[name]: value for name, value in given.items()}
    photo.calibrate |= begins
    if photo.state in {"counted", "stored", "excluded"} and not begins:
        if given:
            sample_moves.change_settings(session, photo, given, columns)
        if chosen is not None:
            sample_moves.move_photo(session, photo, chosen)
    elif begins or given or chosen is not None:
        sample_moves.begin_again(session, photo, given, columns, chosen)
    return True


def _ended(session: Session, photo_id: str) -> None:
    """Clean up after a photo without a result: its lens is deleted if empty, or no longer waits for it."""
    photo = let_go(session, photo_id)
    if photo.relearning and photo.lens_id is not None:
        lens_ways.settle_way(session, photo.lens_id)


def _chosen(session: Session, photo: PhotoRow, lens: LensName | str | None, owner: str) -> LensRow | None:
    """Return the lens that an owner describes or whose id is given; None where neither is."""
    if isinstance(lens, LensName):
        return lenses.named(session, photo.owner_id, lens, way=photo.given.get("model", photo.way))
    return None if lens is None else find_owned(session, LensRow, lens, owner)
