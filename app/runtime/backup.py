"""Back up a running installation, restore it, and move it.

A backup is a folder: `rows-....db`, a SQLite file with all rows of one moment, whatever database the service
uses; `blobs/`, at least what these rows name; and `backup.json`, which names the first and is replaced last.
So the folder is a complete backup at every moment, also while the next one is being written into it.

Blobs are immutable; they are written before the rows that name them and deleted some time after these. So it
is enough to copy blobs, then the rows, then the new blobs; a blob that was deleted in between is missing
then, and newer rows are taken.
"""

from __future__ import annotations

import hashlib
import json
import shutil
import sqlite3
import tempfile
from collections.abc import Iterable, Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from sqlalchemy import Connection, select

from app.blobs.storage import Storage
from app.store.access import access_tables as _all_tables  # noqa: F401 - a copy holds every table
from app.store.database import Database
from app.store.tables import CorrectionRow, PhotoRow
from app.store.upkeep import migrate, transfer
from lensmodel.core.errors import InvalidInputError, LensModelError
from lensmodel.core.files import atomic
from lensmodel.core.types import StepHook, ignore_step

MANIFEST: Final = "backup.json"
BLOBS: Final = "blobs"
FORMAT: Final = 1
"""Raised when an older program could not read the backup."""

TRIES: Final = 5
"""Snapshots until one has all its blobs (chosen): each failure needs a deletion in just these moments."""

_LEFT_OUT: Final = ("probe/",)


class BackupError(LensModelError):
    """A backup cannot be made, or is damaged."""

    code = "backup_failed"


@dataclass(frozen=True, slots=True)
class Backup:
    """Contents of a backup."""

    made_at: str
    rows: dict[str, int]
    blobs: int
    byte_size: int


def backup(database: Database, storage: Storage, folder: Path, on_step: StepHook = ignore_step) -> Backup:
    """Bring a backup folder up to date with an installation, which may be running."""
    transfer.check_schema(database)
    folder.mkdir(parents=True, exist_ok=True)
    target = Storage(f"file://{(folder / BLOBS).resolve()}")
    have = dict(target.listed())
    _fetch(storage, target, _differing(storage, have), on_step)
    part, missing = folder / "rows.part", list[str]()
    for _ in range(TRIES):
        part.unlink(missing_ok=True)
        moment = datetime.now(UTC)
        rows, named = _rows(database, part)
        stored, have = dict(storage.listed()), dict(target.listed())
        fresh = sorted(key for key in named & stored.keys() if have.get(key) != stored[key])
        _fetch(storage, target, fresh, on_step)
        missing = sorted(named - dict(target.listed()).keys())
        if not missing:
            result = _finish(folder, part, moment, rows, named)
            for key in dict(target.listed()).keys() - named - stored.keys():
                (folder / BLOBS / key).unlink(missing_ok=True)  # deleted in the installation, so deleted here
            return result
    part.unlink(missing_ok=True)
    raise BackupError(f"{len(missing)} blobs are named and missing, {missing[0]} first: run lensmodel doctor")


def _differing(storage: Storage, have: dict[str, int]) -> list[str]:
    return [key for key, size in storage.listed() if have.get(key) != size and not key.startswith(_LEFT_OUT)]


def _fetch(source: Storage, target: Storage, keys: Iterable[str], on_step: StepHook) -> None:
    wanted = list(keys)
    for done, key in enumerate(wanted, start=1):
        try:
            source.copy_to(target, key)
        except FileNotFoundError:  # deleted since: rows taken later do not name it
            continue
        on_step(done, len(wanted))


def _rows(database: Database, part: Path) -> tuple[dict[str, int], set[str]]:
    """Write the rows of one moment into a file; return how many, and which blobs they name."""
    with closing(Database(f"sqlite:///{part.resolve()}")) as copy:
        migrate.upgrade(copy)
        with transfer.snapshot(database) as moment:
            rows = transfer.copy(moment, copy)
        with copy.reader.connect() as connection:
            named = _named(connection)
    with closing(sqlite3.connect(part)) as connection:
        connection.execute("PRAGMA journal_mode=DELETE")  # one file, without a log beside it
    return rows, named


def _named(rows: Connection) -> set[str]:
    """Return the blobs that cannot be made again: photos, and results of corrections."""
    alive = select(PhotoRow.blob_key).where(PhotoRow.deleted_at.is_(None), PhotoRow.file_gone_at.is_(None))
    results = select(CorrectionRow.result_key).where(
        CorrectionRow.state == "succeeded", CorrectionRow.result_key.is_not(None)
    )
    return {str(key) for query in (alive, results) for key in rows.execute(query).scalars()}


def _finish(folder: Path, part: Path, moment: datetime, rows: dict[str, int], named: set[str]) -> Backup:
    with part.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    name = f"rows-{digest[:16]}.db"
    part.replace(folder / name)
    kept = dict(Storage(f"file://{(folder / BLOBS).resolve()}").listed())
    result = Backup(moment.isoformat(), rows, len(named), sum(kept[key] for key in named))
    manifest = {
        "format": FORMAT,
        "program": version("lensmodel"),
        "schema": migrate.head(),
        "rows_file": name,
        "sha256": digest,
        "made_at": result.made_at,
        "rows": rows,
        "blobs": {key: kept[key] for key in sorted(named)},
    }
    with atomic(folder / MANIFEST) as file:
        file.write(json.dumps(manifest, indent=1).encode())
    for path in folder.glob("rows*.db*"):
        if path.name != name:
            path.unlink()
    return result


def restore(
    folder: Path, database: Database, storage: Storage, on_step: StepHook = ignore_step
) -> dict[str, int]:
    """Fill an empty installation from a backup; return how many rows, by table.

    Blobs come first and the rows in one transaction, so an interrupted restore can be repeated.
    """
    manifest = _manifest(folder)
    source = Storage(f"file://{(folder / BLOBS).resolve()}")
    kept = dict(source.listed())
    damaged = [key for key, size in manifest["blobs"].items() if kept.get(key) != size]
    if damaged:
        raise BackupError(f"{len(damaged)} blobs of the backup are missing or cut off: {damaged[0]} first")
    migrate.upgrade(database)
    with _readable(folder / manifest["rows_file"]) as rows:
        transfer.check_schema(rows)
        with database.reader.connect() as connection:
            if any(transfer.counts(connection).values()):
                raise InvalidInputError("the installation is not empty: restore into an empty one")
        storage.create()
        stored = dict(storage.listed())
        _fetch(source, storage, [key for key in sorted(kept) if stored.get(key) != kept[key]], on_step)
        with transfer.snapshot(rows) as moment:
            return transfer.copy(moment, database)


@contextmanager
def _readable(path: Path) -> Iterator[Database]:
    """Open a copy of the rows: opening a database changes its file, and a backup must not change."""
    with tempfile.TemporaryDirectory(prefix="lensmodel-") as scratch:
        copy = Path(shutil.copy(path, scratch))
        with closing(Database(f"sqlite:///{copy}")) as rows:
            yield rows


def _manifest(folder: Path) -> dict[str, Any]:
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_text(encoding="utf-8"))
        with (folder / manifest["rows_file"]).open("rb") as file:
            digest = hashlib.file_digest(file, "sha256").hexdigest()
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise BackupError(f"{folder} holds no whole backup ({type(error).__name__})") from error
    if manifest["format"] != FORMAT:
        raise BackupError(f"the backup has format {manifest['format']}, this program reads {FORMAT}")
    if digest != manifest["sha256"]:
        raise BackupError(f"{manifest['rows_file']} is not what was written: use another backup")
    return manifest


def move(
    source: tuple[Database, Storage], target: tuple[Database, Storage], on_step: StepHook = ignore_step
) -> dict[str, int]:
    """Copy a stopped installation to another database and storage; return how many rows, by table."""
    migrate.upgrade(source[0])
    migrate.upgrade(target[0])
    stored = dict(target[1].listed())
    _fetch(source[1], target[1], _differing(source[1], stored), on_step)
    with transfer.snapshot(source[0]) as moment:
        copied = transfer.copy(moment, target[0])
    with target[0].reader.connect() as connection:
        if transfer.counts(connection) != {name: n for name, n in copied.items() if name != "worker"}:
            raise BackupError("rows were lost under way: use the old installation, and report it")
    return copied
