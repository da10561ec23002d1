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
from uploads import receive

from app.blobs.account_data import erase, zipped
from app.store import Store
from app.store.owners import ANY_OWNER, now
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


def count(store: Store, table: type[Any]) -> int:
    with store.database.reading() as session:
        return session.scalar(select(func.count()).select_from(table)) or 0


def storage_of(client: TestClient) -> Any:
    return client.app.state.services.storage  # type: ignore[attr-defined]  # the TestClient knows no type of it


def lines(archive: zipfile.ZipFile, name: str) -> list[dict[str, Any]]:
    return [json.loads(line) for line in archive.read(name).decode().splitlines()]


# --- once -----------------------------------------------------------------------------------------


def test_a_request_that_is_sent_again_makes_nothing_twice(
    client: TestClient, store: Store, steps: Any
) -> None:
    wish = {"photo_id": steps.counted().public_id, "method": "fast"}
    key = {"Idempotency-Key": "any name, which is not needed"}

    photos = [client.post("/v1/photos?filename=a.jpg", content=JPEG, headers=key) for _ in range(2)]
    made = [client.post("/v1/corrections", json=wish, headers=key) for _ in range(2)]

    assert [answer.status_code for answer in (*photos, *made)] == [202, 200, 202, 202]
    assert photos[0].json()["id"] == photos[1].json()["id"]
    assert made[0].json()["id"] == made[1].json()["id"]
    assert (count(store, PhotoRow), count(store, CorrectionRow)) == (2, 1)
    kept = [path.parent.name for path in storage_of(client).folder.glob("photos/*/original")]
    assert kept == [photos[0].json()["id"]]


# --- taking it away -------------------------------------------------------------------------------


def test_the_export_holds_every_row_and_file_of_the_owner_and_nothing_else(
    client: TestClient, store: Store, steps: Any
) -> None:
    photo = steps.counted()
    storage_of(client).put(photo.blob_key, b"mine")
    steps.owner = "other"
    foreign = steps.counted()

    answer = client.get("/v1/account/export")

    assert answer.headers["Content-Type"] == "application/zip"
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.testzip() is None
        assert archive.read(f"originals/{photo.public_id}/{photo.filename}") == b"mine"
        assert [row["public_id"] for row in lines(archive, "photos.jsonl")] == [photo.public_id]
        assert [row["serial"] for row in lines(archive, "lenses.jsonl")] == ["123"]
        samples = lines(archive, "samples.jsonl")
        assert len(samples) == 6
        kernel = np.frombuffer(base64.b64decode(samples[0]["psf"]), dtype="<f4")
        assert kernel.size == samples[0]["entry"]["size"] ** 2
        assert kernel.sum() == pytest.approx(1.0, abs=1e-4)
        assert len(lines(archive, "patches.jsonl")) == 2
        assert [row["kind"] for row in lines(archive, "calibrations.jsonl")] == ["photo_added"]
    assert foreign.public_id.encode() not in answer.content


def test_files_that_are_gone_while_the_export_is_written_are_named(client: TestClient, steps: Any) -> None:
    photo = steps.counted()

    answer = client.get("/v1/account/export")

    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        assert archive.read("missing.txt").decode() == f"originals/{photo.public_id}/{photo.filename}\n"


# --- erasing it -----------------------------------------------------------------------------------


def test_an_archive_of_many_files_takes_time_in_proportion_to_them() -> None:
    def seconds(number: int) -> float:
        began = time.process_time()
        for _ in zipped((zipfile.ZipInfo(f"originals/{k:032x}/p{k}.dng"), [b"any"]) for k in range(number)):
            pass
        return time.process_time() - began

    assert seconds(25_000) < 12 * seconds(5_000)  # five times as many


def test_an_erased_account_leaves_no_row_and_no_file(client: TestClient, store: Store, steps: Any) -> None:
    steps.owner = "other"
    foreign = steps.counted()
    steps.owner = "local"
    photo, gone = steps.counted(), steps.counted()
    storage_of(client).put(photo.blob_key, b"mine")
    store.photos.delete(gone.public_id, "local")
    client.post("/v1/corrections", json={"photo_id": photo.public_id, "method": "fast"})

    answer = client.delete("/v1/account")

    assert answer.status_code == 204
    assert [count(store, t) for t in (OwnerRow, PhotoRow, LensRow, EventRow)] == [1, 1, 1, 1]
    assert [count(store, t) for t in (CorrectionRow, KeyRow)] == [0, 0]
    assert (count(store, PatchRow), count(store, SampleRow)) == (3, 6) or count(store, SampleRow) == 6
    assert store.photos.get(foreign.public_id, "other") is not None
    assert not (storage_of(client).folder / photo.blob_key).exists()
    assert client.get("/v1/photos").json()["items"] == []


def test_an_erasure_that_was_killed_is_carried_through_by_a_worker(
    client: TestClient, store: Store, steps: Any
) -> None:
    photo = steps.counted()
    store.accounts.create_key("local", ["write"])
    key = store.accounts.begin_erasing("local")  # and then the API is killed

    assert not store.accounts.has_valid_key()
    assert store.photos.get(photo.public_id, "local") is None
    assert store.accounts.to_erase() == [key]
    for owner_key in store.accounts.to_erase():
        erase(store.accounts, storage_of(client), owner_key)
    assert store.accounts.to_erase() == []
    assert [count(store, t) for t in (OwnerRow, PhotoRow, LensRow, SampleRow, KeyRow)] == [0] * 5


def test_an_upload_that_outlasts_its_owner_makes_no_new_one(store: Store) -> None:
    with pytest.raises(Exception, match="erased"):
        receive(store, "a1", owner="anna", may_be_new=False)
    assert count(store, OwnerRow) == 0


# --- files of photos ------------------------------------------------------------------------------


def ended(store: Store, photo: PhotoRow, ago: timedelta) -> None:
    with store.database.writing() as session:
        mine = update(PhotoRow).where(PhotoRow.id == photo.id)
        session.execute(mine.values(finished_at=now() - ago))


def test_files_stay_as_long_as_the_setting_says(store: Store, steps: Any) -> None:
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


def test_a_file_that_was_given_up_comes_back_with_the_same_bytes(client: TestClient, store: Store) -> None:
    sent = client.post("/v1/photos?filename=a.jpg", content=JPEG).json()
    store.photos.set_state(sent["id"], ("received",), "counted", finished_at=now())
    with store.database.writing() as session:
        session.execute(update(PhotoRow).values(width=10, height=10))
    before = store.photos.get(sent["id"], ANY_OWNER)
    assert before is not None

    assert store.photos.give_up_file(sent["id"], ("preview.jpg",))
    assert not store.photos.give_up_file(sent["id"], ("preview.jpg",))
    folder = f"photos/{sent['id']}/"
    garbage = set(store.jobs.garbage())
    refused = client.post("/v1/corrections", json={"photo_id": sent["id"]})
    storage_of(client).remove(before.blob_key)
    storage_of(client).remove(before.blob_key)  # again, and nothing happens
    again = client.post("/v1/photos?filename=a.jpg", content=JPEG)
    after = store.photos.get(sent["id"], ANY_OWNER)

    assert {f"{folder}original", f"{folder}preview.jpg"} <= garbage
    assert refused.status_code == 409
    assert "send the same file again" in refused.json()["detail"]
    assert (again.status_code, again.json()["id"]) == (200, sent["id"])
    assert after is not None
    assert after.file_gone_at is None
    assert after.blob_key != before.blob_key  # what deletes the old one cannot delete this
    assert storage_of(client).get(after.blob_key) == JPEG
    assert count(store, PhotoRow) == 1


def test_a_photo_whose_file_is_gone_takes_no_room(client: TestClient, store: Store) -> None:
    sent = client.post("/v1/photos?filename=a.jpg", content=JPEG).json()
    store.photos.set_state(sent["id"], ("received",), "counted", finished_at=now())
    before = client.get("/v1/account").json()["stored_bytes"]
    store.photos.give_up_file(sent["id"], ())

    assert (before, client.get("/v1/account").json()["stored_bytes"]) == (len(JPEG), 0)
    usage = store.accounts.usage("local")
    assert (usage.working_photos, usage.stored_bytes, usage.photos) == (0, 0, 1)


def test_garbage_of_an_erased_owner_is_deleted_once_more_later(store: Store, steps: Any) -> None:
    photo = steps.counted()
    key = store.accounts.begin_erasing("local")
    assert key is not None
    prefixes = store.accounts.erase_some(key)

    assert prefixes == [f"photos/{photo.public_id}/"]
    with store.database.reading() as session:
        assert f"photos/{photo.public_id}/" in set(session.scalars(select(GarbageRow.prefix)))
