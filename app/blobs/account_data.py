"""All data of an owner: as one ZIP file, written while it is sent and never whole in memory; and erased."""

from __future__ import annotations

import base64
import json
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from datetime import datetime
from typing import Any, Final

from app.blobs.storage import Storage
from app.store import Store
from app.store.accounts import Accounts
from app.store.tables import Base, CorrectionRow, EventRow, KeyRow, LensRow, PatchRow, PhotoRow, SampleRow

TABLES: Final[Mapping[str, type[Base]]] = {
    "lenses": LensRow,
    "photos": PhotoRow,
    "patches": PatchRow,
    "samples": SampleRow,
    "calibrations": EventRow,
    "corrections": CorrectionRow,
    "keys": KeyRow,
}
# Columns that say nothing about the owner, or must not leave the service
INSIDE: Final = frozenset({"owner_id", "key_hash"})
README: Final = """What lensmodel keeps of one owner.

*.jsonl        one JSON object a line, as in the tables; `photo_id`, `lens_id` and `patch_id` name the `id` of
               photos.jsonl, lenses.jsonl and patches.jsonl; `public_id` is the id of the HTTP interface.
samples.jsonl  `psf`: base64 of little-endian float32, size x size, row by row.
patches.jsonl  `encoded`: base64 of the format of lensmodel.core.psf.EncodedPatch.
originals/     the photos as they are stored: without the place where they were taken, once they were read.
corrections/   corrected photos.
"""


class _Pipe:
    """Buffers what a ZIP file writes until it is fetched."""

    def __init__(self) -> None:
        self._pieces: list[bytes] = []

    def write(self, data: bytes) -> int:
        self._pieces.append(bytes(data))
        return len(data)

    def flush(self) -> None:
        """Do nothing: the buffer is fetched soon."""

    def fetch(self) -> bytes:
        joined = b"".join(self._pieces)
        self._pieces.clear()
        return joined


def exported(store: Store, storage: Storage, owner: str) -> Iterator[bytes]:
    """Yield the ZIP file of an owner piece by piece."""
    pipe = _Pipe()
    missing: list[str] = []
    with zipfile.ZipFile(pipe, "w", zipfile.ZIP_DEFLATED) as archive:  # type: ignore[call-overload]  # it only writes
        for name, pieces, method in _files(store, storage, owner, missing):
            with archive.open(_named(name, method), "w", force_zip64=True) as file:
                for piece in pieces:
                    file.write(piece)
                    yield pipe.fetch()
        if missing:
            archive.writestr("missing.txt", "\n".join(missing) + "\n")
    yield pipe.fetch()


def _named(name: str, method: int) -> zipfile.ZipInfo:
    info = zipfile.ZipInfo(name)
    info.compress_type = method
    return info


def _files(
    store: Store, storage: Storage, owner: str, missing: list[str]
) -> Iterator[tuple[str, Iterable[bytes], int]]:
    packed, as_is = zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED  # photos are compressed already
    yield "README.txt", [README.encode()], packed
    for name, table in TABLES.items():
        lines = (_line(row) for row in store.accounts.rows(table, owner))
        yield f"{name}.jsonl", lines, packed
    kept = [
        *(
            (f"originals/{row['public_id']}/{row['filename']}", row["blob_key"])
            for row in store.accounts.rows(PhotoRow, owner)
            if row["file_gone_at"] is None
        ),
        *(
            (f"corrections/{row['public_id']}/{row['result_name']}", row["result_key"])
            for row in store.accounts.rows(CorrectionRow, owner)
            if row["result_key"] is not None
        ),
    ]
    for name, key in kept:
        yield from _blob(storage, name, key, missing, as_is)


def _blob(
    storage: Storage, name: str, key: str, missing: list[str], method: int
) -> Iterator[tuple[str, Iterable[bytes], int]]:
    try:
        size = storage.info(key).size
    except FileNotFoundError:  # deleted meanwhile
        missing.append(name)
        return
    yield name, storage.stream(key, 0, size), method


def _line(row: Mapping[str, Any]) -> bytes:
    shown = {name: _plain(value) for name, value in row.items() if name not in INSIDE}
    return json.dumps(shown, ensure_ascii=False).encode() + b"\n"


def _plain(value: Any) -> Any:  # noqa: ANN401 - a cell of any type
    if isinstance(value, datetime):
        return value.isoformat()
    return base64.b64encode(value).decode("ascii") if isinstance(value, bytes) else value


def erase(accounts: Accounts, storage: Storage, owner_key: int) -> None:
    """Erase what is left of an owner, rows before blobs. If killed, a later call continues."""
    while (prefixes := accounts.erase_some(owner_key)) is not None:
        for prefix in prefixes:
            storage.delete(prefix)
