"""Examine an installation, running or not: whether its invariants hold and its blobs are complete.

The tables are examined by `app.store.invariants`, the same checks that end the tests with random
deaths. Here the blobs are compared with the tables.
"""

from __future__ import annotations

import hashlib
import zlib
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

from sqlalchemy import func, select, text

from app.blobs.storage import Storage
from app.runtime.settings import Settings
from app.store import Store
from app.store.invariants import INVARIANTS, broken
from app.store.tables import CorrectionRow, GarbageRow, LensRow, PhotoRow, SampleRow

_WITH_FILE: Final = PhotoRow.file_gone_at.is_(None)


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
    checks = ["database", *INVARIANTS, "work", "blobs"]
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
        for name, (sentence, query) in INVARIANTS.items():
            for subject in broken(session, query):
                yield Violation(name, subject, f"not so: {sentence}", remedy)


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
    kept = {
        "photos": select(PhotoRow.public_id),
        "corrections": select(CorrectionRow.public_id),
        "models": select(LensRow.public_id),
    }
    named = {
        "photo": select(PhotoRow.public_id, PhotoRow.blob_key, PhotoRow.byte_size).where(_WITH_FILE),
        "correction": select(
            CorrectionRow.public_id, CorrectionRow.result_key, CorrectionRow.result_bytes
        ).where(CorrectionRow.state == "succeeded", CorrectionRow.result_key.is_not(None)),
    }
    with store.database.reading() as session:
        rows: list[Any] = [(what, *row) for what, query in named.items() for row in session.execute(query)]
        known = {f"{place}/{key}/" for place, query in kept.items() for key in session.scalars(query)}
        garbage = tuple(session.scalars(select(GarbageRow.prefix)))
    for what, public_id, key, size in rows:
        there = sizes.get(key)
        if there != size:  # it may have come since
            there = dict(storage.listed(f"{key.rpartition('/')[0]}/")).get(key)
        if there != size:
            problem = "missing" if there is None else f"{there} bytes instead of {size}"
            says = f"the file of the {what} is {problem}"
            yield Violation("blobs", public_id, says, f"restore it, or delete the {what}")
    for prefix in sorted({"/".join([*key.split("/")[:2], ""]) for key in sizes}):
        if prefix not in known and not prefix.startswith(garbage):
            yield Violation("blobs", prefix, "no row names these blobs", "delete them by hand")


def _kernels(store: Store) -> Iterator[Violation]:
    samples = select(SampleRow.id, SampleRow.psf, SampleRow.crc32).execution_options(yield_per=1000)
    with store.database.reading() as session:
        for key, psf, crc32 in session.execute(samples):
            if zlib.crc32(psf) != crc32:
                says = "differs from what was written"
                yield Violation("kernels", f"sample {key}", says, "restore the database")


def _photos(store: Store, storage: Storage) -> Iterator[Violation]:
    digest = func.coalesce(PhotoRow.file_sha256, PhotoRow.sha256)
    query = select(PhotoRow.public_id, PhotoRow.blob_key, digest, PhotoRow.byte_size).where(_WITH_FILE)
    with store.database.reading() as session:
        rows = session.execute(query).all()
    for public_id, key, sha256, size in rows:
        hashed = hashlib.sha256()
        with suppress(FileNotFoundError):  # a finding of `_blobs`
            for piece in storage.stream(key, 0, size):
                hashed.update(piece)
            if hashed.hexdigest() != sha256:
                yield Violation(
                    "photos", public_id, "the file differs from what was sent", "restore the blobs"
                )
