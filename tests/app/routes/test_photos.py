"""Photos and their jobs over HTTP: what the owner sees, changes, cancels and deletes."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from typing import Any

import pytest
from starlette.testclient import TestClient

from app.http.dependencies import Call
from app.routes import jobs
from app.runtime.settings import Settings
from app.schemas import JobOut
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.photos import Photos

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
TIFF = b"II*\x00" + bytes(9000)


def get(client: TestClient, path: str) -> dict[str, Any]:
    answer = client.get(path)
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


@pytest.fixture
def after_first_read(monkeypatch: pytest.MonkeyPatch) -> Callable[[Callable[[], object]], None]:
    """Let a change happen when the watching request has read the job once, however busy the machine is."""

    def arrange(change: Callable[[], object]) -> None:
        find, pending = jobs.find_job, [change]

        def find_then_change(call: Call, job_id: str) -> JobOut:
            job = find(call, job_id)
            if pending:
                pending.pop()()
            return job

        monkeypatch.setattr(jobs, "find_job", find_then_change)

    return arrange


def test_a_counted_photo_shows_its_lens_and_patches(client: TestClient, steps: Steps) -> None:
    photo = steps.counted()

    shown = get(client, f"/v1/photos/{photo.public_id}")

    assert shown["state"] == "counted"
    assert shown["patches"] == {"total": 2, "done": 2, "rejected": 1}
    assert shown["lens_id"] == steps.lens_id(photo)
    assert shown["links"]["lens"] == f"/v1/lenses/{shown['lens_id']}"
    assert (shown["width"], shown["focal_length_mm"], shown["pixel_pitch_um"]) == (6000, 24.0, 6.0)
    patches = get(client, f"/v1/photos/{photo.public_id}/patches")["items"]
    assert [patch["state"] for patch in patches] == ["done", "done", "rejected"]
    assert patches[2]["reason"] == "flat"


def test_no_answer_about_a_photo_holds_the_serial(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    steps.inspect(photo, serial="SECRET-77")

    assert "SECRET-77" not in client.get(f"/v1/photos/{photo.public_id}").text
    assert "SECRET-77" not in client.get(f"/v1/jobs/{photo.public_id}").text


def test_photos_are_listed_by_lens_and_state(client: TestClient, steps: Steps) -> None:
    counted, other = steps.counted(serial="1"), steps.counted(serial="2")
    steps.receive()

    by_lens = get(client, f"/v1/photos?lens_id={steps.lens_id(counted)}")["items"]
    by_state = get(client, "/v1/photos?state=counted")["items"]

    assert [photo["id"] for photo in by_lens] == [counted.public_id]
    assert [photo["id"] for photo in by_state] == [other.public_id, counted.public_id]


def test_excluding_a_photo_takes_it_out_of_the_lens_and_back(client: TestClient, steps: Steps) -> None:
    photo = steps.counted()
    lens = f"/v1/lenses/{steps.lens_id(photo)}"

    out = client.patch(f"/v1/photos/{photo.public_id}", json={"excluded": True})
    assert out.json()["state"] == "excluded"
    assert (get(client, lens)["samples"], get(client, lens)["version"]) == (0, 2)

    again = client.patch(f"/v1/photos/{photo.public_id}", json={"excluded": True})
    assert again.status_code == 200
    assert get(client, lens)["version"] == 2

    back = client.patch(f"/v1/photos/{photo.public_id}", json={"excluded": False})
    assert back.json()["state"] == "counted"
    assert (get(client, lens)["samples"], get(client, lens)["version"]) == (6, 3)


def test_a_photo_that_does_not_count_cannot_be_excluded(client: TestClient, steps: Steps) -> None:
    answer = client.patch(f"/v1/photos/{steps.receive().public_id}", json={"excluded": True})

    assert (answer.status_code, answer.json()["code"]) == (409, "conflict")


def test_a_photo_that_was_stored_can_still_teach_its_lens(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.receive(calibrate=False)
    steps.inspect(photo)
    store.photos.set_state(photo.public_id, ("inspecting",), "stored")
    path = f"/v1/photos/{photo.public_id}"

    begun = client.patch(path, json={"calibrate": True, "aperture": 2.8})

    assert (begun.status_code, begun.json()["state"], begun.json()["calibrate"]) == (200, "received", True)
    row = store.photos.get(photo.public_id, ANY_OWNER)
    assert row is not None
    assert row.epoch == photo.epoch + 1
    assert row.given["aperture"] == 2.8
    again = client.patch(path, json={"calibrate": True})  # nothing begins twice
    assert again.status_code == 200
    row = store.photos.get(photo.public_id, ANY_OWNER)
    assert row is not None
    assert row.epoch == photo.epoch + 1
    assert client.patch(path, json={"calibrate": False}).status_code == 422


def test_a_photo_whose_file_is_gone_cannot_teach(client: TestClient, steps: Steps, store: Store) -> None:
    photo = steps.receive(calibrate=False)
    steps.inspect(photo)
    store.photos.set_state(photo.public_id, ("inspecting",), "stored")
    assert store.photos.give_up_file(photo.public_id, ())

    answer = client.patch(f"/v1/photos/{photo.public_id}", json={"calibrate": True})

    assert (answer.status_code, answer.json()["code"]) == (409, "conflict")
    assert "send the same file again" in answer.json()["detail"]
    assert get(client, f"/v1/photos/{photo.public_id}")["calibrate"] is False


def waiting(store: Store, steps: Steps) -> Any:
    photo = steps.receive()
    steps.inspect(photo, serial=None)
    store.photos.set_state(photo.public_id, ("inspecting",), "needs_lens")
    return photo


def test_a_photo_without_a_lens_waits(client: TestClient, steps: Steps, store: Store) -> None:
    photo = waiting(store, steps)

    job = get(client, f"/v1/jobs/{photo.public_id}")

    assert (job["state"], job["error"]["code"]) == ("waiting", "metadata_missing")
    assert get(client, f"/v1/photos/{photo.public_id}")["error"]["code"] == "metadata_missing"


@pytest.mark.parametrize("way", ["lens_id", "lens_serial", "new_lens"])
def test_naming_the_lens_starts_a_waiting_photo_again(
    client: TestClient, steps: Steps, store: Store, way: str
) -> None:
    known = steps.lens_id(steps.counted(serial="123"))
    photo = waiting(store, steps)
    body = {"lens_id": known, "lens_serial": "123", "new_lens": {"label": "the scratched one"}}[way]

    answer = client.patch(f"/v1/photos/{photo.public_id}", json={way: body})

    assert answer.json()["state"] == "received"
    again = steps.fresh(photo)
    assert again.epoch == 2
    steps.inspect(again, serial=None)
    assert (steps.lens_id(photo) == known) == (way != "new_lens")


def test_a_change_happens_wholly_or_not_at_all(client: TestClient, steps: Steps, store: Store) -> None:
    photo = steps.receive()
    store.photos.fail(photo.public_id, 1, "no_usable_patches", "all is sky")
    change = {"aperture": 2.0, "new_lens": {"label": "mine"}, "excluded": True}

    answer = client.patch(f"/v1/photos/{photo.public_id}", json=change)

    assert (answer.status_code, answer.json()["code"]) == (409, "conflict")
    assert get(client, "/v1/lenses")["items"] == []
    assert (steps.fresh(photo).state, steps.fresh(photo).epoch) == ("failed", 1)


def test_a_counted_photo_moves_to_the_lens_that_the_owner_names(client: TestClient, steps: Steps) -> None:
    mine, other = steps.counted(serial="1"), steps.counted(serial="2")

    answer = client.patch(f"/v1/photos/{mine.public_id}", json={"lens_id": steps.lens_id(other)})

    assert answer.json()["lens_id"] == steps.lens_id(other)
    assert get(client, answer.json()["links"]["lens"])["photos"] == 2


def test_a_corrected_aperture_renews_the_lens(client: TestClient, steps: Steps) -> None:
    photo = steps.counted()

    answer = client.patch(f"/v1/photos/{photo.public_id}", json={"aperture": 2.0})

    assert answer.json()["aperture"] == 2.0
    lens = get(client, answer.json()["links"]["lens"])
    assert (lens["version"], lens["apertures"]) == (2, [2.0])


def test_deleting_a_photo_deletes_file_samples_and_job(client: TestClient, settings: Settings) -> None:
    photo = client.post("/v1/photos", content=TIFF).json()

    assert client.delete(f"/v1/photos/{photo['id']}").status_code == 204

    assert client.get(f"/v1/photos/{photo['id']}").status_code == 404
    assert client.get(f"/v1/jobs/{photo['id']}").status_code == 404
    assert client.delete(f"/v1/photos/{photo['id']}").status_code == 404
    assert list((settings.data_dir / "blobs" / "photos").iterdir()) == []
    assert client.post("/v1/photos", content=TIFF).status_code == 202


def test_a_photo_that_is_deleted_while_it_is_sent_is_told_as_it_was_received(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Photos, "get", lambda *_: None)

    answer = client.post("/v1/photos", content=TIFF)

    assert answer.status_code == 202, answer.text
    assert answer.json()["state"] == "received"


def test_a_job_tells_how_far_it_is(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    assert get(client, f"/v1/jobs/{photo.public_id}")["state"] == "queued"
    steps.inspect(photo)
    steps.plan(photo)
    steps.estimate(photo, (0,))

    job = get(client, f"/v1/jobs/{photo.public_id}")

    assert (job["id"], job["kind"], job["state"], job["stage"]) == (
        photo.public_id,
        "photo",
        "running",
        "estimating",
    )
    assert job["progress"] == {"done": 1, "total": 2, "unit": "patches"}
    assert job["eta_seconds"] >= 0
    assert job["links"]["photo"] == f"/v1/photos/{photo.public_id}"


def test_a_failed_job_says_why(client: TestClient, steps: Steps, store: Store) -> None:
    photo = steps.receive()
    store.photos.fail(photo.public_id, 1, "no_usable_patches", "all is sky: photograph something with detail")

    job = get(client, f"/v1/jobs/{photo.public_id}")

    assert job["state"] == "failed"
    assert job["error"]["code"] == "no_usable_patches"
    assert job["error"]["status"] == 422
    assert "detail" in job["error"]["detail"]
    assert job["finished_at"] is not None


def test_a_waiting_request_answers_at_the_change(
    client: TestClient, steps: Steps, store: Store, after_first_read: Callable[[Callable[[], object]], None]
) -> None:
    photo = steps.receive()
    after_first_read(lambda: store.photos.set_state(photo.public_id, ("received",), "inspecting"))
    began = time.monotonic()

    job = get(client, f"/v1/jobs/{photo.public_id}?wait=10")

    assert job["stage"] == "inspecting"
    assert time.monotonic() - began < 8.0  # it did not wait to the end


def test_a_finished_job_does_not_make_anybody_wait(
    client: TestClient, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = steps.counted()
    find, reads = jobs.find_job, list[str]()

    def find_and_note(call: Call, job_id: str) -> JobOut:
        reads.append(job_id)
        return find(call, job_id)

    monkeypatch.setattr(jobs, "find_job", find_and_note)
    monkeypatch.setattr(jobs, "LOOK_S", 60.0)

    assert get(client, f"/v1/jobs/{photo.public_id}?wait=20")["state"] == "succeeded"

    assert reads == [photo.public_id]


def test_cancelling_ends_a_job_once(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()

    first = client.post(f"/v1/jobs/{photo.public_id}/cancel")
    second = client.post(f"/v1/jobs/{photo.public_id}/cancel")

    assert (first.status_code, first.json()["state"]) == (202, "cancelled")
    assert (second.status_code, second.json()["code"]) == (409, "conflict")


def test_events_send_each_state_until_the_end(
    client: TestClient, steps: Steps, store: Store, after_first_read: Callable[[Callable[[], object]], None]
) -> None:
    photo = steps.receive()
    after_first_read(lambda: store.photos.cancel(photo.public_id, ANY_OWNER))

    text = client.get(f"/v1/jobs/{photo.public_id}/events").text

    events = [
        json.loads(line.removeprefix("data: ")) for line in text.splitlines() if line.startswith("data: ")
    ]
    assert [event["state"] for event in events] == ["queued", "cancelled"]
