"""ZIP files that are written while they are sent, and never whole in memory."""

from __future__ import annotations

import zipfile
from collections.abc import Iterable, Iterator


class _Pipe:
    """Buffers what a ZIP file writes until it is fetched."""

    def __init__(self) -> None:
        self._kept = bytearray()

    def write(self, data: bytes) -> int:
        self._kept += data
        return len(data)

    def flush(self) -> None:
        """Do nothing: the buffer is fetched soon."""

    def fetch(self) -> bytes:
        fetched, self._kept = bytes(self._kept), bytearray()
        return fetched


def zipped(files: Iterable[tuple[zipfile.ZipInfo, Iterable[bytes]]]) -> Iterator[bytes]:
    """Yield a ZIP file of files that come in pieces."""
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w") as archive:  # type: ignore[call-overload]  # it only writes
        for entry, pieces in files:
            with archive.open(entry, "w", force_zip64=True) as file:
                for piece in pieces:
                    file.write(piece)
                    yield pipe.fetch()
    yield pipe.fetch()


def packed(name: str) -> zipfile.ZipInfo:
    """Return an entry that is compressed; a plain `ZipInfo` is stored as it is."""
    entry = zipfile.ZipInfo(name)
    entry.compress_type = zipfile.ZIP_DEFLATED
    return entry
