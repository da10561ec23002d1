"""Corrections over HTTP: asked for once, fetched whole or in parts."""

from __future__ import annotations

import hashlib
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import update
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.routes.corrections import byte_range
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import ANY_OWNER, now
from app.store.tables import OwnerRow

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
FILE = bytes(range(256)) * 40


def post(client: TestClient, **wish: Any) -> Any:
    return client.post("/v1/corrections", json=wish)


def finish(store: Store, settings: Settings, correction_id: str) -> None:
    key = f"corrections/{correction_id}/result"
    Storage(settings.storage).put(key, FILE)
    etag = hashlib.sha256(FILE).hexdigest()
    run = store.jobs.start(correction_id, 1)
    assert run is not None
    result: Any = {
        "key": key,
        "etag": etag,
        "media_type": "image/tiff",
        "bytes": len(FILE),
        "shown_bytes": 77,
        "name": "Größe p1-corrected.tif",
    }
    report = {"zones": {"corner": {"expected_gain_db": 2.0}}}
    assert store.jobs.finish(run, report, **result)


@pytest.fixture
def finished(client: TestClient, steps: Steps, store: Store, settings: Settings) -> str:
    correction_id: str = post(client, photo_id=steps.counted().public_id).json()["id"]
    finish(store, settings, correction_id)
    return correction_id


def test_a_correction_is_queued_with_the_newest_version(client: TestClient, steps: Steps) -> None:
    steps.counted()
    photo = steps.counted()

    answer = post(client, photo_id=photo.public_id)

    assert answer.status_code == 202
    made = answer.json()
    assert (made["state"], made["lens_version"], made["method"]) == ("queued", 2, "standard")
    assert made["lens_id"] == steps.lens_id(photo)
    assert answer.headers["location"] == made["links"]["self"] == f"/v1/corrections/{made['id']}"
    job = client.get(made["links"]["job"]).json()
    assert (job["kind"], job["state"], job["links"]["correction"]) == (
        "correction",
        "queued",
        made["links"]["self"],
    )


def test_the_same_wish_is_the_same_correction(
    client: TestClient, steps: Steps, store: Store, settings: Settings
) -> None:
    photo = steps.counted()
    first = post(client, photo_id=photo.public_id, strength=0.5)
    again = post(client, photo_id=photo.public_id, strength=0.5)
    assert (again.status_code, again.json()["id"]) == (202, first.json()["id"])

    finish(store, settings, first.json()["id"])

    third = post(client, photo_id=photo.public_id, strength=0.5)
    assert (third.status_code, third.json()["id"]) == (200, first.json()["id"])
    assert third.json()["report"] == {"zones": {"corner": {"expected_gain_db": 2.0}}}
    other = post(client, photo_id=photo.public_id, strength=0.6)
    assert other.json()["id"] != first.json()["id"]


def test_bounds_make_another_correction(client: TestClient, steps: Steps, store: Store) -> None:
    photo = steps.counted()
    plain = post(client, photo_id=photo.public_id).json()["id"]
    unbound = post(client, photo_id=photo.public_id, halo=None, denoise=0.0).json()["id"]
    bound = post(client, photo_id=photo.public_id, halo=0.2, denoise=0.5).json()["id"]

    assert unbound == plain != bound
    rows = [store.jobs.get(key, ANY_OWNER) for key in (plain, bound)]
    assert [[row.params.get(name) for name in ("halo", "denoise")] for row in rows if row] == [
        [None, 0.0],
        [0.2, 0.5],
    ]


def test_a_new_photo_of_the_lens_makes_another_correction(client: TestClient, steps: Steps) -> None:
    photo = steps.counted()
    first = post(client, photo_id=photo.public_id).json()
    steps.counted()

    assert post(client, photo_id=photo.public_id).json()["id"] != first["id"]
    assert post(client, photo_id=photo.public_id, lens_version=1).json()["id"] == first["id"]


def test_a_stored_photo_finds_the_lens_that_was_calibrated_later(client: TestClient, steps: Steps) -> None:
    photo = steps.receive(calibrate=False)
    steps.inspect(photo)
    lens_id = steps.lens_id(steps.counted())

    answer = post(client, photo_id=photo.public_id)

    assert (answer.status_code, answer.json()["lens_id"]) == (202, lens_id)


def test_a_photo_not_yet_read_asks_for_patience(client: TestClient, steps: Steps) -> None:
    lens_id = steps.lens_id(steps.counted())
    photo = steps.receive(calibrate=False)

    without = post(client, photo_id=photo.public_id)
    named = post(client, photo_id=photo.public_id, lens_id=lens_id)

    for answer in (without, named):
        assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")
        assert "retry-after" in answer.headers


def test_a_photo_with_other_settings_is_corrected_anew(
    client: TestClient, steps: Steps, store: Store, settings: Settings
) -> None:
    lens_id = steps.lens_id(steps.counted())
    photo = steps.receive(calibrate=False)
    steps.inspect(photo)
    store.photos.set_state(photo.public_id, ("inspecting",), "stored")
    first = post(client, photo_id=photo.public_id, lens_id=lens_id).json()["id"]
    finish(store, settings, first)

    client.patch(f"/v1/photos/{photo.public_id}", json={"aperture": 8.0})
    again = post(client, photo_id=photo.public_id, lens_id=lens_id)

    assert (again.status_code, again.json()["id"] != first) == (202, True)
    row = store.jobs.get(again.json()["id"], ANY_OWNER)
    assert row is not None
    assert row.params["settings"]["aperture"] == 8.0


def test_a_photo_of_another_lens_is_refused_until_its_owner_insists(client: TestClient, steps: Steps) -> None:
    lens_id, photo = steps.lens_id(steps.counted(serial="1")), steps.counted(serial="2")

    refused = post(client, photo_id=photo.public_id, lens_id=lens_id)

    assert (refused.status_code, refused.json()["code"]) == (409, "other_lens")
    assert "its serial number is 2, that of the lens 1" in refused.json()["detail"]
    assert post(client, photo_id=photo.public_id, lens_id=lens_id, any_lens=True).status_code == 202


def test_a_preview_is_its_pages_own_which_deletes_it_while_another_asks(
    client: TestClient, steps: Steps
) -> None:
    wish = {"photo_id": steps.counted().public_id, "roi": {"x": 0, "y": 0, "width": 9, "height": 9}}
    left, opened, same = (post(client, **wish, nonce=word).json()["id"] for word in ("1-2", "3-4", "3-4"))

    assert client.delete(f"/v1/corrections/{left}").status_code == 204
    assert client.get(f"/v1/jobs/{opened}").status_code == 200
    assert opened == same


def test_a_photo_without_a_lens_must_be_told_one(client: TestClient, steps: Steps) -> None:
    photo = steps.receive(calibrate=False)
    steps.inspect(photo, serial=None)

    answer = post(client, photo_id=photo.public_id)

    assert (answer.status_code, answer.json()["code"]) == (422, "metadata_missing")
    assert "lens_id" in answer.json()["detail"]


def test_a_lens_without_samples_cannot_correct(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    steps.inspect(photo)

    answer = post(client, photo_id=photo.public_id)

    assert (answer.status_code, answer.json()["code"]) == (409, "no_samples")


def test_the_result_waits_for_the_work(client: TestClient, steps: Steps, store: Store) -> None:
    made = post(client, photo_id=steps.counted().public_id).json()
    run = store.jobs.start(made["id"], 1)
    assert run is not None
    store.jobs.progress(run, 3, 8)

    early = client.get(f"/v1/corrections/{made['id']}/result")
    job = client.get(made["links"]["job"]).json()

    assert (early.status_code, early.json()["code"]) == (409, "not_ready")
    assert made["links"]["result"] is None
    assert (job["stage"], job["progress"]) == ("correcting", {"done": 3, "total": 8, "unit": "tiles"})
    assert job["links"]["result"] is None


def test_a_failed_correction_says_why_and_can_be_asked_for_again(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.counted()
    made = post(client, photo_id=photo.public_id).json()
    store.jobs.fail(made["id"], 1, "memory_limit", "needs 9 GiB, may have 4: correct a region")

    shown = client.get(made["links"]["self"]).json()

    assert (shown["state"], shown["error"]["code"]) == ("failed", "memory_limit")
    assert client.get(f"/v1/corrections/{made['id']}/result").status_code == 409
    assert post(client, photo_id=photo.public_id).json()["id"] != made["id"]


def test_the_result_is_the_file_that_was_made(client: TestClient, finished: str) -> None:
    shown = client.get(f"/v1/corrections/{finished}").json()

    answer = client.get(shown["links"]["result"])

    assert answer.status_code == 200
    assert answer.content == FILE
    assert answer.headers["content-type"] == "image/tiff"
    assert answer.headers["etag"] == f'"{hashlib.sha256(FILE).hexdigest()}"'
    assert answer.headers["content-length"] == str(len(FILE))
    assert answer.headers["content-disposition"] == (
        "attachment; filename=\"Gr-e-p1-corrected.tif\"; filename*=UTF-8''Gr%C3%B6%C3%9Fe%20p1-corrected.tif"
    )


def test_parts_of_the_result_join_to_the_whole(client: TestClient, finished: str) -> None:
    path = f"/v1/corrections/{finished}/result"

    first = client.get(path, headers={"Range": "bytes=0-99"})
    rest = client.get(path, headers={"Range": "bytes=100-", "If-Range": first.headers["etag"]})
    changed = client.get(path, headers={"Range": "bytes=100-", "If-Range": '"other"'})

    assert (first.status_code, first.headers["content-range"]) == (206, f"bytes 0-99/{len(FILE)}")
    assert first.content + rest.content == FILE
    assert (changed.status_code, changed.content) == (200, FILE)


def test_a_range_beyond_the_end_is_not_satisfiable(client: TestClient, finished: str) -> None:
    answer = client.get(f"/v1/corrections/{finished}/result", headers={"Range": "bytes=99999-"})

    assert answer.status_code == 416
    assert answer.headers["content-range"] == f"bytes */{len(FILE)}"


@pytest.mark.parametrize(
    ("header", "part"),
    [
        (None, (0, 1000)),
        ("bytes=0-0", (0, 1)),
        ("bytes=10-19", (10, 20)),
        ("bytes=990-2000", (990, 1000)),
        ("bytes=-10", (990, 1000)),
        ("bytes=-5000", (0, 1000)),
        ("bytes=500-", (500, 1000)),
        ("bytes=20-10", (0, 1000)),
        ("bytes=0-1,5-6", (0, 1000)),
        ("bytes=-", (0, 1000)),
        ("lines=1-2", (0, 1000)),
        ("bytes=0-" + "9" * 5000, (0, 1000)),
        ("nonsense", (0, 1000)),
    ],
)
def test_a_range_is_read_as_the_standard_says(header: str | None, part: tuple[int, int]) -> None:
    assert byte_range(header, 1000) == part


def test_corrections_are_listed_by_photo_and_deleted_with_their_file(
    client: TestClient, finished: str, steps: Steps, settings: Settings
) -> None:
    other = post(client, photo_id=steps.counted().public_id).json()
    photo_id = client.get(f"/v1/corrections/{finished}").json()["photo_id"]
    assert [c["id"] for c in client.get("/v1/corrections").json()["items"]] == [other["id"], finished]
    assert [c["id"] for c in client.get(f"/v1/corrections?photo_id={photo_id}").json()["items"]] == [finished]

    assert client.delete(f"/v1/corrections/{finished}").status_code == 204

    assert client.get(f"/v1/corrections/{finished}").status_code == 404
    assert not (settings.data_dir / "blobs" / "corrections" / finished).exists()
    assert client.delete(f"/v1/corrections/{finished}").status_code == 404


def test_a_running_correction_is_cancelled_once(client: TestClient, steps: Steps, store: Store) -> None:
    made = post(client, photo_id=steps.counted().public_id).json()
    store.jobs.start(made["id"], 1)

    assert client.post(f"/v1/jobs/{made['id']}/cancel").json()["state"] == "cancelled"
    assert client.post(f"/v1/jobs/{made['id']}/cancel").status_code == 409
    assert client.get(made["links"]["self"]).json()["error"]["code"] == "cancelled"


def test_results_count_for_the_quota_and_expire(
    client: TestClient, finished: str, steps: Steps, store: Store, settings: Settings
) -> None:
    stored = client.get("/v1/account").json()["stored_bytes"]
    assert stored == 1000 + len(FILE) + 77  # the photo, its result, and the pictures of that
    with store.database.writing() as session:
        session.execute(update(OwnerRow).values(quota_bytes=stored))
    of = client.get(f"/v1/corrections/{finished}").json()["photo_id"]
    refused = post(client, photo_id=of, nonce="again")
    assert (refused.status_code, refused.json()["code"]) == (429, "quota_exceeded")
    assert post(client, photo_id=of).status_code == 200  # what is finished is there

    assert store.jobs.ended_before(now() - timedelta(days=1)) == []
    assert store.jobs.ended_before(now() + timedelta(days=1)) == [finished]
    assert store.jobs.delete(finished, ANY_OWNER) == f"corrections/{finished}/"
    assert client.get(f"/v1/corrections/{finished}").status_code == 404


def test_nobody_has_more_unfinished_corrections_than_unfinished_photos(
    client: TestClient, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_UNFINISHED", 2)
    photo = steps.counted().public_id
    answers = [post(client, photo_id=photo, nonce=word) for word in ("one", "two", "three")]

    assert [answer.status_code for answer in answers] == [202, 202, 429]


def test_requests_that_are_cancelled_and_asked_for_under_other_words_fill_no_table(
    client: TestClient, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_PHOTOS", 2)
    photo = steps.counted().public_id
    for word in ("one", "two"):
        made = post(client, photo_id=photo, nonce=word).json()["id"]
        assert client.post(f"/v1/jobs/{made}/cancel").status_code == 202

    refused = post(client, photo_id=photo, nonce="three")

    assert (refused.status_code, refused.json()["code"]) == (429, "quota_exceeded")
    assert "2 corrections are stored, and 2 are allowed: delete some" in refused.json()["detail"]
    client.delete(f"/v1/corrections/{made}")
    assert post(client, photo_id=photo, nonce="three").status_code == 202


def test_nothing_is_corrected_where_the_disk_is_full(
    client: TestClient, steps: Steps, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = steps.counted().public_id
    storage = client.app.state.services.storage  # type: ignore[attr-defined] # Starlette's own attribute
    monkeypatch.setattr(storage, "free_bytes", lambda: (settings.min_free_mb << 20) - 1)

    answer = post(client, photo_id=photo, nonce="one")

    assert (answer.status_code, answer.json()["code"]) == (507, "quota_exceeded")
