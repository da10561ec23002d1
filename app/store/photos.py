"""Photos: received once, moved from state to state, counted exactly once.

Their patches are planned once, and each cell of them is finished once. Windows that were rejected before
estimation are one compact value of their photo, not thousands of rows.
"""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, Final

from sqlalchemy import Select, delete, func, select, update
from sqlalchemy.orm import Session, joinedload

from app import distances
from app.errors import BusyError, UnknownError
from app.store import lenses
from app.store.database import find_or_insert, new_id, reads, writes
from app.store.lenses import PROFILE, LensName, columns_of, forget_if_empty, forget_patches, note_change
from app.store.owners import ANY_OWNER, Owner, Works, discard, ensure_owner, find_to_change, now, page_of
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
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings

# Fields that the owner may give, with the column that each fills. Sent with the file they fill it until the
# file says otherwise; said later they are corrections, in `PhotoRow.given`, and go before what the file says.
GIVEN_SETTINGS: Final = {
    "aperture": "aperture",
    "focal_length_mm": "focal_mm",
    "focus_distance_m": "focus_m",
    "pixel_pitch_um": "pixel_pitch_um",
}
# Time between the end of the longest upload and the deletion of one that was broken off (chosen): clocks of
# several machines differ by less
SPARE: Final = timedelta(hours=1)
# How long the file of a photo is kept for a first correction, or for a retry after an outage (chosen): its
# owner looks again within a day
FILE_KEPT: Final = timedelta(days=1)
SOON: Final = timedelta(seconds=2)  # within it the turn of a photo comes on an idle machine (chosen)
# Decimals of r and phi (chosen): they round to 0.2 pixels at most in a photo of 24 megapixels, whose half
# diagonal is 3,600 pixels
DIGITS: Final = 4
_WINDOW: Final = ("row", "col", "size", "r", "phi", "reason")


@dataclass(frozen=True, slots=True)
class Received:
    """Result of an upload: the photo, and whether there is work to do for it."""

    photo: PhotoRow
    fresh: bool


class Photos(Works[PhotoRow]):
    """Photos of all owners, with their patches."""

    table, active, unfinished = PhotoRow, PHOTO_WORKED_ON, PHOTO_UNFINISHED

    @reads
    def have_files(self, session: Session) -> bool:
        """Say whether the file of any photo is kept."""
        return session.scalar(select(PhotoRow.id).where(_FILED).limit(1)) is not None

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
    def unread(self, session: Session) -> PhotoRow | None:
        """Return a photo of which nothing is known yet and whose turn does not come at once."""
        # any: several workers ask
        waits = (PhotoRow.state == "received", PhotoRow.stage_at < now() - SOON, PhotoRow.width.is_(None))
        query = select(PhotoRow).where(*waits, PhotoRow.kind != PROFILE_FILE)
        return session.scalar(query.order_by(func.random()).limit(1))

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

    @writes
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
        settings = {GIVEN_SETTINGS[field]: given[field] for field in GIVEN_SETTINGS.keys() & given.keys()}
        said = {field: value for field, value in given.items() if field not in GIVEN_SETTINGS}
        fresh = PhotoRow(
            **file,
            **settings,
            lens=None,
            owner_id=ensure_owner(session, owner, may_be_new=may_be_new),
            calibrate=calibrate,
            given=said,
            state="received",
            **dict.fromkeys(("received_at", "stage_at"), now()),
        )
        of_bytes = (PhotoRow.owner_id == fresh.owner_id, PhotoRow.sha256 == fresh.sha256)
        same = select(PhotoRow).where(*of_bytes).options(joinedload(PhotoRow.lens))
        known, created = find_or_insert(session, same, fresh)
        if created:
            _keep_announced(session, known.folder)
            return Received(known, fresh=True)
        before, now_said = {name: getattr(known, name) for name in settings}, {**known.given, **said}
        again = (
            known.state in ENDED_BADLY
            or (calibrate and not known.calibrate)
            or (known.state == "needs_lens" and (settings, now_said) != (before, known.given))
            or (known.kind == PROFILE_FILE and known.state == "stored")
        )
        if known.file_gone_at is not None:  # this is the same one
            known.blob_key, known.file_gone_at = fresh.blob_key, None
            known.location = known.file_sha256 = None
            _keep_announced(session, known.folder)
        if again:
            known.calibrate, known.given = calibrate, now_said
            for column, value in settings.items():
                setattr(known, column, value)
            self.restart(session, known)
        return Received(known, fresh=again)

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

    # --- work -------------------------------------------------------------------------------------

    @writes
    def record_inspection(
        self,
        session: Session,
        /,
        photo_id: str,
        identity: LensName,
        *,
        single_copy: bool = False,
        **header: object,
    ) -> PhotoRow | None:
        """Store what the header says; return the photo with its lens, None if it was deleted."""
        # The owner's corrections go before the header, settings of the upload after it. The lens is the one
        # that the owner named, else that of the serial, else, only with `single_copy`, of the model alone.
        # Photos that are merely stored join a lens that exists but create none.
        photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
        if photo is None:
            return None
        for field, column in GIVEN_SETTINGS.items():
            ranked = (photo.given.get(field), header.pop(column, None), getattr(photo, column))
            setattr(photo, column, next((value for value in ranked if value is not None), None))
        for column, value in header.items():
            setattr(photo, column, value)
        serial = photo.given.get("lens_serial")
        photo.lens_maker = photo.given.get("lens_maker") or identity.maker
        photo.lens_model = photo.given.get("lens_model") or identity.model
        photo.lens_serial = serial or identity.serial
        photo.lens_serial_source = "user" if serial else identity.serial_source
        lens = lenses.lens_of_photo(session, photo, single_copy=single_copy)
        if lens is not None:
            photo.lens = lens
            lens.complete(photo.lens_maker, photo.lens_model)
        return photo

    @writes
    def record_lateral(self, session: Session, photo_id: str, epoch: int, lateral: dict[str, Any]) -> None:
        """Store the lateral colour that a photo shows, unless it was deleted or started anew meanwhile."""
        current = (PhotoRow.public_id == photo_id, PhotoRow.epoch == epoch)
        session.execute(update(PhotoRow).where(*current).values(lateral=lateral))

    @writes
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
        current = find_to_change(session, PhotoRow, photo.public_id, ANY_OWNER)
        if current is None or current.blob_key != photo.blob_key:
            return False
        current.location = location
        if key is not None:
            discard(session, current.blob_key)
            current.blob_key, current.file_sha256 = key, digest
        return True

    @writes
    def finish(self, session: Session, photo_id: str, epoch: int) -> int | None:
        """Count a photo: its samples join the model and the lens's version grows by one."""
        # Returns the new version, or None if the photo was counted, cancelled or started anew meanwhile. One
        # transaction: it happens entirely and once, however often it is tried.
        photo = self.move(session, photo_id, ANY_OWNER, ("estimating",), "counted", epoch=epoch)
        if photo is not None and photo.lens_id is None:
            raise ValueError(f"photo {photo_id} has no lens: assign one before it is counted")
        return None if photo is None else note_change(session, photo, "photo_added")

    def _ended_badly(self, session: Session, photo: PhotoRow) -> None:
        """Forget a lens that only this photo refers to, and with it its serial."""
        if photo.state == "cancelled":
            session.execute(delete(PatchRow).where(PatchRow.photo_id == photo.id))
        forget_if_empty(session, photo)

    # --- patches ----------------------------------------------------------------------------------

    @writes
    def plan_patches(
        self,
        session: Session,
        photo_id: str,
        epoch: int,
        patches: Sequence[Mapping[str, Any]],
        rejected: Sequence[Mapping[str, Any]],
    ) -> int:
        """Write the plan of a photo once, as columns of patches; return how many are to be estimated."""
        # A second call, by a worker that repeats the step, adds nothing
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return 0
        if photo.windows is None:
            which = {"photo_id": photo.id, "epoch": epoch, "state": "pending"}
            session.add_all(PatchRow(**which, idx=idx, **patch) for idx, patch in enumerate(patches))
            photo.windows, photo.windows_rejected = _packed(rejected), len(rejected)
        return _recount(session, photo)

    @reads
    def patches(self, session: Session, photo_id: str, epoch: int | None = None) -> list[PatchRow]:
        """Return the patches of a photo that were chosen for estimation, in the order of their numbers."""
        return list(session.scalars(_patches_of(photo_id, epoch).order_by(PatchRow.idx)))

    @reads
    def windows(self, session: Session, photo_id: str) -> list[PatchRow]:
        """Return the patches of a photo, followed by the windows that were rejected before estimation."""
        rows = list(session.scalars(_patches_of(photo_id).order_by(PatchRow.idx)))
        columns = session.scalar(select(PhotoRow.windows).where(PhotoRow.public_id == photo_id)) or {}
        rejected = enumerate(zip(*columns.values(), strict=True), len(rows))
        return rows + [
            PatchRow(idx=idx, state="rejected", **dict(zip(columns, window, strict=True)))
            for idx, window in rejected
        ]

    @writes
    def add_samples(
        self, session: Session, photo_id: str, epoch: int, samples: Sequence[tuple[int, PsfSample]]
    ) -> int:
        """Store the samples of some patches and mark these done; return how many samples were new."""
        # Nothing happens if the photo was cancelled, deleted or started anew meanwhile. A repeated call
        # stores nothing twice: what is done stays as it is.
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return 0
        new = {(idx, sample.settings.channel): sample for idx, sample in samples}
        numbers = PatchRow.idx.in_({idx for idx, _ in new})
        mine = (PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, numbers)
        query = select(PatchRow).where(*mine, PatchRow.state != "done")
        patches = {patch.idx: patch for patch in session.scalars(query)}
        rows = [
            SampleRow(**columns_of(sample, photo, patches[idx]))
            for (idx, _), sample in new.items()
            if idx in patches
        ]
        session.add_all(rows)
        for patch in patches.values():
            patch.state = "done"
        _recount(session, photo)
        return len(rows)

    @writes
    def reject_patches(
        self, session: Session, photo_id: str, epoch: int, reason: str, numbers: Sequence[int]
    ) -> None:
        """Mark patches as useless, except those that are done."""
        photo = _selecting(session, photo_id, epoch)
        if photo is None:
            return
        mine = (PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, PatchRow.idx.in_(numbers))
        rejected = update(PatchRow).where(*mine, PatchRow.state != "done")
        session.execute(rejected.values(state="rejected", reason=reason[:60]))
        _recount(session, photo)

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
        # gone, to none; False where the first cannot be excluded or included.
        chosen: LensRow | None = None
        for key in photo_ids:
            photo = find_to_change(session, PhotoRow, key, owner)
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

    @writes
    def take_in(
        self,
        session: Session,
        file: PhotoRow,
        samples: Sequence[PsfSample],
        names: Mapping[str, str],
        called: str = "",
    ) -> bool:
        """Let the samples of a profile join its lens, which is `called` so from now on."""
        # False where the lens is gone, or the reading of `file` was cancelled or begun anew. Each photo of
        # the profile becomes a counted photo without a file, which can be excluded or deleted as any other.
        # What was imported before is not imported again.
        groups: defaultdict[tuple[str, LensSettings], list[PsfSample]] = defaultdict(list)
        for sample in samples:
            groups[sample.photo, sample.settings.with_channel("g")].append(sample)
        lens = find_to_change(session, LensRow, file.given["lens_id"], ANY_OWNER)
        done: dict[str, Any] = {"epoch": file.epoch, "file_gone_at": now()}
        if not lens or not self.move(session, file.public_id, ANY_OWNER, ("inspecting",), "stored", **done):
            return False
        lens.label = called or lens.label
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


def _patches_of(photo_id: str, epoch: int | None = None) -> Select[PatchRow]:
    return (
        select(PatchRow)
        .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
        .where(PhotoRow.public_id == photo_id, PatchRow.epoch == (epoch or PhotoRow.epoch))
    )


def _selecting(session: Session, photo_id: str, epoch: int) -> PhotoRow | None:
    """Return a photo whose patches may change, locked: on PostgreSQL a cancel waits, and the other way."""
    photo = find_to_change(session, PhotoRow, photo_id, ANY_OWNER)
    may = photo is not None and photo.epoch == epoch and photo.state in {"selecting", "estimating"}
    return photo if may else None


def _recount(session: Session, photo: PhotoRow) -> int:
    """Count the patches anew: recomputed, never incremented, so that a repeat cannot count twice."""
    rows = session.execute(
        select(PatchRow.state, func.count())
        .where(PatchRow.photo_id == photo.id, PatchRow.epoch == photo.epoch)
        .group_by(PatchRow.state)
    )
    counts = {row[0]: row[1] for row in rows}
    rejected = counts.get("rejected", 0)
    photo.patches_rejected = rejected + photo.windows_rejected
    photo.patches_done = counts.get("done", 0)
    photo.patches_total = sum(counts.values()) - rejected
    return photo.patches_total


def _packed(rejected: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Return windows as one value that JSON can hold: a list for each column."""
    columns = {name: [window[name] for window in rejected] for name in _WINDOW}
    return columns | {name: [round(value, DIGITS) for value in columns[name]] for name in ("r", "phi")}


def _keep_announced(session: Session, prefix: str) -> None:
    """Let blobs be garbage no longer; refuse those that a worker deletes already."""
    announced = (GarbageRow.prefix == prefix, GarbageRow.claimed.is_(False))
    if session.scalar(delete(GarbageRow).where(*announced).returning(GarbageRow.prefix)) is None:
        raise BusyError("the upload took too long, and what had come of it was deleted: send it again")


def stored_settings(photo: PhotoRow) -> dict[str, Any]:
    """Return the lens settings of a photo, as tasks read them."""
    return {"aperture": photo.aperture, "focal_mm": photo.focal_mm, "focus_m": photo.focus_m}


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
