"""Back up an installation that may be running, into a folder that is itself the data folder of one.

Blobs are immutable, written before the rows that name them and deleted after these. So the rows of one moment
are taken first, then the blobs that they name; where one was deleted in between, newer rows are taken.
`app.db` is replaced last: the folder is a complete backup at every moment.
"""

from __future__ import annotations

import sqlite3
from contextlib import closing, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Final

from app.blobs.storage import Storage
from app.errors import ServiceError
from app.store.database import Database
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import StepHook, ignore_step

ROWS: Final = "app.db"
BLOBS: Final = "blobs"
# Snapshots until one has all its blobs (chosen): each failure needs a deletion in just these moments
TRIES: Final = 5
# The blobs that cannot be made again: photos, and results of corrections
_NAMED: Final = """
    SELECT blob_key FROM photo WHERE file_gone_at IS NULL
    UNION SELECT result_key FROM correction WHERE state = 'succeeded' AND result_key IS NOT NULL"""


def backup(
    database: Database, storage: Storage, folder: Path, on_step: StepHook = ignore_step
) -> dict[str, int | str]:
    """Bring a backup folder up to date with an installation, which may be running; return what it holds."""
    if not database.is_sqlite:
        raise InvalidInputError(
            "the rows are in a database server: back them up with pg_dump, then the blobs with the tools of "
            "their storage; docs/topics/operating.md says how"
        )
    folder.mkdir(parents=True, exist_ok=True)
    target = Storage(f"file://{(folder / BLOBS).resolve()}")
    part = folder / f"{ROWS}.part"
    missing: list[str] = []
    for _ in range(TRIES):
        made_at = datetime.now(UTC).isoformat()
        photos, named = _rows(database.path, part)
        wanted = sorted(named - dict(target.listed()).keys())
        for done, key in enumerate(wanted, start=1):
            # one that was deleted since: rows taken later do not name it
            with suppress(FileNotFoundError), storage.as_file(key, folder) as file:
                target.put(key, file)
            on_step(done, len(wanted))
        kept = dict(target.listed())
        missing = sorted(named - kept.keys())
        if not missing:
            for log in ("-wal", "-shm"):  # of who looked into the backup before: they belong to the old rows
                (folder / f"{ROWS}{log}").unlink(missing_ok=True)
            part.replace(folder / ROWS)
            for key in kept.keys() - named:
                target.remove(key)
            return {"made_at": made_at, "photos": photos, "blobs": len(named)}
    part.unlink()
    raise ServiceError(f"{len(missing)} blobs are missing, the first is {missing[0]}: run lensmodel doctor")


def _rows(database: Path, part: Path) -> tuple[int, set[str]]:
    """Write the rows of one moment into a file; return how many photos, and which blobs they name."""
    part.unlink(missing_ok=True)
    with closing(sqlite3.connect(database)) as connection:
        connection.execute("VACUUM INTO ?", (str(part),))
    with closing(sqlite3.connect(part)) as copy, copy:
        copy.execute("DELETE FROM worker")  # none of them works on the copy
        named = {str(row[0]) for row in copy.execute(_NAMED)}
        photos = copy.execute("SELECT count(*) FROM photo").fetchone()[0]
    return photos, named
