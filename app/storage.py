"""Blobs: photos, statistics and results, in a local folder or in an object store.

Keys are made of our own ids only, never of a name that somebody sent. A blob appears under its
key when it is complete, and not before.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractAsyncContextManager, asynccontextmanager, contextmanager
from dataclasses import dataclass
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING, Final, Protocol
from urllib.parse import unquote, urlsplit

import obstore
from obstore.store import LocalStore, ObjectStore, from_url

from app.ids import new_id

if TYPE_CHECKING:
    from obstore.store import ClientConfig

CHUNK = 1 << 20
PATIENCE_S: Final = 20.0
"""One request moves 8 MiB at most: 20 s are 0.4 MiB/s."""

CONNECT_S: Final = 5.0


class AsyncBlobWriter(Protocol):
    """Where the bytes of a blob go, piece by piece."""

    async def write(self, data: bytes) -> object:
        """Take the next piece."""


@dataclass(frozen=True, slots=True)
class BlobInfo:
    """What can be told of a blob without reading it."""

    size: int


def _client_options(patience_s: float) -> ClientConfig:
    """Return the deadlines, and what the environment says besides: options replace those of AWS_... there."""
    options: ClientConfig = {
        "connect_timeout": f"{min(CONNECT_S, patience_s):g}s",
        "timeout": f"{patience_s:g}s",
        "allow_http": _is_on("AWS_ALLOW_HTTP"),
        "allow_invalid_certificates": _is_on("AWS_ALLOW_INVALID_CERTIFICATES"),
    }
    if os.environ.get("AWS_PROXY_URL"):
        options["proxy_url"] = os.environ["AWS_PROXY_URL"]
    return options


def _is_on(name: str) -> bool:
    return os.environ.get(name, "").lower() in {"1", "true", "yes", "on"}


class Storage:
    """All blobs of the service.

    Parameters
    ----------
    url : str
        ``file:///folder``, ``s3://bucket/prefix`` or another address that obstore knows.
    patience_s : float
        How long one request to an object store may take. It is tried once more, quickly; jobs wait for
        longer outages, and callers are told of them.
    """

    def __init__(self, url: str, *, patience_s: float = PATIENCE_S) -> None:
        parts = urlsplit(url)
        self.folder: Path | None = None
        if parts.scheme == "file":
            self.folder = Path(unquote(parts.path))
            self.folder.mkdir(parents=True, exist_ok=True)
            self._store: ObjectStore = LocalStore(prefix=self.folder)
        else:
            self._store = from_url(
                url,
                client_options=_client_options(patience_s),
                retry_config={"max_retries": 1, "retry_timeout": timedelta(seconds=patience_s)},
            )

    def put(self, key: str, data: bytes) -> None:
        """Store bytes under a key, replacing what was there."""
        obstore.put(self._store, key, data)

    def put_file(self, key: str, path: Path) -> None:
        """Store a file under a key, replacing what was there."""
        obstore.put(self._store, key, path)

    @asynccontextmanager
    async def writer(self, key: str) -> AsyncIterator[AsyncBlobWriter]:
        """Open a blob for writing; an exception inside leaves nothing behind."""
        opened: AbstractAsyncContextManager[AsyncBlobWriter] = obstore.open_writer_async(
            self._store, key, buffer_size=8 * CHUNK
        )
        async with opened as sink:
            yield sink

    def get(self, key: str) -> bytes:
        """Return a whole blob.

        Raises
        ------
        FileNotFoundError
            If there is none of that key.
        """
        return bytes(obstore.get(self._store, key).bytes())

    def info(self, key: str) -> BlobInfo:
        """Return what is known of a blob; raises as `get`."""
        return BlobInfo(size=int(obstore.head(self._store, key)["size"]))

    def stream(self, key: str, start: int, end: int) -> Iterator[bytes]:
        """Give the bytes `start` to `end`, the last one excluded, in pieces."""
        for low in range(start, end, 4 * CHUNK):
            yield bytes(obstore.get_range(self._store, key, start=low, end=min(end, low + 4 * CHUNK)))

    @contextmanager
    def as_file(self, key: str, scratch: Path) -> Iterator[Path]:
        """Give a blob as a file to read: itself where it is one, else a copy in `scratch`."""
        if self.folder is not None:
            path = self.folder / key
            if not path.is_file():
                self._check_folder()
                raise FileNotFoundError(key)
            yield path
            return
        copy = scratch / new_id()
        with copy.open("wb") as out:
            for piece in obstore.get(self._store, key).stream(min_chunk_size=CHUNK):
                out.write(piece)
        try:
            yield copy
        finally:
            copy.unlink(missing_ok=True)

    def _check_folder(self) -> None:
        """Tell a folder that is away, such as a disk that is not mounted, from a blob that is gone."""
        if self.folder is not None and not self.folder.is_dir():
            raise OSError(errno.ENODEV, "the folder of the blobs is away", str(self.folder))

    def delete(self, prefix: str) -> None:
        """Delete all blobs below a prefix that ends in a slash; none there is no error."""
        if not prefix.endswith("/") or prefix.count("/") < 2:
            raise ValueError(f"refusing to delete everything below {prefix!r}")
        for page in obstore.list(self._store, prefix):
            obstore.delete(self._store, [entry["path"] for entry in page])
        if self.folder is not None:
            shutil.rmtree(self.folder / prefix, ignore_errors=True)  # the empty folders, and torn writes

    def check_writable(self) -> None:
        """Write and delete a small blob; raises what went wrong."""
        prefix = f"probe/{new_id()}/"
        self.put(f"{prefix}x", b"x")
        self.delete(prefix)

    def free_bytes(self) -> int | None:
        """Return the room left on the disk; None where the store does not say."""
        return None if self.folder is None else shutil.disk_usage(self.folder).free
