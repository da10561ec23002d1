"""What an owner takes away, and what is left when he goes; the same request sent twice."""

from __future__ import annotations

import base64
import io
import json
import time
import zipfile
from datetime import timedelta
from typing import Any

import numpy as np
import pytest
from sqlalchemy import func, select, update
from starlette.testclient import TestClient
from states import Steps
from uploads import receive

from app.blobs.account_data import erase, zipped
from app.blobs.storage import Storage
from app.store import Store
from app.store.owners import now
from app.store.tables import (
    CorrectionRow,
    EventRow,
    GarbageRow,
    KeyRow,
    LensRow,
    OwnerRow,
    PatchRow,
    PhotoRow,
    SampleRow,
)

JPEG = b"\xff\xd8\xff" + bytes(200)


def counts(store: Store, *tables: type[Any]) -> list[int]:
    with store.database.reading() as session:
        return [session.scalar(select(func.count()).select_from(table)) or 0 for table in tables]


def send(client: TestClient) -> Any:
    return client.post("/v1/photos?filename=a.jpg", content=JPEG)


# --- once -----------------------------------------------------------------------------------------


def test_a_request_that_is_sent_again_makes_nothing_twice(
    client: TestClient, store: Store, steps: Steps, storage: Storage
) -> None:
    wish = {"photo_id": steps.counted().public_id, "method": "fast"}

    photos = [send(client) for _ in range(2)]
    made = [client.post("/v1/corrections", json=wish) for _ in range(2)]

    assert [answer.status_code for answer in (*photos, *made)] == [202, 200, 202, 202]
    assert made[0].json()["id"] == made[1].json()["id"]
    assert counts(store, PhotoRow, CorrectionRow) == [2, 1]
    kept = [path.parent.name for path in storage.folder.glob("photos/*/original")]
    assert kept == [photos[0].json()["id"]] == [photos[1].json()["id"]]


# --- taking it away -------------------------------------------------------------------------------


def test_the_export_holds_every_row_and_file_of_the_owner_and_nothing_else(
    client: TestClient, steps: Steps, storage: Storage
) -> None:
    photo, gone = steps.counted(), steps.receive()
    storage.put(photo.blob_key, b"mine")
    steps.owner = "other"
    foreign = steps.counted()

    answer = client.get("/v1/account/export")

    assert answer.headers["Content-Type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        files = {name: archive.read(name).decode() for name in archive.namelist()}
    assert files[f"originals/{photo.public_id}/{photo.filename}"] == "mine"
    assert files["missing.txt"] == f"originals/{gone.public_id}/{gone.filename}\n"
    rows = {
        name: [json.loads(line) for line in text.splitlines()]
        for name, text in files.items()
        if "jsonl" in name
    }
    assert [row["public_id"] for row in rows["photos.jsonl"]] == [photo.public_id, gone.public_id]
    assert [row["serial"] for row in rows["lenses.jsonl"]] == ["123"]
    assert [row["kind"] for row in rows["calibrations.jsonl"]] == ["photo_added"]
    assert (len(rows["patches.jsonl"]), len(rows["samples.jsonl"])) == (2, 6)
    sample = rows["samples.jsonl"][0]
    kernel = np.frombuffer(base64.b64decode(sample["psf"]), dtype="<f4")
    assert kernel.size == sample["entry"]["size"] ** 2
    assert kernel.sum() == pytest.approx(1.0, abs=1e-4)
    assert foreign.public_id not in str(files)


# --- erasing it -----------------------------------------------------------------------------------


def test_an_archive_of_many_files_takes_time_in_proportion_to_them() -> None:
    def seconds(number: int) -> float:
        began = time.process_time()
        for _ in zipped((zipfile.ZipInfo(f"originals/{k:032x}/p{k}.dng"), [b"any"]) for k in range(number)):
            pass
        return time.process_time() - began

    assert seconds(25_000) < 12 * seconds(5_000)  # five times as many


def test_an_erased_account_leaves_no_row_and_no_file(
    client: TestClient, store: Store, steps: Steps, storage: Storage
) -> None:
    steps.owner = "other"
    foreign = steps.counted()
    kept = (OwnerRow, PhotoRow, LensRow, EventRow, PatchRow, SampleRow)
    before = counts(store, *kept)
    steps.owner = "local"
    photo, gone = steps.counted(), steps.counted()
    storage.put(photo.blob_key, b"mine")
    store.photos.delete(gone.public_id, "local")
    client.post("/v1/corrections", json={"photo_id": photo.public_id, "method": "fast"})

    assert client.delete("/v1/account").status_code == 204
    assert counts(store, *kept) == before
    assert counts(store, CorrectionRow, KeyRow) == [0, 0]
    assert store.photos.get(foreign.public_id, "other") is not None
    assert not (storage.folder / photo.blob_key).exists()
    assert client.get("/v1/photos").json()["items"] == []


def test_an_erasure_that_was_killed_is_carried_through_by_a_worker(
    store: Store, steps: Steps, storage: Storage
) -> None:
    photo = steps.counted()
    store.accounts.create_key("local", ["write"])
    key = store.accounts.begin_erasing("local")
    assert key is not None
    prefixes = store.accounts.erase_some(key)  # and then the API is killed

    assert not store.accounts.has_valid_key()
    assert store.photos.get(photo.public_id, "local") is None
    assert store.accounts.to_erase() == [key]
    assert prefixes == [photo.folder]
    with store.database.reading() as session:  # it is deleted once more later
        assert photo.folder in set(session.scalars(select(GarbageRow.prefix)))
    erase(store.accounts, storage, key)
    assert store.accounts.to_erase() == []
    assert counts(store, OwnerRow, PhotoRow, LensRow, SampleRow, KeyRow) == [0] * 5


def test_an_upload_that_outlasts_its_owner_makes_no_new_one(store: Store) -> None:
    with pytest.raises(Exception, match="erased"):
        receive(store, "a1", owner="anna", may_be_new=False)
    assert counts(store, OwnerRow) == [0]


# --- files of photos ------------------------------------------------------------------------------


def ended(store: Store, photo: PhotoRow, ago: timedelta) -> None:
    with store.database.writing() as session:
        mine = update(PhotoRow).where(PhotoRow.id == photo.id)
        session.execute(mine.values(finished_at=now() - ago))


def test_files_stay_as_long_as_the_setting_says(store: Store, steps: Steps) -> None:
    counted, running, corrected, stored = steps.counted(), steps.receive(), steps.counted(), steps.receive()
    steps.inspect(running)
    store.photos.set_state(stored.public_id, ("received",), "stored")
    row = steps.correct(corrected, method="fast")
    for photo in (counted, corrected, stored):
        ended(store, photo, timedelta(hours=2))

    assert store.photos.unneeded() == [counted.public_id]  # the others are to be corrected
    store.jobs.cancel(row.public_id, "local")
    ended(store, stored, timedelta(hours=25))
    assert set(store.photos.unneeded()) == {counted.public_id, corrected.public_id, stored.public_id}


def test_a_file_that_was_given_up_takes_no_room_and_comes_back_with_the_same_bytes(
    client: TestClient, store: Store, steps: Steps, storage: Storage
) -> None:
    sent = send(client).json()["id"]
    store.photos.set_state(sent, ("received",), "counted", finished_at=now())
    with store.database.writing() as session:
        session.execute(update(PhotoRow).values(width=10, height=10))
    before = store.photos.get(sent, "local")
    assert before is not None
    room = [client.get("/v1/account").json()["stored_bytes"]]

    assert store.photos.give_up_file(sent, ("preview.jpg",))
    assert not store.photos.give_up_file(sent, ("preview.jpg",))
    garbage, usage = set(store.jobs.garbage()), store.accounts.usage("local")
    room.append(client.get("/v1/account").json()["stored_bytes"])
    refused = client.post("/v1/corrections", json={"photo_id": sent})
    storage.remove(before.blob_key)
    storage.remove(before.blob_key)  # again, and nothing happens
    again = send(client)
    after = steps.fresh(before)

    assert {before.blob_key, f"photos/{sent}/preview.jpg"} <= garbage
    assert (room, usage.working_photos, usage.photos) == ([len(JPEG), 0], 0, 1)
    assert refused.status_code == 409
    assert "send the same file again" in refused.json()["detail"]
    assert (again.status_code, again.json()["id"]) == (200, sent)
    assert after.file_gone_at is None
    assert after.blob_key != before.blob_key  # what deletes the old one cannot delete this
    assert storage.get(after.blob_key) == JPEG
    assert counts(store, PhotoRow) == [1]
