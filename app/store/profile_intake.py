"""Import of a profile: its samples count as if their photos, which the service lacks, had been sent."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session

from app.schemas import distances
from app.store.access.owners import ANY_OWNER, LATE, find_to_change, now
from app.store.database import Database, insert_new
from app.store.ids import new_id
from app.store.photo_steps import change_state
from app.store.sample_rows import columns_of
from app.store.tables import GarbageRow, LensRow, PatchRow, PhotoRow, SampleRow
from app.store.versions import new_version, record_event, take_samples
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import LensSettings

KIND = "profile"


def take_in(
    database: Database, file: PhotoRow, samples: Sequence[PsfSample], names: Mapping[str, str]
) -> int | None:
    """Let the samples of a profile join its lens; return the number of their photos.

    None where the lens is gone, or the reading of `file` was cancelled or begun anew. Each photo of the
    profile becomes a counted photo without a file, which can be excluded or deleted as any other. What was
    imported before is not imported again.
    """
    groups: defaultdict[tuple[str, LensSettings], list[PsfSample]] = defaultdict(list)
    for sample in samples:
        groups[sample.photo, sample.settings.with_channel("g")].append(sample)
    with database.writing(durable=True) as session:
        lens = find_to_change(session, LensRow, file.given["lens_id"], ANY_OWNER)
        ended = {"finished_at": now(), "file_gone_at": now()}
        if lens is None or not change_state(
            session, file.public_id, ("inspecting",), "stored", epoch=file.epoch, **ended
        ):
            return None
        insert_new(session, GarbageRow, [{"prefix": file.blob_key, "not_before": now() + LATE}])
        imported = 0
        for (photo, settings), of_photo in groups.items():
            row = _photo(session, lens, photo, settings, of_photo[0], names.get(photo, photo or "profile"))
            if row is None:
                continue
            _samples(session, row, of_photo)
            version = new_version(session, lens.id)
            added = take_samples(session, row, version)
            record_event(session, lens.id, version, "photo_added", row, samples_added=added)
            imported += 1
        return imported


def _photo(
    session: Session, lens: LensRow, photo: str, settings: LensSettings, first: PsfSample, name: str
) -> PhotoRow | None:
    digest = hashlib.sha256(f"{KIND}|{lens.public_id}|{photo}|{settings}".encode()).hexdigest()
    public_id = new_id()
    fresh: dict[str, Any] = {
        "public_id": public_id,
        "owner_id": lens.owner_id,
        "lens_id": lens.id,
        "sha256": digest,
        "filename": name[:200],
        "kind": KIND,
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


def _samples(session: Session, photo: PhotoRow, samples: Sequence[PsfSample]) -> None:
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
