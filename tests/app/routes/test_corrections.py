"""Corrections over HTTP: asked for once, fetched whole or in parts."""

from __future__ import annotations

import hashlib
from datetime import timedelta
from typing import Any

import pytest
from sqlalchemy import update
from starlette.testclient import TestClient
from states import FILE, Steps, finish, refusal, stored

from app.routes.corrections import byte_range
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import ANY_OWNER, now
from app.store.tables import OwnerRow


def post(client: TestClient, **wish: Any) -> Any:
    return client.post("/v1/corrections", json=wish)


@pytest.fixture
def photo(steps: Steps) -> str:
    """A photo whose lens is known by it."""
    return steps.counted().public_id


@pytest.fixture
def finished(client: TestClient, photo: str) -> str:
    correction_id: str = post(client, photo_id=photo).json()["id"]
    finish(client, correction_id, media_type="image/tiff", name="Größe p1-corrected.tif", shown_bytes=77)
    return correction_id


def test_a_correction_is_queued_with_the_newest_version(client: TestClient, steps: Steps, photo: str) -> None:
    newest = steps.counted()

    answer = post(client, photo_id=newest.public_id)

    made = answer.json()
    assert (answer.status_code, made["lens_id"]) == (202, steps.lens_id(newest))
    assert (made["state"], made["lens_version"], made["method"]) == ("queued", 2, "standard")
    itself = f"/v1/corrections/{made['id']}"
    assert answer.headers["location"] == made["links"]["self"] == itself
    job = client.get(made["links"]["job"]).json()
    assert (job["kind"], job["state"], job["links"]["correction"]) == ("correction", "queued", itself)


def test_bounds_and_a_new_photo_of_the_lens_make_other_corrections(
    client: TestClient, steps: Steps, store: Store, photo: str
) -> None:
    bounds: list[dict[str, Any]] = [{}, {"halo": None, "denoise": 0.0}, {"halo": 0.2, "denoise": 0.5}]
    plain, unbound, bound = (post(client, photo_id=photo, **wish).json()["id"] for wish in bounds)
    steps.counted()
    renewed, pinned = (post(client, photo_id=photo, **of).json()["id"] for of in ({}, {"lens_version": 1}))

    assert plain == unbound == pinned
    assert len({plain, bound, renewed}) == 3
    params = [row.params for key in (plain, bound) if (row := store.jobs.get(key, ANY_OWNER))]
    assert [(each.get("halo"), each["denoise"]) for each in params] == [(None, 0.0), (0.2, 0.5)]


def test_a_photo_with_other_settings_is_corrected_anew(client: TestClient, steps: Steps) -> None:
    of, lens_id = stored(steps).public_id, steps.lens_id(steps.counted())
    first = post(client, photo_id=of)  # the lens that was calibrated later
    finish(client, first.json()["id"])

    client.patch(f"/v1/photos/{of}", json={"aperture": 8.0})
    again = post(client, photo_id=of)

    assert first.json()["lens_id"] == again.json()["lens_id"] == lens_id
    assert (again.status_code, again.json()["id"] != first.json()["id"]) == (202, True)
    row = steps.store.jobs.get(again.json()["id"], ANY_OWNER)
    assert row is not None
    assert row.params["settings"]["aperture"] == 8.0


def test_what_cannot_be_corrected_yet_says_why(client: TestClient, steps: Steps) -> None:
    lens_id, unread = steps.lens_id(steps.counted(serial="1")), steps.receive(calibrate=False).public_id
    first, nameless = steps.receive(), stored(steps, serial=None)
    steps.inspect(first)

    for early in (post(client, photo_id=unread), post(client, photo_id=unread, lens_id=lens_id)):
        assert refusal(early) == (409, "not_ready")
        assert "retry-after" in early.headers
    lensless = post(client, photo_id=nameless.public_id)
    assert refusal(lensless) == (422, "metadata_missing")
    assert "lens_id" in lensless.json()["detail"]
    assert refusal(post(client, photo_id=first.public_id)) == (409, "no_samples")
    wish = {"lens_id": lens_id, "photo_id": steps.counted(serial="2").public_id}
    foreign = post(client, **wish)
    assert refusal(foreign) == (409, "other_lens")
    assert "its serial number is 2, that of the lens 1" in foreign.json()["detail"]
    assert post(client, **wish, any_lens=True).status_code == 202


def test_a_preview_belongs_to_its_page_which_deletes_it(client: TestClient, photo: str) -> None:
    wish = {"photo_id": photo, "roi": {"x": 0, "y": 0, "width": 9, "height": 9}}
    left, opened, same = (post(client, **wish, nonce=word).json()["id"] for word in ("1-2", "3-4", "3-4"))

    assert client.delete(f"/v1/corrections/{left}").status_code == 204
    assert client.get(f"/v1/jobs/{opened}").status_code == 200
    assert opened == same


def test_the_result_waits_for_the_work_until_cancelled(client: TestClient, store: Store, photo: str) -> None:
    made = post(client, photo_id=photo).json()
    run = store.jobs.start(made["id"], 1)
    assert run is not None
    store.jobs.progress(run, 3, 8)

    early = client.get(f"/v1/corrections/{made['id']}/result")
    job = client.get(made["links"]["job"]).json()
    cancelled, again = (client.post(f"/v1/jobs/{made['id']}/cancel") for _ in range(2))

    assert refusal(early) == (409, "not_ready")
    assert (job["stage"], job["progress"]) == ("correcting", {"done": 3, "total": 8, "unit": "tiles"})
    assert made["links"]["result"] is job["links"]["result"] is None
    assert (cancelled.json()["state"], again.status_code) == ("cancelled", 409)
    assert client.get(made["links"]["self"]).json()["error"]["code"] == "cancelled"


def test_the_result_is_the_file_made_and_its_parts_join_to_the_whole(
    client: TestClient, finished: str
) -> None:
    address = client.get(f"/v1/corrections/{finished}").json()["links"]["result"]

    def part(span: str, **headers: str) -> Any:
        return client.get(address, headers={"Range": f"bytes={span}", **headers})

    answer, tag = client.get(address), f'"{hashlib.sha256(FILE).hexdigest()}"'
    first, rest = part("0-99"), part("100-", **{"If-Range": tag})
    changed, beyond = part("100-", **{"If-Range": '"other"'}), part("99999-")

    assert (answer.status_code, answer.content) == (200, FILE)
    assert (answer.headers["content-type"], answer.headers["etag"]) == ("image/tiff", tag)
    assert answer.headers["content-length"] == str(len(FILE))
    assert answer.headers["content-disposition"] == (
        "attachment; filename=\"Gr-e-p1-corrected.tif\"; filename*=UTF-8''Gr%C3%B6%C3%9Fe%20p1-corrected.tif"
    )
    assert (first.status_code, first.headers["content-range"]) == (206, f"bytes 0-99/{len(FILE)}")
    assert first.content + rest.content == FILE
    assert (changed.status_code, changed.content) == (200, FILE)
    assert (beyond.status_code, beyond.headers["content-range"]) == (416, f"bytes */{len(FILE)}")


def test_a_range_is_read_as_the_standard_says() -> None:
    parts = {"0-0": (0, 1), "10-19": (10, 20), "990-2000": (990, 1000)}
    parts |= {"-10": (990, 1000), "500-": (500, 1000)}
    whole = ("bytes=-5000", "bytes=20-10", "bytes=0-1,5-6", "bytes=-", "lines=1-2", "bytes=0-" + "9" * 5000)

    assert {span: byte_range(f"bytes={span}", 1000) for span in parts} == parts
    assert {byte_range(header, 1000) for header in (*whole, "nonsense", None)} == {(0, 1000)}


def test_corrections_are_listed_by_photo_and_deleted_with_their_file(
    client: TestClient, finished: str, photo: str, steps: Steps, settings: Settings
) -> None:
    other = post(client, photo_id=steps.counted().public_id).json()["id"]
    assert [c["id"] for c in client.get("/v1/corrections").json()["items"]] == [other, finished]
    assert [c["id"] for c in client.get(f"/v1/corrections?photo_id={photo}").json()["items"]] == [finished]

    deleted = [client.delete(f"/v1/corrections/{finished}").status_code for _ in range(2)]

    assert deleted == [204, 404]
    assert client.get(f"/v1/corrections/{finished}").status_code == 404
    assert not (settings.data_dir / "blobs" / "corrections" / finished).exists()


def test_results_take_quota_and_expire(client: TestClient, finished: str, photo: str, store: Store) -> None:
    taken = client.get("/v1/account").json()["stored_bytes"]
    assert taken == 1000 + len(FILE) + 77  # the photo, its result, and the pictures of that
    with store.database.writing() as session:
        session.execute(update(OwnerRow).values(quota_bytes=taken))
    assert refusal(post(client, photo_id=photo, nonce="again")) == (429, "quota_exceeded")
    assert post(client, photo_id=photo).status_code == 200  # what is finished is there

    assert store.jobs.ended_before(now() - timedelta(days=1)) == []
    assert store.jobs.ended_before(now() + timedelta(days=1)) == [finished]


def test_requests_under_other_words_fill_neither_the_queue_nor_the_table(
    client: TestClient, photo: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    for limit in ("MAX_UNFINISHED", "MAX_PHOTOS"):
        monkeypatch.setattr(f"app.routes.photos.{limit}", 2)
    made = [post(client, photo_id=photo, nonce=word).json()["id"] for word in ("one", "two")]

    busy = post(client, photo_id=photo, nonce="three")
    for correction_id in made:
        assert client.post(f"/v1/jobs/{correction_id}/cancel").status_code == 202
    full = post(client, photo_id=photo, nonce="three")

    assert refusal(busy) == refusal(full) == (429, "quota_exceeded")
    assert "delete some" in full.json()["detail"]
    client.delete(f"/v1/corrections/{made[0]}")
    assert post(client, photo_id=photo, nonce="three").status_code == 202
