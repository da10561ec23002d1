"""Examine an installation, running or not: whether its tables are sound and its blobs complete.

Nothing is changed. The checks of the tables also end the tests with random deaths: they hold at every moment,
whichever process dies when.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import func, select, text
from sqlalchemy.orm import Session

from app.blobs.storage import Storage
from app.runtime.settings import Settings
from app.store import Store
from app.store.tables import CorrectionRow, GarbageRow, LensRow, PhotoRow, SampleRow

MOST: Final = 1000  # findings of one check at most (chosen): nobody reads more
# What must hold in the tables, with the query of the public ids of the rows that break it
INVARIANTS: Final[Mapping[str, str]] = {
    "the version of a lens is the number of its events": """
    SELECT public_id FROM lens
    WHERE version <> (SELECT count(*) FROM calibration_event e WHERE e.lens_id = lens.id)
        OR version <> (SELECT coalesce(max(version), 0) FROM calibration_event e WHERE lens_id = lens.id)""",
    "lenses count their samples and photos rightly": """
    SELECT public_id FROM lens LEFT JOIN (
        SELECT lens_id, count(*) AS samples, count(DISTINCT photo_id) AS photos
        FROM psf_sample WHERE lens_id IS NOT NULL GROUP BY lens_id
    ) AS counted ON counted.lens_id = lens.id
    WHERE sample_count <> coalesce(samples, 0) OR photo_count <> coalesce(photos, 0)""",
    "each counted photo joined its lens by an event": """
    SELECT public_id FROM photo WHERE state = 'counted' AND NOT EXISTS (
        SELECT 1 FROM calibration_event e WHERE e.lens_id = photo.lens_id
        AND e.photo_public_id = photo.public_id AND e.kind IN ('photo_added', 'photo_included')
    )""",
    "exactly the samples of counted photos count": """
    SELECT DISTINCT photo.public_id FROM photo
    JOIN psf_sample ON psf_sample.photo_id = photo.id
    JOIN patch ON patch.id = psf_sample.patch_id
    LEFT JOIN lens ON lens.id = psf_sample.lens_id
    WHERE CASE WHEN photo.state = 'counted' AND patch.epoch = photo.epoch
        THEN psf_sample.lens_id IS NULL OR psf_sample.lens_id <> photo.lens_id
            OR psf_sample.version_added IS NULL OR psf_sample.version_added > lens.version
        ELSE psf_sample.lens_id IS NOT NULL END""",
    "patches are done exactly if they have samples": """
    SELECT DISTINCT photo.public_id FROM photo JOIN patch ON patch.photo_id = photo.id
    WHERE (patch.state = 'done') <> EXISTS (
        SELECT 1 FROM psf_sample WHERE psf_sample.patch_id = patch.id
    )""",
    "photos count their patches rightly": """
    SELECT public_id FROM photo LEFT JOIN (
        SELECT photo_id, epoch,
            sum(CASE WHEN state = 'done' THEN 1 ELSE 0 END) AS done,
            sum(CASE WHEN state = 'rejected' THEN 1 ELSE 0 END) AS rejected,
            sum(CASE WHEN state <> 'rejected' THEN 1 ELSE 0 END) AS used
        FROM patch GROUP BY photo_id, epoch
    ) AS counted ON counted.photo_id = photo.id AND counted.epoch = photo.epoch
    WHERE state IN ('estimating', 'counted', 'excluded') AND (
        patches_done <> coalesce(done, 0) OR patches_total <> coalesce(used, 0)
        OR patches_rejected <> coalesce(rejected, 0) + windows_rejected
    )""",
    "counted photos have a lens, failed ones a reason": """
    SELECT public_id FROM photo WHERE (state = 'counted' AND (lens_id IS NULL OR finished_at IS NULL))
        OR (state = 'failed' AND (error_code IS NULL OR finished_at IS NULL))""",
    "photos teach lenses of their owner": """
    SELECT photo.public_id FROM photo JOIN lens ON lens.id = photo.lens_id
    WHERE lens.owner_id <> photo.owner_id""",
    "corrections are of photos of their owner": """
    SELECT correction.public_id FROM correction JOIN photo ON photo.id = correction.photo_id
    WHERE correction.owner_id <> photo.owner_id""",
}


@dataclass(frozen=True, slots=True)
class Violation:
    """One violation of a check."""

    check: str
    subject: str
    says: str
    remedy: str


def examine(settings: Settings, store: Store, storage: Storage, *, deep: bool = False) -> list[Violation]:
    """Return what is wrong; `deep` also reads all kernels and files."""
    findings = [*_tables(store), *_work(settings, store), *_blobs(store, storage, deep=deep)]
    return [*findings, *_kernels(store)] if deep else findings


def broken(session: Session) -> dict[str, list[str]]:
    """Return the invariants that do not hold, each with the public ids of what breaks it."""
    rows = {name: session.scalars(text(f"{query} LIMIT {MOST}")).all() for name, query in INVARIANTS.items()}
    return {name: list(found) for name, found in rows.items() if found}


def _tables(store: Store) -> Iterator[Violation]:
    remedy = "restore the last backup, and report it"
    with store.database.reading() as session:
        if store.database.is_sqlite:  # a database server checks its own pages
            lines = [*session.scalars(text("PRAGMA integrity_check"))]
            lines += [f"{row[0]} row {row[1]}" for row in session.execute(text("PRAGMA foreign_key_check"))]
            for line in lines:
                if line != "ok":
                    yield Violation("database", str(line), "the database is damaged", remedy)
        for name, subjects in broken(session).items():
            yield from (Violation("tables", subject, f"not so: {name}", remedy) for subject in subjects)


def _work(settings: Settings, store: Store) -> Iterator[Violation]:
    waiting = sum(store.jobs.load()[0].values())
    if waiting and not store.jobs.live(settings.lease_seconds):
        says = f"{waiting} jobs are unfinished and no worker is running"
        yield Violation("work", "workers", says, "start lensmodel serve, or lensmodel worker")


def _blobs(store: Store, storage: Storage, *, deep: bool) -> Iterator[Violation]:
    """Compare the stored blobs with the tables, which are read last, since blobs are written first."""
    if not storage.is_there:
        where = str(storage.folder)
        yield Violation("blobs", where, "the folder of the blobs is missing", "mount its disk, or restore it")
        return
    sizes = dict(storage.listed())
    kept = {"corrections": CorrectionRow.public_id, "models": LensRow.public_id}
    digest = func.coalesce(PhotoRow.file_sha256, PhotoRow.sha256)
    photo = select(PhotoRow.public_id, PhotoRow.blob_key, PhotoRow.byte_size, digest)
    result = CorrectionRow.result_key, CorrectionRow.result_bytes, CorrectionRow.result_etag
    named = {
        "photo": photo.where(PhotoRow.file_gone_at.is_(None)),
        "correction": select(CorrectionRow.public_id, *result).where(CorrectionRow.state == "succeeded"),
    }
    with store.database.reading() as session:
        rows: list[Any] = [(what, *row) for what, query in named.items() for row in session.execute(query)]
        known = {f"{place}/{key}/" for place, ids in kept.items() for key in session.scalars(select(ids))}
        known |= {_folder(key) for key in session.scalars(select(PhotoRow.blob_key))}
        garbage = tuple(session.scalars(select(GarbageRow.prefix)))
    for what, public_id, key, size, sha256 in rows:
        there = sizes.get(key)
        if there != size:  # it may have come since
            there = dict(storage.listed(f"{key.rpartition('/')[0]}/")).get(key)
        if there != size:
            problem = "missing" if there is None else f"{there} bytes instead of {size}"
            says = f"the file of the {what} is {problem}"
            yield Violation("blobs", public_id, says, f"restore it, or delete the {what}")
        elif deep:
            with suppress(FileNotFoundError):  # deleted meanwhile
                if _sha256(storage, key, size) != sha256:
                    says = f"the file of the {what} has changed"
                    yield Violation("files", public_id, says, "restore the blobs")
    for prefix in sorted({_folder(key) for key in sizes}):
        if prefix not in known and not prefix.startswith(garbage):
            yield Violation("blobs", prefix, "no row names these blobs", "delete them by hand")


def _folder(key: str) -> str:
    return "/".join([*key.split("/")[:2], ""])


def _sha256(storage: Storage, key: str, size: int) -> str:
    hashed = hashlib.sha256()
    for piece in storage.stream(key, 0, size):
        hashed.update(piece)
    return hashed.hexdigest()


def _kernels(store: Store) -> Iterator[Violation]:
    samples = select(SampleRow.id, SampleRow.psf, SampleRow.crc32).execution_options(yield_per=1000)
    with store.database.reading() as session:
        for key, psf, crc32 in session.execute(samples):
            if zlib.crc32(psf) != crc32:
                says = "differs from what was written"
                yield Violation("kernels", f"sample {key}", says, "restore the database")
