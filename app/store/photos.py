"""Photos: received once, moved from state to state, counted exactly once."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final, Literal

from sqlalchemy import case, delete, select, update
from sqlalchemy.orm import Session, joinedload

from app import distances
from app.errors import BusyError, UnknownError
from app.store import lenses
from app.store.database import changed, insert_new, insert_or_find, new_id, reads, writes, writes_durably
from app.store.lenses import LensName, forget_if_empty, forget_patches, give_back, join
from app.store.owners import ANY_OWNER, Owner, discard, ensure_owner, find_owned, find_to_change, now, owned
from app.store.patches import Patches
from app.store.samples import PROFILE, columns_of
from app.store.tables import (
    CORRECTION_ACTIVE,
    PHOTO_FINAL,
    PHOTO_UNFINISHED,
    PHOTO_WORKED_ON,
    PROFILE_FILE,
    CorrectionRow,
    GarbageRow,
    LensRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings

# Fields that the owner may give, with the column that each fills
GIVEN_SETTINGS: Final = {
    "aperture": "aperture",
    "focal_length_mm": "focal_mm",
    "focus_distance_m": "focus_m",
    "pixel_pitch_um": "pixel_pitch_um",
}
# Key in `PhotoRow.given` of the settings that came with the file: the header's own go before them. Settings
# under their own names are corrections made since and go before the header.
FALLBACKS: Final = "fallbacks"
# Columns that describe a photo; all are emptied when it is deleted
DESCRIPTION: Final = (
    *("lens_maker", "lens_model", "lens_serial", "lens_serial_source", "camera_maker", "camera_model"),
    *("aperture", "focal_mm", "focus_m", "pixel_pitch_um", "lateral"),
    *("width", "height", "orientation", "location", "error_detail", "body_key"),
)
# Time between the end of the longest upload and the deletion of one that was broken off (chosen): clocks of
# several machines differ by less
SPARE: Final = timedelta(hours=1)
# How long the file of a photo is kept for a first correction, or for a retry after an outage (chosen): its
# owner looks again within a day
FILE_KEPT: Final = timedelta(days=1)


@dataclass(frozen=True, slots=True)
class Received:
    """Result of an upload: the photo, and whether there is work to do for it."""

    photo: PhotoRow
    fresh: bool
    wants_file: bool = False  # whether the photo is known without its file, which has now come again


class Photos(Patches):
    """Photos of all owners, with their patches. `ANY_OWNER` asks as the service itself."""

    @reads
    def get(self, session: Session, photo_id: str, owner: Owner) -> PhotoRow | None:
        """Return one photo with its lens, or None."""
        return find_owned(session, PhotoRow, photo_id, owner)

    @reads
    def newest_file(self, session: Session) -> str | None:
        """Return the key of the file of the newest photo, or None where there is no file."""
        return session.scalar(select(PhotoRow.blob_key).where(*_FILED).order_by(PhotoRow.id.desc()).limit(1))

    @reads
    def page(
        self,
        session: Session,
        owner: str,
        *,
        before: str | None,
        limit: int,
        lens_id: str | None = None,
        state: str | None = None,
    ) -> list[PhotoRow]:
        """Return photos with their lenses, newest first, that came before the photo `before`."""
        query = owned(PhotoRow, owner).where(PhotoRow.kind != PROFILE_FILE)
        if before is not None:
            query = query.where(PhotoRow.public_id < before)
        if lens_id is not None:
            query = query.where(PhotoRow.lens.has(LensRow.public_id == lens_id))
        if state is not None:
            query = query.where(PhotoRow.state == state)
        return list(session.scalars(query.order_by(PhotoRow.public_id.desc()).limit(limit)))

    @reads
    def unneeded(self, session: Session, limit: int = 100) -> list[str]:
        """Return photos whose file is to be given up where files are not kept."""
        # Never one that is being worked on, waits for its lens, or failed in an outage and may be retried
        jobs = select(CorrectionRow.id).where(CorrectionRow.photo_id == PhotoRow.id)
        busy = jobs.where(CorrectionRow.state.in_(CORRECTION_ACTIVE)).exists()
        ended, day = PhotoRow.finished_at, now() - FILE_KEPT
        learned = PhotoRow.state.in_(("counted", "excluded", "cancelled")) | (
            (PhotoRow.state == "failed") & ((PhotoRow.error_code != "outage") | (ended < day))
        )
        disposable = learned | ((PhotoRow.state == "stored") & (jobs.exists() | (ended < day)))
        query = select(PhotoRow.public_id).where(*_FILED, disposable, ~busy)
        return list(session.scalars(query.limit(limit)))

    @reads
    def read_profiles(self, session: Session, limit: int = 100) -> list[str]:
        """Return the files of samples that were read, or refused, a day ago."""
        ended = PhotoRow.finished_at < now() - FILE_KEPT
        query = select(PhotoRow.public_id).where(
            PhotoRow.kind == PROFILE_FILE, PhotoRow.deleted_at.is_(None), ended
        )
        return list(session.scalars(query.limit(limit)))

    @reads
    def unsearched(self, session: Session, limit: int = 100) -> list[PhotoRow]:
        """Return photos nobody works on whose file may still say where they were taken."""
        # Such are those that failed before they were searched, and files that came again
        query = select(PhotoRow).where(*_FILED, PhotoRow.location.is_(None), PhotoRow.kind != PROFILE_FILE)
        return list(session.scalars(query.where(PhotoRow.state.not_in(PHOTO_WORKED_ON)).limit(limit)))

    @reads
    def is_live(self, session: Session, photo_id: str, epoch: int) -> bool:
        """Say whether work for this epoch of the photo is still wanted: the cancel poll."""
        of_epoch = (PhotoRow.public_id == photo_id, PhotoRow.epoch == epoch)
        wanted = (PhotoRow.state.not_in(PHOTO_FINAL), PhotoRow.deleted_at.is_(None))
        return session.scalar(select(PhotoRow.id).where(*of_epoch, *wanted)) is not None

    @reads
    def siblings(self, session: Session, photo: PhotoRow, limit: int) -> list[PhotoRow]:
        """Return the newest other RAW photos of the same owner and body whose file is kept."""
        if photo.body_key is None:
            return []
        same = (PhotoRow.owner_id == photo.owner_id, PhotoRow.body_key == photo.body_key)
        raw = (PhotoRow.id != photo.id, PhotoRow.kind.in_(("raw", "dng")))
        query = select(PhotoRow).where(*same, *raw, *_FILED).order_by(PhotoRow.id.desc())
        return list(session.scalars(query.limit(limit)))

    @reads
    def existing(self, session: Session, photo_ids: Iterable[str]) -> set[str]:
        """Return which of these photos are not deleted and still have their file."""
        query = select(PhotoRow.public_id).where(PhotoRow.public_id.in_(list(photo_ids)), *_FILED)
        return set(session.scalars(query))

    # --- receiving --------------------------------------------------------------------------------

    @writes
    def expect(self, session: Session, prefix: str, *, within: timedelta) -> None:
        """Announce blobs below `prefix`: garbage an hour after that time unless a photo claims them."""
        discard(session, prefix, after=within + SPARE)

    @writes_durably
    def receive(
        self,
        session: Session,
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
        """Store an upload that was announced by `expect`, or find the photo with the same bytes."""
        # A known photo starts again where that makes sense: it had failed or was cancelled, it is now to
        # calibrate its lens and was not before, or it waited for settings that are now given
        fresh = {
            "public_id": public_id,
            "owner_id": ensure_owner(session, owner, may_be_new=may_be_new),
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
        of_bytes = (PhotoRow.owner_id == fresh["owner_id"], PhotoRow.sha256 == sha256)
        same = select(PhotoRow).where(*of_bytes, PhotoRow.deleted_at.is_(None))
        query = same.options(joinedload(PhotoRow.lens)).with_for_update(of=PhotoRow)
        known, created = insert_or_find(session, PhotoRow, fresh, query, "photo of the same bytes")
        if created:
            _keep_announced(session, known.folder)
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

    @writes
    def give_up_file(self, session: Session, photo_id: str, names: Sequence[str]) -> bool:
        """Give up the file of a photo and pictures of it; False if it is still needed, or gone already."""
        # The row says so before the blobs are deleted, and their keys become garbage: no blob is left behind
        photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
        if photo is None or photo.file_gone_at is not None or photo.state in PHOTO_UNFINISHED:
            return False
        busy = CorrectionRow.state.in_(CORRECTION_ACTIVE)
        unfinished = select(CorrectionRow.id).where(CorrectionRow.photo_id == photo.id, busy)
        if session.scalar(unfinished.limit(1)) is not None:
            return False
        photo.file_gone_at = now()
        discard(session, photo.blob_key, *(f"{photo.folder}{name}" for name in names), after=timedelta(0))
        return True

    @writes_durably
    def restore_file(self, session: Session, photo_id: str, blob_key: str, *, again: bool = False) -> None:
        """Record that the file of a photo was stored again under a new key; with `again` start it anew."""
        photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
        if photo is None:
            return
        photo.blob_key, photo.file_gone_at = blob_key, None
        photo.location = photo.file_sha256 = None
        if again:
            restart(session, photo)

    # --- work -------------------------------------------------------------------------------------

    @writes
    def start(self, session: Session, photo_id: str, epoch: int) -> PhotoRow | None:
        """Take up a photo, a new one or one that another worker left; None if there is nothing to do."""
        photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
        if photo is None or photo.epoch != epoch or photo.state not in PHOTO_WORKED_ON:
            return None
        if photo.state == "received":
            photo.state, photo.started_at, photo.stage_at = "inspecting", now(), now()
        photo.attempt += 1
        return photo

    @writes
    def set_state(
        self,
        session: Session,
        /,
        photo_id: str,
        from_states: Sequence[str],
        to: str,
        *,
        epoch: int | None = None,
        **fields: object,
    ) -> bool:
        """Move a photo from one of `from_states` to `to`; False where it was in none of them."""
        # With `epoch` only if the photo was not started anew since: a worker that lost its lease changes
        # nothing
        return change_state(session, photo_id, from_states, to, epoch=epoch, **fields)

    @writes
    def record_inspection(
        self, session: Session, /, photo_id: str, identity: LensName, **header: object
    ) -> None:
        """Store what the header says; the owner's corrections go before it, settings of the upload after."""
        photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
        if photo is None:
            return
        for field, column in GIVEN_SETTINGS.items():
            setattr(photo, column, _setting(photo, field, header.pop(column, None)))
        for column, value in header.items():
            setattr(photo, column, value)
        serial = photo.given.get("lens_serial")
        photo.lens_maker = photo.given.get("lens_maker") or identity.maker
        photo.lens_model = photo.given.get("lens_model") or identity.model
        photo.lens_serial = serial or identity.serial
        photo.lens_serial_source = "user" if serial else identity.serial_source

    @writes
    def record_lateral(self, session: Session, photo_id: str, epoch: int, lateral: dict[str, Any]) -> None:
        """Store the lateral colour that a photo shows, unless it was deleted or started anew meanwhile."""
        current = (PhotoRow.public_id == photo_id, PhotoRow.epoch == epoch, PhotoRow.deleted_at.is_(None))
        session.execute(update(PhotoRow).where(*current).values(lateral=lateral))

    @writes_durably
    def record_location(
        self,
        session: Session,
        photo: PhotoRow,
        location: str,
        *,
        key: str | None = None,
        digest: str | None = None,
    ) -> bool:
        """Record whether the file of a photo said where it was taken; False if it has another file by now."""
        # With `key` and `digest` a file without the place, of that SHA-256, is stored there: it becomes the
        # file of the photo, and the one before garbage once nobody reads it any more
        current = (PhotoRow.public_id == photo.public_id, PhotoRow.blob_key == photo.blob_key)
        values = {"location": location, **({} if key is None else {"blob_key": key, "file_sha256": digest})}
        statement = update(PhotoRow).where(*current, PhotoRow.deleted_at.is_(None)).values(**values)
        if changed(session, statement) != 1:
            return False
        if key is not None:
            discard(session, photo.blob_key)
        return True

    @writes
    def assign_lens(self, session: Session, photo_id: str, *, single_copy: bool = False) -> LensRow | None:
        """Return the lens of an inspected photo, created if need be; None if its copy is unknown."""
        # Order: the lens that the owner named, then the serial (given by the owner, else of the file), then,
        # only with `single_copy`, the model alone. Photos that are merely stored join a lens that exists but
        # create none.
        photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
        if photo is None:
            return None
        lens = lenses.lens_of_photo(session, photo, single_copy=single_copy)
        if lens is not None:
            photo.lens_id = lens.id
            lens.complete(photo.lens_maker, photo.lens_model)
        return lens

    @writes
    def fail(self, session: Session, photo_id: str, epoch: int, code: str, detail: str) -> bool:
        """End a photo that is being worked on with a reason; its samples never count."""
        fields = {"error_code": code, "error_detail": detail, "finished_at": now()}
        failed = change_state(session, photo_id, PHOTO_WORKED_ON, "failed", epoch=epoch, **fields)
        if failed:
            _let_go(session, photo_id)
        return failed

    @writes
    def finish(self, session: Session, photo_id: str, epoch: int) -> int | None:
        """Count a photo: its samples join the model and the lens's version grows by one."""
        # Returns the new version, or None if the photo was counted, cancelled or started anew meanwhile. One
        # transaction: it happens entirely and once, however often it is tried.
        done = {"finished_at": now(), "counted_at": now()}
        if not change_state(session, photo_id, ("estimating",), "counted", epoch=epoch, **done):
            return None
        photo = session.scalars(select(PhotoRow).where(PhotoRow.public_id == photo_id)).one()
        if photo.lens_id is None:
            raise ValueError(f"photo {photo_id} has no lens: assign one before it is counted")
        return join(session, photo, "photo_added")

    # --- what owners change -----------------------------------------------------------------------

    @writes
    def change(
        self,
        session: Session,
        photo_id: str,
        owner: str,
        given: Mapping[str, Any],
        *,
        lens: LensName | str | None = None,
        excluded: bool | None = None,
        calibrate: bool = False,
    ) -> bool:
        """Apply what the owner changes: settings, the lens or its id, whether the photo counts."""
        # With `calibrate` a photo that was merely stored starts again, to teach its lens. All of it or
        # nothing; False where the photo cannot be excluded or included. A photo that has a result changes its
        # lens's model at once, any other starts again.
        photo = find_to_change(session, PhotoRow, photo_id, owner)
        if photo is None:
            return False
        if excluded is not None:
            wanted: Literal["excluded", "counted"] = "excluded" if excluded else "counted"
            if photo.state != wanted and not lenses.switch(session, photo, wanted):
                return False
        chosen = _chosen(session, photo, lens, owner)
        begins = calibrate and not photo.calibrate
        if begins and photo.file_gone_at is not None:
            return False
        _change(session, photo, given, chosen, begins=begins)
        return True

    @writes
    def change_several(
        self,
        session: Session,
        photo_ids: Sequence[str],
        owner: str,
        given: Mapping[str, Any],
        *,
        lens_id: str | None = None,
        label: str | None = None,
    ) -> None:
        """Apply the same settings and lens to several photos: to all or, where one is gone, to none."""
        # With `label` a new copy, called so, of the lens that the first one names becomes that of them all;
        # always locked in the same order: two such changes must not wait for each other
        rows = {key: find_to_change(session, PhotoRow, key, owner) for key in sorted(set(photo_ids))}
        chosen: LensRow | None = None
        for key in photo_ids:
            photo = rows[key]
            if photo is None:
                raise UnknownError("photo", key)
            if chosen is None:
                named = label and LensName(photo.lens_maker, photo.lens_model, None, label=label)
                chosen = _chosen(session, photo, named or lens_id, owner)
            _change(session, photo, given, chosen)

    @writes
    def retry(self, session: Session, photo_id: str, owner: Owner) -> bool:
        """Start a failed or cancelled photo anew; False if it is in another state."""
        photo = find_to_change(session, PhotoRow, photo_id, owner)
        if photo is None or photo.state not in {"failed", "cancelled"}:
            return False
        restart(session, photo)
        return True

    @writes
    def cancel(self, session: Session, photo_id: str, owner: Owner) -> bool:
        """Cancel an unfinished photo; False if it was finished already."""
        # Work that still runs sees the state and changes nothing
        photo = find_to_change(session, PhotoRow, photo_id, owner)
        if photo is None or not change_state(
            session, photo_id, PHOTO_UNFINISHED, "cancelled", finished_at=now()
        ):
            return False
        session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
        _let_go(session, photo_id)
        return True

    @writes
    def delete(self, session: Session, photo_id: str, owner: Owner) -> str | None:
        """Forget a photo, its patches, samples and corrections; return the prefix of its blobs."""
        # The row stays, emptied, because the lens's history refers to it
        photo = find_to_change(session, PhotoRow, photo_id, owner)
        if photo is None:
            return None
        if photo.state == "counted":
            give_back(session, photo, "photo_removed")
        forget_patches(session, photo)
        corrections = session.scalars(select(CorrectionRow).where(CorrectionRow.photo_id == photo.id))
        discard(session, photo.folder, *(row.folder for row in corrections))
        session.execute(delete(CorrectionRow).where(CorrectionRow.photo_id == photo.id))
        photo.deleted_at = now()
        photo.state = "cancelled" if photo.state in PHOTO_UNFINISHED else photo.state
        photo.given, photo.filename, photo.sha256 = {}, "", ""
        for column in DESCRIPTION:
            setattr(photo, column, None)
        forget_if_empty(session, photo)
        return photo.folder

    # --- profiles ---------------------------------------------------------------------------------

    @writes_durably
    def take_in(
        self, session: Session, file: PhotoRow, samples: Sequence[PsfSample], names: Mapping[str, str]
    ) -> int | None:
        """Let the samples of a profile join its lens; return the number of their photos."""
        # None where the lens is gone, or the reading of `file` was cancelled or begun anew. Each photo of the
        # profile becomes a counted photo without a file, which can be excluded or deleted as any other. What
        # was imported before is not imported again.
        groups: defaultdict[tuple[str, LensSettings], list[PsfSample]] = defaultdict(list)
        for sample in samples:
            groups[sample.photo, sample.settings.with_channel("g")].append(sample)
        lens = find_to_change(session, LensRow, file.given["lens_id"], ANY_OWNER)
        ended = {"finished_at": now(), "file_gone_at": now()}
        if lens is None or not change_state(
            session, file.public_id, ("inspecting",), "stored", epoch=file.epoch, **ended
        ):
            return None
        discard(session, file.blob_key)
        here = (PhotoRow.lens_id == lens.id, PhotoRow.deleted_at.is_(None))
        own = set(session.scalars(select(PhotoRow.public_id).where(*here)))
        imported = 0
        for (photo, settings), of_photo in groups.items():
            if photo in own:
                continue
            name = names.get(photo, photo or PROFILE)
            row = _imported(session, lens, photo, settings, of_photo[0], name)
            if row is not None:
                _estimated(session, row, of_photo)
                join(session, row, "photo_added")
                imported += 1
        return imported


# Conditions of photos whose file is kept
_FILED: Final = (PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None))


def _keep_announced(session: Session, prefix: str) -> None:
    """Let blobs be garbage no longer; refuse those that a worker deletes already."""
    announced = (GarbageRow.prefix == prefix, GarbageRow.claimed.is_(False))
    if session.scalar(delete(GarbageRow).where(*announced).returning(GarbageRow.prefix)) is None:
        raise BusyError("the upload took too long, and what had come of it was deleted: send it again")


def _change(
    session: Session,
    photo: PhotoRow,
    given: Mapping[str, Any],
    chosen: LensRow | None,
    *,
    begins: bool = False,
) -> None:
    """Change the settings and the lens of a photo."""
    columns = {GIVEN_SETTINGS[name]: value for name, value in given.items()}
    photo.calibrate |= begins
    if photo.state in {"counted", "stored", "excluded"} and not begins:
        if given:
            _correct_settings(session, photo, given, columns)
        if chosen is not None:
            lenses.move_photo(session, photo, chosen)
    elif begins or given or chosen is not None:
        photo.given = {**photo.given, **given}
        if chosen is not None:
            photo.given = {**photo.given, "lens_id": chosen.public_id}
        restart(session, photo)


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
        return lenses.named(session, photo.owner_id, lens)
    return None if lens is None else find_owned(session, LensRow, lens, owner)


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


def _let_go(session: Session, photo_id: str) -> None:
    """Forget a lens that only a photo without a result refers to, and with it its serial."""
    photo = session.scalars(
        select(PhotoRow).where(PhotoRow.public_id == photo_id).execution_options(populate_existing=True)
    ).one()
    forget_if_empty(session, photo)


def restart(session: Session, photo: PhotoRow) -> None:
    """Begin a new epoch of a photo: its samples are deleted, work of the old one that still runs is void."""
    forget_patches(session, photo)
    photo.epoch += 1
    photo.attempt = 0
    photo.state, photo.stage_at = "received", now()
    photo.error_code = photo.error_detail = photo.started_at = photo.finished_at = photo.counted_at = None


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
    statement = update(PhotoRow).where(*conditions).values(state=to, stage_at=since, **fields)
    return changed(session, statement) == 1


# --- profiles -------------------------------------------------------------------------------------


def _imported(
    session: Session, lens: LensRow, photo: str, settings: LensSettings, first: PsfSample, name: str
) -> PhotoRow | None:
    digest = hashlib.sha256(f"{PROFILE}|{lens.public_id}|{photo}|{settings}".encode()).hexdigest()
    public_id = new_id()
    fresh: dict[str, Any] = {
        "public_id": public_id,
        "owner_id": lens.owner_id,
        "lens_id": lens.id,
        "sha256": digest,
        "filename": name[:200],
        "kind": PROFILE,
        "byte_size": 0,
        "blob_key": f"photos/{public_id}/original",
        "calibrate": True,
        "given": {"lens_id": lens.public_id},
        "aperture": settings.aperture,
        "focal_mm": settings.focal_mm,
        "focus_m": distances.written(settings.focus_m),
        "pixel_pitch_um": first.pixel_pitch_um,
        "state": "counted",
        **dict.fromkeys(("received_at", "stage_at", "started_at", "finished_at", "counted_at"), now()),
        "file_gone_at": now(),
    }
    if insert_new(session, PhotoRow, [fresh]) != 1:
        return None
    return session.scalars(select(PhotoRow).where(PhotoRow.public_id == public_id)).one()


def _estimated(session: Session, photo: PhotoRow, samples: Sequence[PsfSample]) -> None:
    places: dict[tuple[float, float], int] = {}
    for sample in samples:
        places.setdefault(_place(sample), len(places))
    done: dict[str, Any] = {"photo_id": photo.id, "epoch": photo.epoch, "state": "done"}
    done |= {"row": 0, "col": 0, "size": 0, "finished_at": now()}  # a profile does not say where in pixels
    rows = [{**done, "idx": idx, "cell": idx, "r": r, "phi": phi} for (r, phi), idx in places.items()]
    insert_new(session, PatchRow, rows)
    patches = {row.idx: row for row in session.scalars(select(PatchRow).where(PatchRow.photo_id == photo.id))}
    columns = [columns_of(sample, photo, patches[places[_place(sample)]]) for sample in samples]
    insert_new(session, SampleRow, columns)
    photo.patches_total = photo.patches_done = len(places)
    session.flush()


def _place(sample: PsfSample) -> tuple[float, float]:
    return sample.position.r, sample.position.phi
