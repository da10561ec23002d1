"""Blobs: photos, results, previews and reports, in a local folder or in an object store.

Keys are made of our own ids only, never of a name that a client sent. A blob appears under its
key only when it is complete.
"""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final
from urllib.parse import unquote, urlsplit

import obstore
from obstore.store import LocalStore, ObjectStore, from_url
from sqlalchemy.exc import OperationalError, ProgrammingError

from app.store.database import new_id

if TYPE_CHECKING:
    from obstore import AsyncWritableFile
    from obstore.store import ClientConfig

# Bytes that are read at once (chosen): large enough that calls cost nothing beside the copying
CHUNK = 1 << 20
# Seconds for one request to an object store (chosen): it moves at most 8 MiB, at 0.4 MiB/s
PATIENCE_S: Final = 20.0
# Seconds to connect (chosen): a store that lives answers in far less, and a request waits for it
CONNECT_S: Final = 5.0
# A file in each folder of blobs: the empty mount point of a missing disk has none
MARK: Final = "lensmodel-blobs"


def _client_options(patience_s: float) -> ClientConfig:
    """Return the deadlines and the AWS_... options of the environment, which these options would override."""
    options: ClientConfig = {
        "connect_timeout": f"{min(CONNECT_S, patience_s):g}s",
        "timeout": f"{patience_s:g}s",
    }
    for name in ("allow_http", "allow_invalid_certificates", "proxy_url"):
        if value := os.environ.get(f"AWS_{name.upper()}"):
            options[name] = value if name == "proxy_url" else value.lower() in {"1", "true", "yes", "on"}  # type: ignore[literal-required, unused-ignore]
    return options


class Storage:
    """All blobs of the service."""

    def __init__(self, url: str, *, patience_s: float = PATIENCE_S, create: bool = True) -> None:
        parts = urlsplit(url)
        self.folder = Path(unquote(parts.path)) if parts.scheme == "file" else None
        if self.folder is None:
            self._bucket: ObjectStore = from_url(
                url,
                client_options=_client_options(patience_s),
                retry_config={"max_retries": 1, "retry_timeout": timedelta(seconds=patience_s)},
            )
        elif create:
            self.create()

    def create(self) -> None:
        """Create the folder with its mark; an object store is created by its owner."""
        if self.folder is not None:
            self.folder.mkdir(parents=True, exist_ok=True)
            (self.folder / MARK).write_text("Without this file the folder counts as not mounted.\n")

    def settle(self, is_used: Callable[[], bool]) -> None:
        """Create the folder if no row names a file yet; leave one whose disk is only unmounted as it is."""
        # where the tables are missing or away nothing is decided, and /readyz says so
        with contextlib.suppress(OperationalError, ProgrammingError):
            if self.folder is not None and not self.is_there and not is_used():
                self.create()

    @property
    def is_there(self) -> bool:
        """Whether the folder and its mark exist; always true for an object store, which fails when used."""
        return self.folder is None or (self.folder / MARK).is_file()

    @property
    def _store(self) -> ObjectStore:
        """The blobs."""
        self._require_folder()
        return self._bucket if self.folder is None else LocalStore(prefix=self.folder)

    def _require_folder(self) -> None:
        """Raise OSError if the folder is away; a write meanwhile may have made another in its place."""
        if not self.is_there:
            raise OSError(errno.ENODEV, "the folder of the blobs is away", str(self.folder))

    def _require_bucket(self) -> None:
        """Raise OSError if the bucket is away, which is reported as if a blob were missing."""
        try:
            next(iter(obstore.list(self._store, chunk_size=1)), None)
        except FileNotFoundError as error:
            raise OSError(errno.ENODEV, "the bucket of the blobs is away") from error

    def put(self, key: str, data: bytes | Path) -> None:
        """Store bytes, or a file, under a key, replacing what was there."""
        obstore.put(self._store, key, data)
        self._require_folder()

    @asynccontextmanager
    async def writer(self, key: str) -> AsyncIterator[AsyncWritableFile]:
        """Open a blob for writing; an exception inside leaves nothing behind."""
        async with obstore.open_writer_async(self._store, key, buffer_size=8 * CHUNK) as sink:
            yield sink
        self._require_folder()

    def remove(self, key: str) -> None:
        """Delete one blob; a missing one is no error."""
        with contextlib.suppress(FileNotFoundError):
            obstore.delete(self._store, key)

    def get(self, key: str) -> bytes:
        """Return a whole blob; FileNotFoundError where there is none of that key."""
        return bytes(obstore.get(self._store, key).bytes())

    def size(self, key: str) -> int:
        """Return the bytes of a blob; raises as `get`."""
        return int(obstore.head(self._store, key)["size"])

    def stream(self, key: str, start: int, end: int) -> Iterator[bytes]:
        """Yield the bytes `start` to `end`, the last one excluded, in pieces."""
        for low in range(start, end, 4 * CHUNK):
            yield bytes(obstore.get_range(self._store, key, start=low, end=min(end, low + 4 * CHUNK)))

    @contextmanager
    def as_file(self, key: str, scratch: Path, *, copied: bool = False) -> Iterator[Path]:
        """Provide a blob as a file: itself where it is one, else, or if `copied`, a copy in `scratch`."""
        store = self._store
        if self.folder is not None and not copied:
            path = self.folder / key
            if not path.is_file():
                raise FileNotFoundError(key)
            yield path
            return
        try:
            blob = obstore.get(store, key)
        except FileNotFoundError:
            self._require_bucket()
            raise
        copy = scratch / new_id()
        with copy.open("wb") as out:
            out.writelines(blob.stream(min_chunk_size=CHUNK))
        try:
            yield copy
        finally:
            copy.unlink(missing_ok=True)

    def delete(self, prefix: str) -> None:
        """Delete all blobs below a prefix that ends in a slash; none is no error."""
        if not prefix.endswith("/") or prefix.count("/") < 2:
            raise ValueError(f"refusing to delete everything below {prefix!r}")
        for page in obstore.list(self._store, prefix):
            obstore.delete(self._store, [entry["path"] for entry in page])
        if self.folder is not None:
            shutil.rmtree(self.folder / prefix, ignore_errors=True)  # empty folders and partial files

    def listed(self, prefix: str = "") -> Iterator[tuple[str, int]]:
        """Yield key and size in bytes of each blob below a prefix, or of all, without partial files."""
        for page in obstore.list(self._store, prefix or None):
            for entry in page:
                if entry["path"] != MARK:
                    yield str(entry["path"]), int(entry["size"])

    def check_usable(self) -> None:
        """Raise an error if folder or bucket is away, or a folder cannot take more; nothing is written."""
        if self.folder is None:
            self._require_bucket()
        elif not self.free_bytes():
            raise OSError(errno.ENODEV, "the folder of the blobs is away, or full", str(self.folder))
        elif not os.access(self.folder, os.W_OK):
            raise PermissionError(errno.EACCES, "the folder of the blobs is read-only", str(self.folder))

    def free_bytes(self) -> int | None:
        """Return the free bytes of the disk; None for an object store."""
        if self.folder is None or not self.is_there:
            return None
        return shutil.disk_usage(self.folder).free
