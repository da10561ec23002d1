"""Examine an installation, running or not: whether its invariants hold and its blobs are complete.

The tables are examined by `app.store.invariants`, the same checks that end the tests with random
deaths. Here the blobs are compared with the tables.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Final

from sqlalchemy import func, select, text

from app.blobs.storage import Storage
from app.runtime.settings import Settings
from app.store import Store
from app.store.invariants import INVARIANTS
from app.store.tables import CorrectionRow, GarbageRow, LensRow, PhotoRow, SampleRow

_WITH_FILE: Final = (PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None))


@dataclass(frozen=True, slots=True)
class Violation:
    """One violation of a check."""

    check: str
    subject: str
    says: str
    remedy: str


@dataclass(frozen=True, slots=True)
class DoctorReport:
    """The checks that ran, and their findings."""

    checks: tuple[str, ...]
    findings: tuple[Violation, ...]


def examine(settings: Settings, store: Store, storage: Storage, *, deep: bool = False) -> DoctorReport:
    """Run all checks."""
    checks = ["database", *(invariant.name for invariant in INVARIANTS), "work", "blobs"]
    findings = [*_tables(store), *_work(settings, store), *_blobs(store, storage)]
    if deep:
        checks += ["kernels", "photos"]
        findings += [*_kernels(store), *_photos(store, storage)]
    return DoctorReport(tuple(checks), tuple(findings))


def _tables(store: Store) -> Iterator[Violation]:
    remedy = "restore the last backup, and report it"
    with store.database.reading() as session:
        if store.database.is_sqlite:  # a database server checks its own pages
            lines = [*session.scalars(text("PRAGMA integrity_check"))]
            lines += [f"{row[0]} row {row[1]}" for row in session.execute(text("PRAGMA foreign_key_check"))]
            for line in lines:
                if line != "ok":
                    yield Violation("database", str(line), "the database is damaged", remedy)
        for invariant in INVARIANTS:
            for subject in invariant.find(session):
                yield Violation(invariant.name, subject, f"not so: {invariant.sentence}", remedy)


def _work(settings: Settings, store: Store) -> Iterator[Violation]:
    waiting = sum(store.jobs.load()[0].values())
    if waiting and not store.jobs.live(settings.lease_seconds):
        says = f"{waiting} jobs are unfinished and no worker is running"
        yield Violation("work", "workers", says, "start lensmodel serve, or lensmodel worker")


def _blobs(store: Store, storage: Storage) -> Iterator[Violation]:
    """Compare the stored blobs with the tables, which are read last, since blobs are written first."""
    if not storage.is_there:
        where = str(storage.folder)
        yield Violation("blobs", where, "the folder of the blobs is missing", "mount its disk, or restore it")
        return
    sizes = dict(storage.listed())
    with store.database.reading() as session:
        photos = session.execute(
            select(PhotoRow.public_id, PhotoRow.blob_key, PhotoRow.byte_size).where(*_WITH_FILE)
        ).all()
        results = session.execute(
            select(CorrectionRow.public_id, CorrectionRow.result_key, CorrectionRow.result_bytes).where(
                CorrectionRow.state == "succeeded"
            )
        ).all()
        alive = select(PhotoRow.public_id).where(PhotoRow.deleted_at.is_(None))
        known = {f"photos/{key}/" for key in session.scalars(alive)}
        known |= {f"corrections/{key}/" for key in session.scalars(select(CorrectionRow.public_id))}
        lens_ids = select(LensRow.public_id).where(LensRow.deleted_at.is_(None))
        known |= {f"models/{key}/" for key in session.scalars(lens_ids)}
        garbage = tuple(session.scalars(select(GarbageRow.prefix)))
    newer = dict(storage.listed()) if any(key not in sizes for _, key, _ in photos) else sizes
    for public_id, key, size in photos:
        if newer.get(key) != size:
            problem = "missing" if key not in newer else f"{newer[key]} bytes instead of {size}"
            yield Violation(
                "blobs", public_id, f"the file of the photo is {problem}", "restore it, or delete the photo"
            )
    for correction_id, result, length in results:
        if result is None or sizes.get(result) == length:
            continue
        if dict(storage.listed(f"{result.rpartition('/')[0]}/")).get(result) != length:
            says = "the result of the correction is missing"
            yield Violation("blobs", correction_id, says, "delete the correction, and ask for it again")
    for prefix in sorted({_group(key) for key in sizes}):
        if prefix not in known and not prefix.startswith(garbage):
            yield Violation("blobs", prefix, "no row names these blobs", "delete them by hand")


def _group(key: str) -> str:
    return "/".join([*key.split("/")[:2], ""])


def _kernels(store: Store) -> Iterator[Violation]:
    last = 0
    while True:
        with store.database.reading() as session:
            rows = session.execute(
                select(SampleRow.id, SampleRow.psf, SampleRow.crc32)
                .where(SampleRow.id > last)
                .order_by(SampleRow.id)
                .limit(1000)
            ).all()
        if not rows:
            return
        for key, psf, crc32 in rows:
            if zlib.crc32(psf) != crc32:
                yield Violation(
                    "kernels", f"sample {key}", "differs from what was written", "restore the database"
                )
        last = rows[-1][0]


def _photos(store: Store, storage: Storage) -> Iterator[Violation]:
    with store.database.reading() as session:
        rows = session.execute(
            select(
                PhotoRow.public_id,
                PhotoRow.blob_key,
                func.coalesce(PhotoRow.file_sha256, PhotoRow.sha256),
                PhotoRow.byte_size,
            ).where(*_WITH_FILE)
        ).all()
    for public_id, key, sha256, size in rows:
        digest = hashlib.sha256()
        try:
            for piece in storage.stream(key, 0, size):
                digest.update(piece)
        except FileNotFoundError:
            continue  # a finding of `_blobs`
        if digest.hexdigest() != sha256:
            yield Violation("photos", public_id, "the file differs from what was sent", "restore the blobs")
