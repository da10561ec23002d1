"""Patches of photos and the PSF samples that were estimated in them: planned once, each cell finished once.

A sample has the fields of `lensmodel.model.samples`, each with its column. Windows that were rejected
before estimation are one compact value of their photo, not thousands of rows.
"""

from __future__ import annotations

import hashlib
import math
import zlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any, Final

import numpy as np
from sqlalchemy import Row, Select, bindparam, func, select, update
from sqlalchemy.orm import InstrumentedAttribute, Session

from app import distances
from app.store.database import Database, insert_new, new_id
from app.store.lenses import join
from app.store.owners import ANY_OWNER, LATE, find_to_change, is_id, now
from app.store.photos import change_state
from app.store.tables import GarbageRow, LensRow, OwnerRow, PatchRow, PhotoRow, SampleRow
from lensmodel.core.errors import LensModelError, NoSamplesError
from lensmodel.core.psf import EncodedPatch, PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model.samples import entry_of, sample_of

OPEN: Final = ("pending", "running")

DIGITS: Final = 4
"""Decimals of r and phi (chosen): they round to 0.2 pixels at most in a photo of 24 megapixels, whose half
diagonal is 3,600 pixels."""

DTYPE: Final = "<f4"
FORMAT_VERSION: Final = 2
"""Raised when samples of before mean nothing to the model any more."""

MAX_ESTIMATOR: Final = 60
"""Characters kept of an estimator's name, which profiles and own estimators choose (chosen: every name of
ours fits, and no other fills the table)."""

_Columns = Mapping[str, InstrumentedAttribute[Any]]
_OWN: Final[_Columns] = {
    "r": SampleRow.r,
    "phi": SampleRow.phi,
    "weight": SampleRow.weight,
    "size": SampleRow.size,
    "estimator": SampleRow.estimator,
    "error": SampleRow.predicted_error,
}
_OF_PHOTO: Final[_Columns] = {"photo": PhotoRow.public_id, "pixel_pitch_um": PhotoRow.pixel_pitch_um}
_SETTINGS: Final[_Columns] = {
    "channel": SampleRow.channel,
    "aperture": PhotoRow.aperture,
    "focal_mm": PhotoRow.focal_mm,
    "focus_m": PhotoRow.focus_m,
}
_BESIDE: Final = (
    *(SampleRow.crc32, SampleRow.format_version, SampleRow.psf),
    *(PatchRow.encoded, PhotoRow.width, PhotoRow.height),
)

COLUMNS: Final = (
    *(column.label(name) for name, column in {**_OWN, **_OF_PHOTO, **_SETTINGS}.items()),
    *_BESIDE,
)
"""What `sample_in` reads: of samples joined with their patches and photos."""

PROFILE: Final = "profile"
"""Kind of a photo of which a profile has told: its file was never here."""

_STATE = select(LensRow.version, LensRow.rebuild_epoch, LensRow.way).where(
    LensRow.public_id == bindparam("lens"), LensRow.deleted_at.is_(None)
)
_KNOWN = (
    select(LensRow.version, LensRow.rebuild_epoch, LensRow.way)
    .join(OwnerRow, OwnerRow.id == LensRow.owner_id)
    .where(
        LensRow.public_id == bindparam("lens"),
        LensRow.deleted_at.is_(None),
        OwnerRow.name == bindparam("owner"),
    )
)


class OutdatedSampleError(NoSamplesError):
    """A sample was made by an estimator of an earlier version of the program."""


class CorruptSampleError(LensModelError):
    """A stored kernel is not what was written."""

    code = "corrupt_sample"


@dataclass(frozen=True, slots=True)
class NewPatch:
    """A window that was chosen, or rejected with a reason."""

    idx: int
    row: int
    col: int
    size: int
    r: float
    phi: float
    cell: int | None = None
    score: float | None = None
    rejected: str | None = None


@dataclass(frozen=True, slots=True, eq=False)
class NewSample:
    """One sample that was estimated from the patch `idx`, and what the estimator says of itself."""

    idx: int
    sample: PsfSample
    diagnostics: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class LensState:
    """Version of a lens: shows whether a fitted model is up to date, and in which way it was learned."""

    version: int
    rebuild_epoch: int
    way: str = "default"


@dataclass(frozen=True, slots=True, eq=False)
class StoredSample:
    """A sample with its key and the version at which it joined."""

    id: int
    version_added: int
    sample: PsfSample


class PatchStore:
    """Patches and the samples that are estimated from them."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def add(self, photo_id: str, epoch: int, patches: Sequence[NewPatch]) -> int:
        """Write the plan of a photo once; return how many patches are to be estimated.

        A second call, by a worker that repeats the step, adds nothing.
        """
        with self._db.writing() as session:
            photo = _live(session, photo_id, epoch)
            if photo is None:
                return 0
            rows = [
                {
                    "photo_id": photo.id,
                    "epoch": epoch,
                    "idx": patch.idx,
                    "cell": patch.cell,
                    "row": patch.row,
                    "col": patch.col,
                    "size": patch.size,
                    "r": patch.r,
                    "phi": patch.phi,
                    "score": patch.score,
                    "state": "pending",
                    "attempts": 0,
                }
                for patch in patches
                if patch.rejected is None
            ]
            insert_new(session, PatchRow, rows)
            rejected = [patch for patch in patches if patch.rejected is not None]
            if photo.windows is None:
                photo.windows, photo.windows_rejected = _packed(rejected), len(rejected)
            return recount_patches(session, photo)

    def all_of(self, photo_id: str, epoch: int | None = None) -> list[PatchRow]:
        """Return the patches of a photo that were chosen for estimation, in the order of their numbers."""
        with self._db.reading() as session:
            return list(session.scalars(_of_photo(photo_id, epoch).order_by(PatchRow.idx)))

    def places_of(self, photo_ids: Sequence[str]) -> list[FieldPosition]:
        """Return where patches of photos gave a PSF."""
        query = (
            select(PatchRow.r, PatchRow.phi)
            .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
            .where(PhotoRow.public_id.in_(photo_ids), PatchRow.epoch == PhotoRow.epoch)
            .where(PatchRow.state == "done")
            .order_by(PatchRow.id)
        )
        with self._db.reading() as session:
            return [FieldPosition(r, phi) for r, phi in session.execute(query)]

    def listed(self, photo_id: str) -> list[PatchRow]:
        """Return the patches of a photo, followed by the windows that were rejected before estimation."""
        with self._db.reading() as session:
            rows = list(session.scalars(_of_photo(photo_id).order_by(PatchRow.idx)))
            stored = session.scalar(select(PhotoRow.windows).where(PhotoRow.public_id == photo_id))
        return rows + _unpacked(stored)

    def cells(self, photo_id: str, epoch: int) -> list[int]:
        """Return the numbers of the cells that still have patches to estimate."""
        query = _of_photo(photo_id, epoch).where(PatchRow.state.in_(OPEN))
        with self._db.reading() as session:
            cells = session.scalars(query.with_only_columns(PatchRow.cell).distinct())
            return sorted(cell for cell in cells if cell is not None)

    def of_cell(self, photo_id: str, epoch: int, cell: int) -> list[PatchRow]:
        """Return the patches of one cell that are still to be estimated."""
        query = _of_photo(photo_id, epoch).where(PatchRow.state.in_(OPEN), PatchRow.cell == cell)
        with self._db.reading() as session:
            return list(session.scalars(query.order_by(PatchRow.idx)))

    def begin_cell(self, photo_id: str, epoch: int, cell: int) -> list[PatchRow]:
        """Take up the open patches of one cell; empty if there are none or the photo needs them no more.

        The attempt is counted before it is made; giving up a patch that kills its workers is the job
        engine's part.
        """
        query = (
            select(PatchRow)
            .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
            .where(
                PhotoRow.public_id == photo_id,
                PhotoRow.epoch == epoch,
                PhotoRow.state == "estimating",
                PatchRow.epoch == epoch,
                PatchRow.cell == cell,
                PatchRow.state.in_(("pending", "running")),
            )
            .order_by(PatchRow.idx)
        )
        with self._db.writing() as session:
            rows = list(session.scalars(query))
            for row in rows:
                row.state = "running"
                row.attempts += 1
            return rows

    def finish(self, photo_id: str, epoch: int, samples: Sequence[NewSample]) -> int:
        """Store the samples of some patches and mark these done; return how many samples were new.

        Nothing happens if the photo was cancelled, deleted or started anew meanwhile. A repeated
        call stores nothing twice: patch and channel are a unique key.
        """
        with self._db.writing() as session:
            photo = _live(session, photo_id, epoch)
            if photo is None:
                return 0
            numbers = {sample.idx for sample in samples}
            of_numbers = session.scalars(
                select(PatchRow).where(
                    PatchRow.photo_id == photo.id, PatchRow.epoch == epoch, PatchRow.idx.in_(numbers)
                )
            )
            patches = {patch.idx: patch for patch in of_numbers}
            rows = [
                columns_of(new.sample, photo, patches[new.idx], new.diagnostics)
                for new in samples
                if new.idx in patches
            ]
            stored = insert_new(session, SampleRow, rows)
            for patch in patches.values():
                patch.state, patch.finished_at = "done", patch.finished_at or now()
            session.flush()
            recount_patches(session, photo)
            return stored

    def fail(
        self, photo_id: str, epoch: int, indices: Sequence[int], reason: str, *, rejected: bool = False
    ) -> None:
        """Mark patches as useless: `rejected` for their quality, else failed."""
        with self._db.writing() as session:
            photo = _live(session, photo_id, epoch)
            if photo is None:
                return
            session.execute(
                update(PatchRow)
                .where(
                    PatchRow.photo_id == photo.id,
                    PatchRow.epoch == epoch,
                    PatchRow.idx.in_(indices),
                    PatchRow.state != "done",
                )
                .values(state="rejected" if rejected else "failed", reason=reason[:60], finished_at=now())
            )
            recount_patches(session, photo)

    def take_in(self, file: PhotoRow, samples: Sequence[PsfSample], names: Mapping[str, str]) -> int | None:
        """Let the samples of a profile join its lens; return the number of their photos.

        None where the lens is gone, or the reading of `file` was cancelled or begun anew. Each photo of the
        profile becomes a counted photo without a file, which can be excluded or deleted as any other. What
        was imported before is not imported again.
        """
        groups: defaultdict[tuple[str, LensSettings], list[PsfSample]] = defaultdict(list)
        for sample in samples:
            groups[sample.photo, sample.settings.with_channel("g")].append(sample)
        with self._db.writing(durable=True) as session:
            lens = find_to_change(session, LensRow, file.given["lens_id"], ANY_OWNER)
            ended = {"finished_at": now(), "file_gone_at": now()}
            if lens is None or not change_state(
                session, file.public_id, ("inspecting",), "stored", epoch=file.epoch, **ended
            ):
                return None
            insert_new(session, GarbageRow, [{"prefix": file.blob_key, "not_before": now() + LATE}])
            imported = 0
            for (photo, settings), of_photo in groups.items():
                name = names.get(photo, photo or PROFILE)
                row = _imported(session, lens, photo, settings, of_photo[0], name)
                if row is None:
                    continue
                _estimated(session, row, of_photo)
                join(session, row, "photo_added")
                imported += 1
            return imported


class SampleStore:
    """The samples that count."""

    def __init__(self, database: Database) -> None:
        self._db = database

    def state_of(self, lens_id: str) -> LensState | None:
        """Return the version of a lens by one read through its key; None if there is no such lens."""
        with self._db.reader.connect() as connection:
            row = connection.execute(_STATE, {"lens": lens_id}).one_or_none()
            return None if row is None else LensState(row[0], row[1], row[2])

    def known_of(self, lens_id: str, owner: str) -> LensState | None:
        """Return `state_of` a lens of an owner by one read; None if the owner has no such lens."""
        if not is_id(lens_id):
            return None
        with (
            self._db.reader.connect() as connection
        ):  # no session, which costs time: part of every request that a cached model answers
            row = connection.execute(_KNOWN, {"lens": lens_id, "owner": owner}).one_or_none()
            return None if row is None else LensState(row[0], row[1], row[2])

    def of_lens(
        self, lens_id: str, *, after_version: int = 0, up_to_version: int | None = None
    ) -> tuple[LensState, list[StoredSample]]:
        """Return the state of a lens and its samples that joined after a version.

        Both are of one moment. Versions grow under the lens's row lock, so no sample of a
        version that was seen can turn up later.
        """
        query = (
            select(SampleRow.id, SampleRow.version_added, *COLUMNS)
            .join(PhotoRow, PhotoRow.id == SampleRow.photo_id)
            .join(PatchRow, PatchRow.id == SampleRow.patch_id)
            .join(LensRow, LensRow.id == SampleRow.lens_id)
            .where(LensRow.public_id == lens_id, SampleRow.version_added > after_version)
            .order_by(SampleRow.version_added, SampleRow.id)
        )
        if up_to_version is not None:
            query = query.where(SampleRow.version_added <= up_to_version)
        with self._db.reading() as session:
            state = session.execute(
                select(LensRow.version, LensRow.rebuild_epoch, LensRow.way).where(
                    LensRow.public_id == lens_id
                )
            ).one_or_none()
            if state is None:
                return LensState(0, 0), []
            stored = [
                StoredSample(row.id, row.version_added, sample_in(row)) for row in session.execute(query)
            ]
            return LensState(state[0], state[1], state[2]), stored


def _of_photo(photo_id: str, epoch: int | None = None) -> Select[PatchRow]:
    return (
        select(PatchRow)
        .join(PhotoRow, PhotoRow.id == PatchRow.photo_id)
        .where(PhotoRow.public_id == photo_id, PatchRow.epoch == (epoch or PhotoRow.epoch))
    )


def _live(session: Session, photo_id: str, epoch: int) -> PhotoRow | None:
    return session.scalar(
        select(PhotoRow)
        .where(
            PhotoRow.public_id == photo_id,
            PhotoRow.epoch == epoch,
            PhotoRow.state.in_(("selecting", "estimating")),
            PhotoRow.deleted_at.is_(None),
        )
        .with_for_update()  # PostgreSQL: a cancel waits until this transaction is through, and the other way
    )


def recount_patches(session: Session, photo: PhotoRow) -> int:
    """Count the patches anew: recomputed, never incremented, so that a repeat cannot count twice."""
    rows = session.execute(
        select(PatchRow.state, func.count())
        .where(PatchRow.photo_id == photo.id, PatchRow.epoch == photo.epoch)
        .group_by(PatchRow.state)
    )
    counts = {row[0]: row[1] for row in rows}
    rejected = counts.get("rejected", 0)
    photo.patches_rejected = rejected + photo.windows_rejected
    photo.patches_done = counts.get("done", 0) + counts.get("failed", 0)
    photo.patches_total = sum(counts.values()) - rejected
    return photo.patches_total


def _packed(rejected: Sequence[NewPatch]) -> dict[str, Any]:
    """Return windows as one value that JSON can hold; each reason is stored once."""
    reasons = sorted({patch.rejected or "" for patch in rejected})
    numbers = {reason: number for number, reason in enumerate(reasons)}
    listed = [
        [
            *(patch.idx, patch.row, patch.col, patch.size),
            *(round(patch.r, DIGITS), round(patch.phi, DIGITS), numbers[patch.rejected or ""]),
        ]
        for patch in rejected
    ]
    return {"reasons": reasons, "windows": listed}


def _unpacked(stored: dict[str, Any] | None) -> list[PatchRow]:
    """Return the windows of `_packed` as rows that belong to no table."""
    if stored is None:
        return []
    return [
        PatchRow(
            idx=idx,
            row=row,
            col=col,
            size=size,
            r=r,
            phi=phi,
            state="rejected",
            reason=stored["reasons"][reason],
        )
        for idx, row, col, size, r, phi, reason in stored["windows"]
    ]


def columns_of(
    sample: PsfSample, photo: PhotoRow, patch: PatchRow, diagnostics: Mapping[str, Any]
) -> dict[str, Any]:
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
        **{column.key: entry[name] for name, column in _OWN.items()},
        "dtype": DTYPE,
        "format_version": FORMAT_VERSION,
        "crc32": zlib.crc32(blob),
        "psf": blob,
        "diagnostics": dict(diagnostics),
        "created_at": now(),
    }


def sample_in(row: Row[*tuple[Any, ...]]) -> PsfSample:
    """Build the sample of a row of `COLUMNS`."""
    if row.format_version != FORMAT_VERSION:
        raise OutdatedSampleError(
            "the samples of this lens were made by an earlier version of the program: calibrate it again, by "
            "retrying its photos"
        )
    if zlib.crc32(row.psf) != row.crc32:
        raise CorruptSampleError(f"sample {row.id} differs from what was written: restore the database")
    settings = {name: getattr(row, name) for name in _SETTINGS}
    settings["focus_m"] = distances.read(settings["focus_m"])
    entry = {name: getattr(row, name) for name in (*_OWN, *_OF_PHOTO)}
    entry["half_diagonal_px"] = math.hypot(row.width, row.height) / 2 if row.width and row.height else None
    return sample_of(
        {**entry, "settings": settings},
        np.frombuffer(row.psf, dtype=DTYPE).reshape(row.size, row.size),
        None if row.encoded is None else _encoded(row.encoded),
    )


@lru_cache(maxsize=16)
def _encoded(data: bytes) -> EncodedPatch:
    """Decode a patch once for its three channels."""
    return EncodedPatch.from_bytes(data)


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
        "way": lens.way,
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
    done: dict[str, Any] = {"photo_id": photo.id, "epoch": photo.epoch, "state": "done", "attempts": 0}
    box = {"row": 0, "col": 0, "size": 0, "finished_at": now()}  # a profile does not say where in pixels
    insert_new(
        session,
        PatchRow,
        [{**done, **box, "idx": idx, "cell": idx, "r": r, "phi": phi} for (r, phi), idx in places.items()],
    )
    patches = {row.idx: row for row in session.scalars(select(PatchRow).where(PatchRow.photo_id == photo.id))}
    rows = [columns_of(sample, photo, patches[places[_place(sample)]], {}) for sample in samples]
    insert_new(session, SampleRow, rows)
    photo.patches_total = photo.patches_done = len(places)
    session.flush()


def _place(sample: PsfSample) -> tuple[float, float]:
    return sample.position.r, sample.position.phi
