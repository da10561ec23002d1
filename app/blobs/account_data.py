"""All data of an owner: as one ZIP file, written while it is sent and never whole in memory; and erased."""

from __future__ import annotations

import base64
import io
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
samples.jsonl  `psf`: base64 of little-endian float32, row by row, as many rows as `size` in `entry`.
patches.jsonl  `encoded`: base64 of the format of lensmodel.core.psf.EncodedPatch.
originals/     the photos as they are stored: without the place where they were taken, once they were read.
corrections/   corrected photos.
"""


class _Pipe(io.RawIOBase):
    """Keeps what a ZIP file writes until it is fetched."""

    def __init__(self) -> None:
        super().__init__()
        self._kept = bytearray()  # grows in place: the list at the end comes in pieces, some for each file

    def write(self, data: Any) -> int:  # noqa: ANN401 - bytes of any kind
        self._kept += data
        return len(data)

    def fetch(self) -> bytes:
        fetched, self._kept = bytes(self._kept), bytearray()
        return fetched


def zipped(files: Iterable[tuple[zipfile.ZipInfo, Iterable[bytes]]]) -> Iterator[bytes]:
    """Yield a ZIP file of files that come in pieces."""
    pipe = _Pipe()
    with zipfile.ZipFile(pipe, "w") as archive:
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


def exported(store: Store, storage: Storage, owner: str) -> Iterator[bytes]:
    """Yield the ZIP file of an owner piece by piece."""
    return zipped(_files(store, storage, owner))


def _files(store: Store, storage: Storage, owner: str) -> Iterator[tuple[zipfile.ZipInfo, Iterable[bytes]]]:
    yield packed("README.txt"), [README.encode()]
    rows, missing = store.accounts.rows, list[str]()
    for name, table in TABLES.items():
        yield packed(f"{name}.jsonl"), (_line(row) for row in rows(table, owner))
    kept = [
        *(
            (f"originals/{row['public_id']}/{row['filename']}", row["blob_key"])
            for row in rows(PhotoRow, owner)
            if row["file_gone_at"] is None
        ),
        *(
            (f"corrections/{row['public_id']}/{row['result_name']}", row["result_key"])
            for row in rows(CorrectionRow, owner)
            if row["result_key"] is not None
        ),
    ]
    for name, key in kept:
        try:
            size = storage.size(key)
        except FileNotFoundError:  # deleted meanwhile
            missing.append(name)
        else:
            yield zipfile.ZipInfo(name), storage.stream(key, 0, size)  # photos are compressed already
    if missing:
        yield packed("missing.txt"), ["\n".join([*missing, ""]).encode()]


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
