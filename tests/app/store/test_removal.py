"""What is deleted is gone: lenses with their serials, and the hash of a photo that is no more."""

from __future__ import annotations

from typing import Any

from sqlalchemy import select
from starlette.testclient import TestClient

from app.store import LensName, Store
from app.store.tables import EventRow, LensRow, PatchRow, PhotoRow, SampleRow


def rows(store: Store, table: type[Any]) -> list[Any]:
    with store.database.reading() as session:
        return list(session.scalars(select(table)))


def lenses(client: TestClient) -> list[str]:
    return [lens["id"] for lens in client.get("/v1/lenses").json()["items"]]


def test_a_deleted_lens_is_gone_and_its_photos_can_be_corrected_with_another(
    client: TestClient, store: Store, steps: Any
) -> None:
    counted, running, waiting = steps.counted(), steps.receive(), steps.receive()
    lens_id = steps.lens_id(counted)
    steps.inspect(running)
    steps.plan(running)
    steps.inspect(waiting, serial=None)
    store.photos.set_state(waiting.public_id, ("inspecting",), "needs_lens")

    answer = client.delete(f"/v1/lenses/{lens_id}")

    assert answer.status_code == 204
    assert client.get(f"/v1/lenses/{lens_id}").status_code == 404
    assert client.get(f"/v1/lenses/{lens_id}/psf?r=0").status_code == 404
    assert client.delete(f"/v1/lenses/{lens_id}").status_code == 404
    assert lenses(client) == []
    assert [steps.fresh(photo).state for photo in (counted, running, waiting)] == [
        *("stored", "cancelled", "needs_lens")
    ]
    assert rows(store, SampleRow) == rows(store, PatchRow) == rows(store, EventRow) == []
    assert rows(store, LensRow) == []


def test_the_key_of_a_deleted_lens_is_given_to_no_other(client: TestClient, store: Store, steps: Any) -> None:
    first = steps.fresh(steps.counted()).lens_id
    client.delete(f"/v1/lenses/{lenses(client)[0]}")

    second = steps.fresh(steps.counted()).lens_id

    assert second > first


def test_nothing_that_still_ran_brings_a_deleted_lens_back(
    client: TestClient, store: Store, steps: Any
) -> None:
    running = steps.receive()
    steps.inspect(running)
    steps.plan(running)
    client.delete(f"/v1/lenses/{steps.lens_id(running)}")

    stored = steps.estimate(running)

    assert stored == 0
    assert store.photos.finish(running.public_id, 1) is None
    assert lenses(client) == []


def test_the_same_lens_begins_anew_with_its_next_photo(client: TestClient, steps: Any) -> None:
    first = steps.lens_id(steps.counted())
    client.delete(f"/v1/lenses/{first}")

    second = steps.counted()

    assert steps.lens_id(second) != first
    assert client.get(f"/v1/lenses/{steps.lens_id(second)}").json()["version"] == 1


def test_a_lens_goes_with_its_last_photo_and_the_photos_hash_too(
    client: TestClient, store: Store, steps: Any
) -> None:
    one, two = steps.counted(), steps.counted()

    client.delete(f"/v1/photos/{one.public_id}")
    after_one = lenses(client)
    client.delete(f"/v1/photos/{two.public_id}")

    assert len(after_one) == 1
    assert lenses(client) == []
    assert rows(store, LensRow) == rows(store, PhotoRow) == []


def test_a_failed_or_cancelled_photo_leaves_no_lens_behind(
    client: TestClient, store: Store, steps: Any
) -> None:
    failed, cancelled = steps.receive(), steps.receive()
    steps.inspect(failed, serial="F-1")
    steps.inspect(cancelled, serial="C-1")
    assert len(lenses(client)) == 2

    store.photos.fail(failed.public_id, 1, "no_usable_patches", "all is sky")
    store.photos.cancel(cancelled.public_id, "local")

    assert lenses(client) == []
    assert rows(store, LensRow) == []
    assert store.photos.retry(failed.public_id, "local")
    again = steps.fresh(failed)
    steps.inspect(again, serial="F-1")
    assert len(lenses(client)) == 1


def test_a_failed_photo_leaves_the_lens_of_others_alone(client: TestClient, store: Store, steps: Any) -> None:
    counted, failed = steps.counted(), steps.receive()
    steps.inspect(failed)

    store.photos.fail(failed.public_id, 1, "no_usable_patches", "all is sky")

    assert lenses(client) == [steps.lens_id(counted)]
    assert client.get(f"/v1/lenses/{steps.lens_id(counted)}").json()["samples"] == 6


def test_a_lens_that_its_owner_named_waits_for_his_next_try(
    client: TestClient, store: Store, steps: Any
) -> None:
    photo = steps.receive()
    store.photos.change([photo.public_id], "local", {}, lens=LensName(None, "Old lens", None, label="mine"))
    again = steps.fresh(photo)
    steps.inspect(again, serial=None)
    store.photos.fail(photo.public_id, again.epoch, "no_usable_patches", "all is sky")

    assert len(lenses(client)) == 1
    client.delete(f"/v1/photos/{photo.public_id}")
    assert lenses(client) == []


def test_corrections_of_a_deleted_lens_that_are_finished_stay(
    client: TestClient, store: Store, steps: Any
) -> None:
    photo = steps.counted()
    common = {"method": "fast", "strength": 1.0, "output": {"format": "png8"}, "roi": None}
    finished = steps.correct(photo, **common)
    store.jobs.set_state(finished.public_id, ("queued",), "succeeded")
    waiting = steps.correct(photo, **{**common, "strength": 0.5})

    lens_id = steps.lens_id(photo)

    client.delete(f"/v1/lenses/{lens_id}")

    shown = [client.get(f"/v1/corrections/{row.public_id}").json() for row in (finished, waiting)]
    assert [row["state"] for row in shown] == ["succeeded", "cancelled"]
    assert {row["lens_id"] for row in shown} == {lens_id}
