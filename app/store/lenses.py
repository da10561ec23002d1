"""Lenses: which copy it is, what was learned of it, and its version, which grows when its samples change.

The version grows under the lens's row lock, so that versions and the samples that belong to them become
visible in the same order.
"""

from __future__ import annotations

import math
import zlib
from collections import Counter
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import timedelta
from functools import lru_cache
from typing import Any, Final

import numpy as np
from sqlalchemy import Row, Select, delete, func, select, update
from sqlalchemy.orm import Session

from app import distances
from app.errors import ServiceError
from app.store.database import Repository, changed, find_or_insert, new_id, reads, writes
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
from lensmodel.core.errors import NoSamplesError
from lensmodel.core.names import name_key, serial_key
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.model.profile import entry_of, sample_of

DTYPE: Final = "<f4"
FORMAT_VERSION: Final = 2  # raised when samples of before mean nothing to the model any more
# Characters kept of an estimator's name, which profiles and own estimators choose (chosen: every name of
# ours fits, and no other fills the table)
MAX_ESTIMATOR: Final = 60
_OWN: Final = ("r", "phi", "weight", "size", "estimator", "error")
_OF_PHOTO: Final = {"photo": PhotoRow.public_id, "pixel_pitch_um": PhotoRow.pixel_pitch_um}
_SETTINGS: Final = {
    "channel": SampleRow.channel,
    "aperture": PhotoRow.aperture,
    "focal_mm": PhotoRow.focal_mm,
    "focus_m": PhotoRow.focus_m,
}

# What `sample_in` reads: of samples joined with their patches and photos
COLUMNS: Final = (
    *(column.label(name) for name, column in {**_OF_PHOTO, **_SETTINGS}.items()),
    *(SampleRow.entry, SampleRow.crc32, SampleRow.format_version, SampleRow.psf),
    *(PatchRow.encoded, PhotoRow.width, PhotoRow.height),
)
PROFILE: Final = "profile"  # kind of a photo of which a profile has told: its file was never here

TEACHES: Final = PhotoRow.state == "counted"

# How long the previous version is kept (chosen): a worker may still be reporting of it
STILL_WRITTEN: Final = timedelta(minutes=30)

REPORT_FORM: Final = 2  # of the JSON of `LensReport`: raised when that of before can no longer be read


@dataclass(frozen=True, slots=True)
class LensName:
    """Which copy of which lens: identified by its serial, or by a label that its owner gives it."""

    maker: str | None
    model: str | None
    serial: str | None
    serial_source: str = "user"
    label: str | None = None


@dataclass(frozen=True, slots=True)
class LensState:
    """Version of a lens: shows whether a fitted model is up to date."""

    version: int
    rebuild_epoch: int


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
        return None if photo.lens_serial is None else session.scalar(_same(photo.owner_id, _key_of(photo)))

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
        query = select(PhotoRow.height, PhotoRow.width).where(PhotoRow.lens_id == lens.id, TEACHES)
        shapes = Counter((row[0], row[1]) for row in session.execute(query) if row[0] and row[1])
        return max(shapes, key=lambda shape: (shapes[shape], shape[1]), default=None)

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
        # False if one of the two does not exist, or photos of the first are still being learned from
        lens, target = (find_to_change(session, LensRow, key, owner) for key in (lens_id, into))
        if lens is None or target is None or lens.id == target.id:
            return False
        photos = list(session.scalars(select(PhotoRow).where(PhotoRow.lens_id == lens.id)))
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
        for photo in session.scalars(select(PhotoRow).where(PhotoRow.lens_id == lens.id)):
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
        of_owner = LensRow.owner_id == photo.owner_id
        chosen = session.scalar(select(LensRow).where(LensRow.public_id == lens_id, of_owner))
        if chosen is not None:
            return chosen
    if photo.lens_serial is None and not (single_copy and photo.lens_model):
        return None
    if photo.calibrate:
        source = photo.lens_serial_source or "none"
        name = LensName(photo.lens_maker, photo.lens_model, photo.lens_serial, source)
        return named(session, photo.owner_id, name)
    return session.scalar(_same(photo.owner_id, _key_of(photo)))


def _key_of(photo: PhotoRow) -> str:
    return identity_key(photo.lens_maker, photo.lens_model, photo.lens_serial)


def _same(owner_id: int, key: str) -> Select[LensRow]:
    return select(LensRow).where(LensRow.owner_id == owner_id, LensRow.identity_key == key)


def named(session: Session, owner_id: int, name: LensName) -> LensRow:
    """Return the lens of a serial, creating it if need be; a label always creates a new lens."""
    key = f"label|{new_id()}" if name.label else identity_key(name.maker, name.model, name.serial)
    fresh = LensRow(
        public_id=new_id(),
        owner_id=owner_id,
        identity_key=key,
        maker=name.maker,
        model=name.model,
        serial=name.serial,
        serial_source="user" if name.label else name.serial_source if name.serial else "none",
        label=name.label,
        created_at=now(),
    )
    return find_or_insert(session, _same(owner_id, key), fresh)[0]


# --- samples and versions -------------------------------------------------------------------------


def note_change(session: Session, photo: PhotoRow, kind: str) -> int:
    """Give the lens of a photo a new version, which `kind` explains; return it."""
    # Its samples and photos are counted anew, never incremented
    lens = session.get_one(LensRow, photo.lens_id)
    if lens.version:  # before the first there was nothing to report
        reports = report_key(lens.public_id, lens.version, lens.rebuild_epoch).rpartition("/")[0]
        discard(session, f"{reports}/", after=STILL_WRITTEN)  # in each form
    lens.version += 1
    # where samples went away or changed, models in memory are fitted anew instead of extended
    lens.rebuild_epoch += kind != "photo_added"
    change, joins = 0, kind in {"photo_added", "photo_included"}
    if kind != "photo_changed":
        belongs = (lens.id, lens.version) if joins else (None, None)
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
            samples_added=change if joins else -change,
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


def report_key(lens_id: str, version: int, epoch: int) -> str:
    """Return the key of the report that a worker makes of one version of a lens."""
    return f"models/{lens_id}/{version}-{epoch}/report-{REPORT_FORM}.json"


# --- deletion -------------------------------------------------------------------------------------


def forget_if_empty(session: Session, photo: PhotoRow, *, gone: bool = False) -> None:
    """Detach a photo that teaches nothing from its lens; delete the lens if no other photo refers to it."""
    # A lens that the owner named stays as long as there is any photo of it, even a failed one
    lens = None if photo.lens_id is None else session.get(LensRow, photo.lens_id)
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


def columns_of(sample: PsfSample, photo: PhotoRow, patch: PatchRow) -> dict[str, Any]:
    """Return a sample as a row; what its photo knows, its photo's row keeps, and `patch` what it encodes."""
    entry = entry_of(sample)
    entry["estimator"] = entry["estimator"][:MAX_ESTIMATOR] or PROFILE
    if sample.encoded is not None:
        patch.encoded = sample.encoded.to_bytes()
    blob = np.ascontiguousarray(sample.kernel, dtype=DTYPE).tobytes()
    return {
        "photo_id": photo.id,
        "patch_id": patch.id,
        "channel": sample.settings.channel,
        "entry": {name: entry[name] for name in _OWN},
        "format_version": FORMAT_VERSION,
        "crc32": zlib.crc32(blob),
        "psf": blob,
    }


def sample_in(row: Row[*tuple[Any, ...]]) -> PsfSample:
    """Build the sample of a row of `COLUMNS`."""
    if row.format_version != FORMAT_VERSION:
        raise NoSamplesError(
            "the samples of this lens were made by an earlier version of the program: calibrate it again, by "
            "retrying its photos"
        )
    if zlib.crc32(row.psf) != row.crc32:
        text = f"sample {row.id} differs from what was written: restore the database"
        raise ServiceError(text, code="corrupt_sample")
    settings = {name: getattr(row, name) for name in _SETTINGS}
    settings["focus_m"] = distances.read(settings["focus_m"])
    entry = row.entry | {name: getattr(row, name) for name in _OF_PHOTO}
    entry["half_diagonal_px"] = math.hypot(row.width, row.height) / 2 if row.width and row.height else None
    return sample_of(
        {**entry, "settings": settings},
        np.frombuffer(row.psf, dtype=DTYPE).reshape(entry["size"], entry["size"]),
        None if row.encoded is None else _encoded(row.encoded),
    )


@lru_cache(maxsize=16)
def _encoded(data: bytes) -> EncodedPatch:
    """Decode a patch once for its three channels."""
    return EncodedPatch.from_bytes(data)
