"""Photos: received once, moved from state to state, counted exactly once."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

from sqlalchemy import delete, select, update
from sqlalchemy.orm import Session, joinedload

from app import distances
from app.errors import BusyError, UnknownError
from app.store import lenses
from app.store.database import changed, insert_or_find, new_id, reads, writes, writes_durably
from app.store.lenses import LensName, forget_if_empty, forget_patches, note_change
from app.store.owners import ANY_OWNER, Owner, discard, ensure_owner, find_to_change, now, page_of
from app.store.patches import Patches
from app.store.samples import PROFILE, columns_of
from app.store.tables import (
    CORRECTION_ACTIVE,
    ENDED_BADLY,
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
from app.store.work import Works
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


class Photos(Patches, Works[PhotoRow]):
    """Photos of all owners, with their patches."""

    table, active, unfinished = PhotoRow, PHOTO_WORKED_ON, PHOTO_UNFINISHED

    @reads
    def newest_file(self, session: Session) -> str | None:
        """Return the key of the file of the newest photo, or None where there is no file."""
        return session.scalar(select(PhotoRow.blob_key).where(_FILED).order_by(PhotoRow.id.desc()).limit(1))

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
        conditions = [PhotoRow.kind != PROFILE_FILE]
        if lens_id is not None:
            conditions.append(PhotoRow.lens.has(LensRow.public_id == lens_id))
        if state is not None:
            conditions.append(PhotoRow.state == state)
        return page_of(session, PhotoRow, owner, *conditions, before=before, limit=limit)

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
        query = select(PhotoRow.public_id).where(_FILED, disposable, ~busy)
        return list(session.scalars(query.limit(limit)))

    @reads
    def read_profiles(self, session: Session, limit: int = 100) -> list[str]:
        """Return the files of samples that were read, or refused, a day ago."""
        ended = PhotoRow.finished_at < now() - FILE_KEPT
        query = select(PhotoRow.public_id).where(PhotoRow.kind == PROFILE_FILE, ended)
        return list(session.scalars(query.limit(limit)))

    @reads
    def unsearched(self, session: Session, limit: int = 100) -> list[PhotoRow]:
        """Return photos nobody works on whose file may still say where they were taken."""
        # Such are those that failed before they were searched, and files that came again
        query = select(PhotoRow).where(_FILED, PhotoRow.location.is_(None), PhotoRow.kind != PROFILE_FILE)
        return list(session.scalars(query.where(PhotoRow.state.not_in(PHOTO_WORKED_ON)).limit(limit)))

    @reads
    def siblings(self, session: Session, photo: PhotoRow, limit: int) -> list[PhotoRow]:
        """Return the newest other RAW photos of the same owner and body whose file is kept."""
        if photo.body_key is None:
            return []
        same = (PhotoRow.owner_id == photo.owner_id, PhotoRow.body_key == photo.body_key)
        raw = (PhotoRow.id != photo.id, PhotoRow.kind.in_(("raw", "dng")))
        query = select(PhotoRow).where(*same, *raw, _FILED).order_by(PhotoRow.id.desc())
        return list(session.scalars(query.limit(limit)))

    @reads
    def existing(self, session: Session, photo_ids: Iterable[str]) -> set[str]:
        """Return which of these photos are not deleted and still have their file."""
        query = select(PhotoRow.public_id).where(PhotoRow.public_id.in_(list(photo_ids)), _FILED)
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
        /,
        owner: str,
        *,
        given: Mapping[str, Any],
        calibrate: bool,
        may_be_new: bool = True,
        **file: str | int,
    ) -> Received:
        """Store an upload that was announced by `expect`, or find the photo with the same bytes."""
        # `file`: public_id, sha256, filename, kind, byte_size and blob_key.
        # A known photo starts again where that makes sense: it had failed or was cancelled, it is now to
        # calibrate its lens and was not before, or it waited for settings that are now given
        fresh = {
            **file,
            "owner_id": ensure_owner(session, owner, may_be_new=may_be_new),
            "calibrate": calibrate,
            "given": _of_upload(given),
            "state": "received",
            **dict.fromkeys(("received_at", "stage_at"), now()),
            **{column: given.get(field) for field, column in GIVEN_SETTINGS.items()},
        }
        of_bytes = (PhotoRow.owner_id == fresh["owner_id"], PhotoRow.sha256 == file["sha256"])
        same = select(PhotoRow).where(*of_bytes)
        query = same.options(joinedload(PhotoRow.lens)).with_for_update(of=PhotoRow)
        known, created = insert_or_find(session, PhotoRow, fresh, query, "photo of the same bytes")
        if created:
            _keep_announced(session, known.folder)
            return Received(known, fresh=True)
        merged = _of_upload(given, known.given)
        again = (
            known.state in ENDED_BADLY
            or (calibrate and not known.calibrate)
            or (known.state == "needs_lens" and merged != known.given)
            or (known.kind == PROFILE_FILE and known.state == "stored")
        )
        if again:
            known.calibrate, known.given = calibrate, merged
            if known.file_gone_at is None:  # else once the file is stored: a worker would look for it
                self.restart(session, known)
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
            self.restart(session, photo)

    # --- work -------------------------------------------------------------------------------------

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
        current = (PhotoRow.public_id == photo_id, PhotoRow.epoch == epoch)
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
        statement = update(PhotoRow).where(*current).values(**values)
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
    def finish(self, session: Session, photo_id: str, epoch: int) -> int | None:
        """Count a photo: its samples join the model and the lens's version grows by one."""
        # Returns the new version, or None if the photo was counted, cancelled or started anew meanwhile. One
        # transaction: it happens entirely and once, however often it is tried.
        photo = self.move(
            session, photo_id, ANY_OWNER, ("estimating",), "counted", {"finished_at": now()}, epoch=epoch
        )
        if photo is not None and photo.lens_id is None:
            raise ValueError(f"photo {photo_id} has no lens: assign one before it is counted")
        return None if photo is None else note_change(session, photo, "photo_added")

    def _ended_badly(self, session: Session, photo: PhotoRow) -> None:
        """Forget a lens that only this photo refers to, and with it its serial."""
        if photo.state == "cancelled":
            session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
        forget_if_empty(session, photo)

    # --- what owners change -----------------------------------------------------------------------

    @writes
    def change(
        self,
        session: Session,
        photo_ids: Sequence[str],
        owner: str,
        given: Mapping[str, Any],
        *,
        lens: LensName | str | None = None,
        excluded: bool | None = None,
        calibrate: bool = False,
    ) -> bool:
        """Apply what the owner changes: settings, the lens or its id, whether photos count."""
        # With `calibrate` a photo that was merely stored starts again, to teach its lens. A photo that has a
        # result changes its lens's model at once, any other starts again. To all photos or, where one is
        # gone, to none; False where the first cannot be excluded or included. Always locked in the same
        # order: two such changes must not wait for each other.
        rows = {key: find_to_change(session, PhotoRow, key, owner) for key in sorted(set(photo_ids))}
        chosen: LensRow | None = None
        for key in photo_ids:
            photo = rows[key]
            if photo is None:
                raise UnknownError("photo", key)
            if excluded is not None and not lenses.switch(session, photo, excluded=excluded):
                return False
            if isinstance(lens, LensName):
                chosen = chosen or lenses.named(session, photo.owner_id, lens)
            elif lens is not None and chosen is None:
                chosen = find_to_change(session, LensRow, lens, owner)
                if chosen is None:
                    raise UnknownError("lens", lens)
            begins = calibrate and not photo.calibrate
            if begins and photo.file_gone_at is not None:
                return False
            self._change(session, photo, given, chosen, begins=begins)
        return True

    def _change(
        self,
        session: Session,
        photo: PhotoRow,
        given: Mapping[str, Any],
        chosen: LensRow | None,
        *,
        begins: bool,
    ) -> None:
        photo.calibrate |= begins
        if photo.state not in {"counted", "stored", "excluded"} or begins:
            if begins or given or chosen is not None:
                named = {} if chosen is None else {"lens_id": chosen.public_id}
                photo.given = {**photo.given, **given, **named}
                self.restart(session, photo)
            return
        if given:
            photo.given = {**photo.given, **given}
            for field, value in given.items():
                setattr(photo, GIVEN_SETTINGS[field], value)
            if photo.state == "counted":
                note_change(session, photo, "photo_changed")
        if chosen is not None:
            lenses.move_photo(session, photo, chosen)

    def _forget_work(self, session: Session, photo: PhotoRow) -> None:
        forget_patches(session, photo)

    @writes
    def delete(self, session: Session, photo_id: str, owner: Owner) -> str | None:
        """Delete a photo, its patches, samples and corrections; return the prefix of its blobs."""
        photo = find_to_change(session, PhotoRow, photo_id, owner)
        if photo is None:
            return None
        if photo.state == "counted":
            note_change(session, photo, "photo_removed")
        corrections = session.scalars(select(CorrectionRow).where(CorrectionRow.photo_id == photo.id))
        discard(session, photo.folder, *(row.folder for row in corrections))
        forget_if_empty(session, photo, gone=True)
        session.execute(delete(PhotoRow).where(PhotoRow.id == photo.id))  # and by its key all of them
        return photo.folder

    # --- profiles ---------------------------------------------------------------------------------

    @writes_durably
    def take_in(
        self, session: Session, file: PhotoRow, samples: Sequence[PsfSample], names: Mapping[str, str]
    ) -> bool:
        """Let the samples of a profile join its lens."""
        # False where the lens is gone, or the reading of `file` was cancelled or begun anew. Each photo of
        # the profile becomes a counted photo without a file, which can be excluded or deleted as any other.
        # What was imported before is not imported again.
        groups: defaultdict[tuple[str, LensSettings], list[PsfSample]] = defaultdict(list)
        for sample in samples:
            groups[sample.photo, sample.settings.with_channel("g")].append(sample)
        lens = find_to_change(session, LensRow, file.given["lens_id"], ANY_OWNER)
        ended = {"finished_at": now(), "file_gone_at": now()}
        if lens is None or not self.move(
            session, file.public_id, ANY_OWNER, ("inspecting",), "stored", ended, epoch=file.epoch
        ):
            return False
        discard(session, file.blob_key)
        own = set(session.scalars(select(PhotoRow.public_id).where(PhotoRow.lens_id == lens.id)))
        of_profiles = (PhotoRow.owner_id == lens.owner_id, PhotoRow.kind == PROFILE)
        before = set(session.scalars(select(PhotoRow.sha256).where(*of_profiles)))
        for (photo, settings), of_photo in groups.items():
            digest = hashlib.sha256(f"{PROFILE}|{lens.public_id}|{photo}|{settings}".encode()).hexdigest()
            if photo not in own and digest not in before:
                name = names.get(photo, photo or PROFILE)[:200]
                _import(session, lens, settings, of_photo, sha256=digest, filename=name)
        return True


_FILED: Final = PhotoRow.file_gone_at.is_(None)  # of photos whose file is kept


def _keep_announced(session: Session, prefix: str) -> None:
    """Let blobs be garbage no longer; refuse those that a worker deletes already."""
    announced = (GarbageRow.prefix == prefix, GarbageRow.claimed.is_(False))
    if session.scalar(delete(GarbageRow).where(*announced).returning(GarbageRow.prefix)) is None:
        raise BusyError("the upload took too long, and what had come of it was deleted: send it again")


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


def _import(
    session: Session, lens: LensRow, settings: LensSettings, samples: Sequence[PsfSample], **names: str
) -> None:
    """Add a counted photo without a file, whose patches and samples a profile tells."""
    public_id, epoch = new_id(), 1
    places = {(sample.position.r, sample.position.phi): sample.position for sample in samples}
    photo = PhotoRow(
        public_id=public_id,
        owner_id=lens.owner_id,
        lens_id=lens.id,
        kind=PROFILE,
        byte_size=0,
        blob_key=f"photos/{public_id}/original",
        calibrate=True,
        given={"lens_id": lens.public_id},
        aperture=settings.aperture,
        focal_mm=settings.focal_mm,
        focus_m=distances.written(settings.focus_m),
        pixel_pitch_um=samples[0].pixel_pitch_um,
        epoch=epoch,
        state="counted",
        patches_total=len(places),
        patches_done=len(places),
        **dict.fromkeys(("received_at", "stage_at", "started_at", "finished_at", "file_gone_at"), now()),
        **names,
    )
    session.add(photo)
    session.flush()
    done = {"photo_id": photo.id, "epoch": epoch, "state": "done"}
    done |= dict.fromkeys(("row", "col", "size"), 0)  # a profile does not say where in pixels
    patches = {
        place: PatchRow(**done, idx=idx, cell=idx, r=place[0], phi=place[1])
        for idx, place in enumerate(places)
    }
    session.add_all(patches.values())
    session.flush()
    own = {(place, s.settings.channel): s for s in samples for place in [(s.position.r, s.position.phi)]}
    session.add_all(
        SampleRow(**columns_of(sample, photo, patches[place])) for (place, _), sample in own.items()
    )
    note_change(session, photo, "photo_added")
