"""What is deleted is gone: lenses with their serials, and the hash of a photo that is no more."""

from __future__ import annotations

from typing import Any

from conftest import Steps
from sqlalchemy import select
from starlette.testclient import TestClient

from app.store import LensName, Store
from app.store.owners import ANY_OWNER
from app.store.tables import EventRow, LensRow, PatchRow, PhotoRow, SampleRow

OWNER = "local"
WHY = ("no_usable_patches", "all is sky")


def rows(store: Store, table: type[Any]) -> list[Any]:
    with store.database.reading() as session:
        return list(session.scalars(select(table)))


def lenses(store: Store) -> list[str]:
    return [lens.public_id for lens in rows(store, LensRow)]


def test_a_deleted_lens_is_gone_and_its_photos_can_be_corrected_with_another(
    client: TestClient, store: Store, steps: Steps
) -> None:
    counted, running, waiting = steps.counted(), steps.planned(), steps.waiting()
    address = f"/v1/lenses/{steps.lens_id(counted)}"

    assert client.delete(address).status_code == 204

    assert client.get(address).status_code == client.get(f"{address}/psf?r=0").status_code == 404
    assert client.delete(address).status_code == 404
    states = [steps.fresh(photo).state for photo in (counted, running, waiting)]
    assert states == ["stored", "cancelled", "needs_lens"]
    for table in (SampleRow, PatchRow, EventRow, LensRow):
        assert rows(store, table) == []


def test_nothing_that_still_ran_brings_a_deleted_lens_back(store: Store, steps: Steps) -> None:
    running = steps.planned()
    store.lenses.delete(steps.lens_id(running), OWNER)

    assert steps.estimate(running) == 0
    assert store.photos.finish(running.public_id, 1) is None
    assert lenses(store) == []


def test_the_same_lens_begins_anew_with_its_next_photo(store: Store, steps: Steps) -> None:
    first = steps.lens(steps.counted())
    store.lenses.delete(first.public_id, OWNER)

    second = steps.lens(steps.counted())

    assert second.public_id != first.public_id
    assert second.id > first.id  # its key is given to no other
    assert second.version == 1


def test_a_lens_goes_with_its_last_photo_and_the_photos_hash_too(store: Store, steps: Steps) -> None:
    one, two = steps.counted(), steps.counted()

    store.photos.delete(one.public_id, OWNER)
    assert len(lenses(store)) == 1
    store.photos.delete(two.public_id, OWNER)

    assert lenses(store) == rows(store, PhotoRow) == []


def test_failed_and_cancelled_photos_leave_no_lens_behind(store: Store, steps: Steps) -> None:
    failed, cancelled = steps.planned(), steps.planned()
    assert len(lenses(store)) == 1

    store.photos.fail(failed.public_id, 1, *WHY)
    store.photos.cancel(cancelled.public_id, OWNER)

    assert lenses(store) == []
    assert store.photos.retry(failed.public_id, OWNER)
    steps.inspect(steps.fresh(failed))
    assert len(lenses(store)) == 1


def test_a_failed_photo_leaves_the_lens_of_others_alone(store: Store, steps: Steps) -> None:
    counted, failed = steps.counted(), steps.receive()
    steps.inspect(failed)

    store.photos.fail(failed.public_id, 1, *WHY)

    assert lenses(store) == [steps.lens_id(counted)]
    assert len(steps.learned(counted)[1]) == 6


def test_a_lens_that_its_owner_named_waits_for_his_next_try(store: Store, steps: Steps) -> None:
    photo = steps.receive()
    store.photos.change([photo.public_id], OWNER, {}, lens=LensName(None, "Old lens", None, label="mine"))
    lens_id = steps.fresh(photo).given["lens_id"]
    again = steps.fresh(photo)
    steps.inspect(again, serial=None)
    store.photos.fail(photo.public_id, again.epoch, *WHY)

    assert lenses(store) == [lens_id]
    assert store.photos.retry(photo.public_id, OWNER)
    assert steps.fresh(photo).given["lens_id"] == lens_id
    store.photos.delete(photo.public_id, OWNER)
    assert lenses(store) == []


def test_corrections_of_a_deleted_lens_that_are_finished_stay(store: Store, steps: Steps) -> None:
    photo = steps.counted()
    lens_id, corrections = steps.lens_id(photo), [steps.correct(photo, strength=s) for s in (1.0, 0.5)]
    store.jobs.set_state(corrections[0].public_id, ("queued",), "succeeded")

    store.lenses.delete(lens_id, OWNER)

    left = [store.jobs.get(row.public_id, ANY_OWNER) for row in corrections]
    assert [row.state for row in left] == ["succeeded", "cancelled"]
    assert {row.lens_public_id for row in left} == {lens_id}
