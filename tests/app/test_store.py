"""The tables keep every promise however often, and in whatever order, steps are repeated."""

from __future__ import annotations

import itertools
import threading
from typing import Any

import numpy as np
import pytest
from sqlalchemy import text

from app.ids import new_id
from app.settings import Settings
from app.store import LensName, NewPatch, NewSample, Store
from app.store.corrections import Result
from app.store.database import Database
from app.store.migrate import current, downgrade, head, is_current, upgrade
from app.tables import Base, PhotoRow
from lensmodel.psf import gaussian

OWNER = "local"
_numbers = itertools.count(1)


def receive(store: Store, *, calibrate: bool = True, **given: Any) -> PhotoRow:
    number = next(_numbers)
    public_id = new_id()
    return store.photos.receive(
        OWNER,
        public_id=public_id,
        sha256=f"{number:064x}",
        filename=f"p{number}.dng",
        kind="dng",
        byte_size=1000,
        blob_key=f"photos/{public_id}/original",
        calibrate=calibrate,
        given=given,
    ).photo


def inspect(
    store: Store, photo: PhotoRow, *, serial: str | None = "123", aperture: float | None = 1.4
) -> None:
    store.photos.set_state(photo.public_id, ("received",), "inspecting")
    store.photos.record_inspection(
        photo.public_id,
        width=6000,
        height=4000,
        identity=LensName("Canon", "EF24mm f/1.4L", serial, "exif" if serial else "none"),
        aperture=aperture,
        focal_mm=24.0,
        focus_m=None,
        pixel_pitch_um=6.0,
    )
    store.photos.assign_lens(photo.public_id)


def plan(store: Store, photo: PhotoRow, count: int = 2) -> None:
    store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
    patches = [NewPatch(k, 0, 100 * k, 64, 0.1 * k, 0.5, cell=k % 2) for k in range(count)]
    store.patches.add(
        photo.public_id, photo.epoch, [*patches, NewPatch(count, 0, 0, 64, 0, 0, rejected="flat")]
    )
    store.photos.set_state(photo.public_id, ("selecting",), "estimating")


def estimate(store: Store, photo: PhotoRow, indices: tuple[int, ...] = (0, 1)) -> int:
    kernel = gaussian(15, np.eye(2))
    samples = [
        NewSample(k, channel, kernel, 0.5, "default/1") for k in indices for channel in ("r", "g", "b")
    ]
    return store.patches.finish(photo.public_id, photo.epoch, samples)


def counted(store: Store, **options: Any) -> PhotoRow:
    photo = receive(store)
    inspect(store, photo, **options)
    plan(store, photo)
    estimate(store, photo)
    assert store.photos.finish(photo.public_id, photo.epoch) is not None
    return fresh(store, photo)


def fresh(store: Store, photo: PhotoRow) -> PhotoRow:
    found = store.photos.get(photo.public_id)
    assert found is not None
    return found


def lens_id(store: Store, photo: PhotoRow) -> str:
    lens = store.photos.lens_of(fresh(store, photo))
    assert lens is not None
    return lens.public_id


def test_finishing_a_photo_counts_it_once_however_often_it_is_tried(store: Store) -> None:
    photo = counted(store)

    assert store.photos.finish(photo.public_id, photo.epoch) is None

    lens = store.photos.lens_of(photo)
    assert lens is not None
    assert (lens.version, lens.photo_count, lens.sample_count) == (1, 1, 6)
    assert len(store.lenses.history(lens)) == 1


def test_a_repeated_cell_stores_no_sample_twice(store: Store) -> None:
    photo = receive(store)
    inspect(store, photo)
    plan(store, photo)

    assert estimate(store, photo, (0,)) == 3
    assert estimate(store, photo, (0,)) == 0
    assert estimate(store, photo, (0, 1)) == 3
    again = fresh(store, photo)
    assert (again.patches_total, again.patches_done, again.patches_rejected) == (2, 2, 1)


def test_cells_empty_as_their_patches_finish_or_fail(store: Store) -> None:
    photo = receive(store)
    inspect(store, photo)
    plan(store, photo, count=4)
    assert store.patches.cells(photo.public_id, 1) == [0, 1]

    estimate(store, photo, (0, 2))
    assert store.patches.cells(photo.public_id, 1) == [1]
    store.patches.fail(photo.public_id, 1, [1, 3], "time_limit")

    assert store.patches.cells(photo.public_id, 1) == []


def test_planning_twice_adds_nothing(store: Store) -> None:
    photo = receive(store)
    inspect(store, photo)
    plan(store, photo)

    store.patches.add(photo.public_id, 1, [NewPatch(0, 5, 5, 64, 0.5, 0.0)])

    assert len(store.patches.all_of(photo.public_id)) == 3
    assert store.patches.all_of(photo.public_id)[0].row == 0


def test_cancel_and_finish_exclude_each_other(store: Store) -> None:
    photo = receive(store)
    inspect(store, photo)
    plan(store, photo)
    estimate(store, photo)

    assert store.photos.cancel(photo.public_id)
    assert store.photos.finish(photo.public_id, 1) is None
    assert not store.photos.cancel(photo.public_id)
    assert store.samples.of_lens(lens_id(store, photo))[1] == []


def test_work_of_an_old_epoch_changes_nothing(store: Store) -> None:
    photo = receive(store)
    inspect(store, photo)
    plan(store, photo)
    store.photos.restart(photo.public_id, OWNER, {})

    assert estimate(store, photo) == 0
    assert not store.photos.is_live(photo.public_id, 1)
    assert store.photos.is_live(photo.public_id, 2)
    assert not store.photos.fail(photo.public_id, 1, "time_limit", "late")
    assert fresh(store, photo).state == "received"


def test_a_failed_photo_starts_anew_when_it_is_sent_again(store: Store) -> None:
    photo = receive(store)
    store.photos.fail(photo.public_id, 1, "no_usable_patches", "flat")

    again = store.photos.receive(
        OWNER,
        public_id="other",
        sha256=photo.sha256,
        filename="x",
        kind="dng",
        byte_size=1,
        blob_key="y",
        calibrate=True,
        given={},
    )

    assert again.fresh
    assert (again.photo.public_id, again.photo.epoch, again.photo.state) == (photo.public_id, 2, "received")
    assert again.photo.error_code is None


def test_photos_of_one_copy_share_a_lens_whatever_the_spelling(store: Store) -> None:
    first, second = receive(store), receive(store, lens_maker="CANON", lens_model="ef24mm F/1.4l ")
    inspect(store, first)
    inspect(store, second)

    assert lens_id(store, first) == lens_id(store, second)


def test_another_serial_is_another_lens(store: Store) -> None:
    first, second = receive(store), receive(store)
    inspect(store, first, serial="123")
    inspect(store, second, serial="124")

    assert lens_id(store, first) != lens_id(store, second)


def test_without_a_serial_no_lens_is_guessed(store: Store) -> None:
    photo = receive(store)
    inspect(store, photo, serial=None)

    assert fresh(store, photo).lens_id is None
    assert store.photos.assign_lens(photo.public_id, single_copy=True) is not None


def test_what_the_owner_gave_goes_before_the_file(store: Store) -> None:
    photo = receive(store, aperture=2.8, lens_serial="mine")
    inspect(store, photo, serial="123", aperture=1.4)

    again = fresh(store, photo)
    assert (again.aperture, again.lens_serial, again.lens_serial_source) == (2.8, "mine", "user")


def test_a_stored_photo_makes_no_lens_but_joins_one(store: Store) -> None:
    photo = receive(store, calibrate=False)
    inspect(store, photo)
    assert fresh(store, photo).lens_id is None

    counted(store)
    store.photos.assign_lens(photo.public_id)

    assert fresh(store, photo).lens_id is not None


def test_samples_come_back_as_they_were_written(store: Store) -> None:
    photo = counted(store)

    state, samples = store.samples.of_lens(lens_id(store, photo))

    assert (state.version, state.rebuild_epoch, len(samples)) == (1, 0, 6)
    sample = samples[0].sample
    assert sample.settings.aperture == 1.4
    assert sample.photo == photo.public_id
    np.testing.assert_allclose(sample.kernel, gaussian(15, np.eye(2)), atol=1e-7)


def test_only_samples_of_later_versions_are_read_on(store: Store) -> None:
    first, second = counted(store), counted(store)

    state, samples = store.samples.of_lens(lens_id(store, first), after_version=1)

    assert state.version == 2
    assert {stored.sample.photo for stored in samples} == {second.public_id}


def test_excluding_takes_the_samples_out_and_including_brings_them_back(store: Store) -> None:
    photo = counted(store)
    lens = lens_id(store, photo)

    assert store.lenses.exclude(photo.public_id, OWNER)
    assert store.samples.of_lens(lens)[1] == []
    assert not store.lenses.exclude(photo.public_id, OWNER)
    assert store.lenses.include(photo.public_id, OWNER)

    state, samples = store.samples.of_lens(lens)
    assert (state.version, state.rebuild_epoch, len(samples)) == (3, 2, 6)


def test_deleting_a_photo_forgets_its_samples_and_names_its_blobs(store: Store) -> None:
    photo = counted(store)
    lens = lens_id(store, photo)

    assert store.photos.delete(photo.public_id, OWNER) == f"photos/{photo.public_id}/"

    assert store.photos.get(photo.public_id) is None
    assert store.samples.of_lens(lens)[1] == []
    assert store.workers.garbage() == [f"photos/{photo.public_id}/"]
    found = store.lenses.get(lens)
    assert found is not None
    assert [event.kind for event in store.lenses.history(found)] == ["photo_added", "photo_removed"]


def test_the_same_bytes_may_come_again_after_deletion(store: Store) -> None:
    photo = receive(store)
    store.photos.delete(photo.public_id, OWNER)

    assert store.photos.known(OWNER, photo.sha256) is None


def test_a_photo_moved_to_another_lens_renews_both(store: Store) -> None:
    mine, other = counted(store, serial="123"), counted(store, serial="124")
    old, new = lens_id(store, mine), lens_id(store, other)

    assert store.lenses.move(mine.public_id, OWNER, new)

    assert store.samples.of_lens(old)[1] == []
    assert len(store.samples.of_lens(new)[1]) == 12


def test_a_corrected_aperture_reaches_the_samples_and_the_version(store: Store) -> None:
    photo = counted(store)

    store.lenses.change_settings(photo.public_id, OWNER, {"aperture": 2.0}, {"aperture": 2.0})

    state, samples = store.samples.of_lens(lens_id(store, photo))
    assert state.version == 2
    assert {stored.sample.settings.aperture for stored in samples} == {2.0}


def test_the_same_correction_is_made_once_and_a_failed_one_again(store: Store) -> None:
    photo = counted(store)
    lens = store.photos.lens_of(photo)
    assert lens is not None

    first, made = store.corrections.create(photo, lens, 1, {"method": "fast"})
    second, made_again = store.corrections.create(photo, lens, 1, {"method": "fast"})
    assert (made, made_again, first.public_id) == (True, False, second.public_id)

    assert store.corrections.fail(first.public_id, "time_limit", "too slow")
    third, made = store.corrections.create(photo, lens, 1, {"method": "fast"})
    assert made
    assert third.public_id != first.public_id


def test_a_cancelled_correction_cannot_finish(store: Store) -> None:
    photo = counted(store)
    lens = store.photos.lens_of(photo)
    assert lens is not None
    row, _ = store.corrections.create(photo, lens, 1, {})
    assert store.corrections.start(row.public_id)
    store.corrections.progress(row.public_id, 1, 2)

    assert store.corrections.cancel(row.public_id, OWNER)

    assert not store.corrections.finish(row.public_id, Result("k", "e", "image/tiff", 1, "n"), {})
    assert not store.corrections.start(row.public_id)
    assert not store.corrections.is_live(row.public_id)


def test_another_owner_sees_nothing(store: Store) -> None:
    photo = counted(store)
    lens = lens_id(store, photo)

    assert store.photos.get(photo.public_id, "stranger") is None
    assert store.lenses.get(lens, "stranger") is None
    assert store.photos.page("stranger", before=None, limit=10) == []
    assert not store.photos.cancel(photo.public_id, "stranger")
    assert store.photos.delete(photo.public_id, "stranger") is None


def test_a_worker_declared_dead_cannot_beat_again(store: Store) -> None:
    store.workers.register("w", host="h", pid=1, pid_started=0.0)
    assert store.workers.beat("w")
    assert [row.id for row in store.workers.live(10)] == ["w"]

    assert store.workers.bury_stale(0.0) == ["w"]

    assert not store.workers.beat("w")
    assert store.workers.live(10) == []
    store.workers.forget("w")
    assert store.workers.all() == []


def test_no_update_is_lost_when_many_threads_raise_the_version(store: Store) -> None:
    photo = counted(store)
    lens = lens_id(store, photo)

    def toggle() -> None:
        for _ in range(5):
            store.lenses.change_settings(photo.public_id, OWNER, {}, {})

    threads = [threading.Thread(target=toggle) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()

    state = store.samples.state_of(lens)
    assert state is not None
    assert state.version == 21


def test_the_reader_cannot_write(store: Store) -> None:
    with pytest.raises(Exception, match="readonly"), store.database.reading() as session:
        session.execute(text("DELETE FROM owner"))


def test_migrations_go_up_and_down_and_match_the_tables(settings: Settings) -> None:
    from alembic.autogenerate import compare_metadata  # noqa: PLC0415 - only this test compares
    from alembic.migration import MigrationContext  # noqa: PLC0415

    database = Database(settings.database)
    assert upgrade(database)
    assert is_current(database)
    assert not upgrade(database)
    with database.writer.connect() as connection:
        assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []

    downgrade(database, "base")
    assert current(database) is None
    assert upgrade(database)
    assert current(database) == head()
    database.close()


def test_an_unknown_setting_is_refused_with_the_likely_name(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENS_WORKER_SLOT", "3")

    with pytest.raises(ValueError, match="did you mean LENS_WORKER_SLOTS"):
        Settings()


def test_a_port_open_to_the_world_needs_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENS_HOST", "0.0.0.0")

    with pytest.raises(ValueError, match="LENS_PUBLIC"):
        Settings()


def test_a_database_server_needs_shared_storage() -> None:
    with pytest.raises(ValueError, match="s3://"):
        Settings(database_url="postgresql+psycopg://db/lens")
