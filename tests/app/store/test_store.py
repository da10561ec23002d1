"""The tables keep every promise however often, and in whatever order, steps are repeated."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from conftest import Steps
from deadline import stretched
from servers import postgres
from sqlalchemy import Text, cast, event, func, select, text
from sqlalchemy.exc import DBAPIError
from starlette.testclient import TestClient
from uploads import receive

from app.errors import BusyError, UnknownError
from app.runtime.settings import Settings
from app.store import LensName, Store
from app.store.database import Database, current, head, upgrade
from app.store.owners import ANY_OWNER, ensure_owner
from app.store.tables import Base, EventRow, LensRow, PatchRow, PhotoRow, SampleRow
from lensmodel.core.errors import InvalidInputError

OWNER = "local"
WINDOW = {"row": 5, "col": 5, "size": 64, "r": 0.5, "phi": 0.0, "cell": 0}


# --- photos and their patches -----------------------------------------------------------------


def test_steps_of_a_photo_that_are_repeated_count_once(store: Store, steps: Steps) -> None:
    photo = steps.planned()

    store.photos.plan_patches(photo.public_id, 1, [WINDOW], [])
    assert len(store.photos.windows(photo.public_id)) == 3
    assert store.photos.patches(photo.public_id)[0].row == 100
    assert [steps.estimate(photo, indices) for indices in ((0,), (0,), (0, 1))] == [3, 0, 3]
    finished = [store.photos.finish(photo.public_id, photo.epoch) is not None for _ in range(2)]

    again, lens = steps.fresh(photo), steps.lens(photo)
    assert finished == [True, False]
    assert (again.patches_total, again.patches_done, again.patches_rejected) == (2, 2, 1)
    assert (lens.version, lens.photo_count, lens.sample_count) == (1, 1, 6)
    assert len(store.lenses.history(lens)) == 1


def test_patches_that_fail_stay_so_and_those_that_are_done_do_not_fail(store: Store, steps: Steps) -> None:
    photo = steps.planned(4)
    steps.estimate(photo, (0, 2))

    store.photos.reject_patches(photo.public_id, 1, "time_limit", [1, 2, 3])

    states = [row.state for row in store.photos.patches(photo.public_id)]
    assert states == ["done", "rejected", "done", "rejected"]


def test_rejected_windows_are_a_map_and_no_rows(store: Store, steps: Steps) -> None:
    photo = steps.receive()
    steps.inspect(photo)
    store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
    place = {"size": 64, "r": 0.12345678, "phi": -2.5, "reason": "clipped"}
    rejected = [{"row": 16 * k, "col": 8 * k, **place} for k in range(2000)]

    count = store.photos.plan_patches(photo.public_id, 1, [WINDOW], rejected)

    listed, again = store.photos.windows(photo.public_id), steps.fresh(photo)
    stored = len(rows(store, PatchRow))
    with store.database.reading() as session:
        size = session.scalar(select(func.length(cast(PhotoRow.windows, Text))))
    assert (count, stored, again.patches_total, again.patches_rejected) == (1, 1, 1, 2000)
    assert [row.idx for row in listed] == list(range(2001))
    last = listed[-1]
    assert (last.row, last.col, last.size, last.r, last.phi) == (31984, 15992, 64, 0.1235, -2.5)
    assert (last.state, last.reason) == ("rejected", "clipped")
    assert size < 100_000
    store.photos.change([photo.public_id], OWNER, {"aperture": 2.0})
    assert store.photos.windows(photo.public_id) == []


def test_cancel_and_finish_exclude_each_other(store: Store, steps: Steps) -> None:
    photo, other = steps.planned(), steps.counted()
    steps.estimate(photo)

    assert store.photos.cancel(photo.public_id, ANY_OWNER)
    assert store.photos.finish(photo.public_id, 1) is None
    assert not store.photos.cancel(photo.public_id, ANY_OWNER)
    assert {sample.photo for sample in steps.learned(other)[1]} == {other.public_id}


def test_work_of_an_old_epoch_changes_nothing(store: Store, steps: Steps) -> None:
    photo = steps.planned()
    store.photos.change([photo.public_id], OWNER, {"aperture": 2.0})

    store.photos.set_state(photo.public_id, ("received",), "selecting")
    store.photos.plan_patches(photo.public_id, 1, [WINDOW], [])
    assert store.photos.patches(photo.public_id, 1) == []
    assert steps.estimate(photo) == 0
    store.photos.record_lateral(photo.public_id, 1, {"red": [0, 0, 0, 1]})
    store.photos.set_state(photo.public_id, ("selecting",), "received")
    assert not store.photos.is_live(photo.public_id, 1)
    assert store.photos.is_live(photo.public_id, 2)
    assert not store.photos.fail(photo.public_id, 1, "time_limit", "late")
    assert (steps.fresh(photo).state, steps.fresh(photo).lateral) == ("received", None)


def test_a_failed_photo_starts_anew_when_it_is_sent_again(store: Store, steps: Steps) -> None:
    photo = steps.receive()
    store.photos.fail(photo.public_id, 1, "no_usable_patches", "flat")

    again = receive(store, "other", sha256=photo.sha256)

    assert again.fresh
    assert (again.photo.public_id, again.photo.epoch, again.photo.state) == (photo.public_id, 2, "received")
    assert again.photo.error_code is None


# --- what files and owners say ----------------------------------------------------------------


def test_the_owners_correction_goes_before_the_header_and_that_before_what_came_with_the_file(
    store: Store, steps: Steps
) -> None:
    photo, silent = steps.receive(aperture=2.8, lens_serial="mine"), steps.receive(aperture=2.8)
    steps.inspect(photo, aperture=1.4)
    steps.inspect(silent, aperture=None)
    assert (steps.fresh(photo).aperture, steps.fresh(silent).aperture) == (1.4, 2.8)

    store.photos.change([photo.public_id], OWNER, {"aperture": 2.0})
    store.photos.fail(photo.public_id, 2, "time_limit", "late")
    steps.receive_again(photo, aperture=4.0)  # the same file with another value: no correction
    steps.inspect(photo, aperture=1.4)

    again = steps.fresh(photo)
    assert (again.epoch, again.aperture) == (3, 2.0)
    assert (again.lens_serial, again.lens_serial_source) == ("mine", "user")


@pytest.mark.parametrize(("serial", "same"), [("123", True), ("124", False)])
def test_photos_of_one_copy_share_a_lens_whatever_the_spelling(steps: Steps, serial: str, same: bool) -> None:
    first, second = steps.receive(), steps.receive(lens_maker="CANON", lens_model="ef24mm F/1.4l ")
    steps.inspect(first, serial="123")
    steps.inspect(second, serial=serial)

    assert (steps.lens_id(first) == steps.lens_id(second)) == same


def test_without_a_serial_no_lens_is_guessed(store: Store, steps: Steps) -> None:
    photo = steps.waiting()

    assert steps.fresh(photo).lens_id is None
    nameless = LensName("Canon", "EF24mm f/1.4L", None, "none")
    again = store.photos.record_inspection(photo.public_id, nameless, single_copy=True, aperture=1.4)
    assert again.lens is not None


def test_a_stored_photo_makes_no_lens_but_joins_one(steps: Steps) -> None:
    photo = steps.receive(calibrate=False)
    steps.inspect(photo)
    assert steps.fresh(photo).lens_id is None

    steps.counted()
    steps.inspect(photo)

    assert steps.fresh(photo).lens_id is not None


# --- samples and versions ---------------------------------------------------------------------


def test_deleting_a_photo_forgets_its_samples_and_names_its_blobs(store: Store, steps: Steps) -> None:
    other, photo = steps.counted(), steps.counted()
    lens = steps.lens_id(photo)

    assert store.photos.delete(photo.public_id, OWNER) == f"photos/{photo.public_id}/"

    assert store.photos.get(photo.public_id, ANY_OWNER) is None
    assert {stored.photo for stored in steps.learned(other)[1]} == {other.public_id}
    assert store.jobs.garbage() == []  # a worker may still write: once more in a while
    late = datetime.now(UTC) + timedelta(hours=1)
    models = {f"models/{lens}/{version}-0/" for version in (1, 2)}
    assert set(store.jobs.garbage(at=late)) == {f"photos/{photo.public_id}/"} | models
    history = [event.kind for event in store.lenses.history(steps.lens(other))]
    assert history == ["photo_added", "photo_added", "photo_removed"]
    assert steps.receive_again(photo).public_id != photo.public_id


def test_a_photo_is_moved_to_no_lens_that_is_gone_or_of_another(store: Store, steps: Steps) -> None:
    mine, other = steps.counted(serial="123"), store.lenses.create("another", "mine, and nobody else's")
    deleted = store.lenses.create(OWNER, "here for a moment")
    store.lenses.delete(deleted, OWNER)

    for lens in (other, deleted):
        with pytest.raises(UnknownError, match=lens):
            store.photos.change([mine.public_id], OWNER, {"aperture": 2.0}, lens=lens)

    assert steps.fresh(mine).aperture != 2.0


def test_no_update_is_lost_when_many_threads_raise_the_version(store: Store, steps: Steps) -> None:
    photo = steps.counted()

    def toggle() -> None:
        for _ in range(5):
            store.photos.change([photo.public_id], OWNER, {"aperture": 2.0})

    with ThreadPoolExecutor(4) as threads:
        for done in [threads.submit(toggle) for _ in range(4)]:
            done.result()

    assert steps.learned(photo)[0].version == 21


# --- what is deleted is gone -------------------------------------------------------------------

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
    assert steps.estimate(running) == 0  # what still runs brings nothing back
    assert store.photos.finish(running.public_id, 1) is None
    for table in (SampleRow, PatchRow, EventRow, LensRow):
        assert rows(store, table) == []


def test_the_same_lens_begins_anew_with_its_next_photo(store: Store, steps: Steps) -> None:
    first = steps.lens(steps.counted())
    store.lenses.delete(first.public_id, OWNER)

    second = steps.lens(steps.counted())

    assert second.public_id != first.public_id
    assert second.id > first.id  # its key is given to no other
    assert second.version == 1


def test_failed_and_cancelled_photos_leave_no_lens_behind(store: Store, steps: Steps) -> None:
    counted, failed, cancelled = steps.counted(serial="1"), steps.planned(), steps.planned()
    other, sharing = steps.lens_id(counted), steps.planned(serial="1")
    assert len(lenses(store)) == 2

    store.photos.fail(failed.public_id, 1, *WHY)
    store.photos.fail(sharing.public_id, 1, *WHY)
    store.photos.cancel(cancelled.public_id, OWNER)

    assert lenses(store) == [other]
    assert len(steps.learned(counted)[1]) == 6
    assert store.photos.retry(failed.public_id, OWNER)
    steps.inspect(steps.fresh(failed))
    assert len(lenses(store)) == 2


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


# --- corrections, workers, garbage ------------------------------------------------------------


def test_a_worker_declared_dead_cannot_beat_again(store: Store) -> None:
    store.jobs.register("w")
    assert store.jobs.beat("w")
    assert [row.id for row in store.jobs.live(10)] == ["w"]

    store.jobs.bury("w")

    assert not store.jobs.beat("w")
    assert store.jobs.live(10) == []
    assert [store.jobs.remove_dead(10, by=name) for name in ("w", "other", "third")] == [[], ["w"], []]
    assert store.jobs.workers() == []


def test_an_upload_has_all_its_time_and_either_keeps_its_file_or_is_refused(store: Store) -> None:
    hour, late = timedelta(hours=1), datetime.now(UTC) + timedelta(hours=3)
    for public_id in ("early", "late"):
        store.photos.expect(f"photos/{public_id}/", within=hour)
    assert store.jobs.garbage(at=datetime.now(UTC) + hour) == []
    assert store.jobs.garbage(at=late) == ["photos/early/", "photos/late/"]

    receive(store, "early")
    assert not store.jobs.claim_garbage("photos/early/", at=late)
    assert store.jobs.claim_garbage("photos/late/", at=late)
    with pytest.raises(BusyError, match="too long"):
        receive(store, "late")

    assert store.jobs.garbage(at=late) == ["photos/late/"]  # still, until its blobs are deleted


def test_what_is_written_after_a_deletion_is_deleted_later(store: Store, steps: Steps) -> None:
    photo = steps.counted()
    one, two = steps.correct(photo, method="fast"), steps.correct(photo, method="paper")
    prefixes = [f"corrections/{row.public_id}/" for row in (one, two)]

    assert store.jobs.delete(one.public_id, OWNER) == prefixes[0]
    store.photos.delete(photo.public_id, OWNER)

    assert not set(prefixes) & set(store.jobs.garbage())
    assert set(prefixes) <= set(store.jobs.garbage(at=datetime.now(UTC) + timedelta(hours=1)))


# --- the database -----------------------------------------------------------------------------


def test_an_error_of_the_database_names_no_serial(store: Store) -> None:
    with pytest.raises(DBAPIError) as caught, store.database.writing() as session:
        session.execute(text("SELECT 1 FROM nowhere WHERE serial = :serial"), {"serial": "SECRET-77"})

    assert "SECRET-77" not in str(caught.value)


def test_the_reader_cannot_write(store: Store) -> None:
    with pytest.raises(Exception, match=r"read-?only"), store.database.reading() as session:
        session.execute(text("DELETE FROM owner"))


def test_the_steps_of_the_schema_lead_to_the_tables(tmp_path: Path) -> None:
    from alembic.autogenerate import compare_metadata  # noqa: PLC0415 - only this test compares
    from alembic.migration import MigrationContext  # noqa: PLC0415

    with closing(Database(f"sqlite:///{tmp_path}/app.db")) as database:
        assert current(database) is None
        upgrade(database)
        assert current(database) == head()
        with database.writer.connect() as connection:
            assert compare_metadata(MigrationContext.configure(connection), Base.metadata) == []


def test_a_database_of_a_newer_program_is_refused(store: Store) -> None:
    with store.database.writer.begin() as connection:
        connection.execute(text("UPDATE alembic_version SET version_num = '9999'"))

    with pytest.raises(InvalidInputError, match=r"newer program .*9999"):
        upgrade(store.database)


@pytest.fixture
def server(settings: Settings) -> Iterator[Steps]:
    """Steps on a database server."""
    with (
        postgres() as own,
        closing(Store(settings.model_copy(update={"database_url": own.url("app")}))) as opened,
    ):
        upgrade(opened.database)
        yield Steps(opened)


@pytest.mark.parametrize("kind", ["steps", pytest.param("server", marks=pytest.mark.tools)])
def test_samples_are_of_the_version_that_comes_with_them(kind: str, request: pytest.FixtureRequest) -> None:
    """Let a photo be counted between the two statements that read the version and the samples."""
    steps: Steps = request.getfixturevalue(kind)
    reader, lens, during = steps.store.database.reader, steps.lens_id(steps.counted()), list[PhotoRow]()

    def count_another(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        if "rebuild_epoch" in statement and not during:
            during.append(steps.receive())  # first: what follows reads the version as well
            during[0] = steps.counted()

    event.listen(reader, "after_cursor_execute", count_another)
    try:
        state, samples = steps.store.lenses.samples_of(lens)
    finally:
        event.remove(reader, "after_cursor_execute", count_another)

    again, later = steps.store.lenses.samples_of(lens, after_version=state.version)
    assert (state.version, again.version) == (1, 2)
    assert {sample.photo for sample in later} == {during[0].public_id}
    assert during[0].public_id not in {sample.photo for sample in samples}


def at_once(store: Store, first: Callable[[], Any], second: Callable[[], Any]) -> tuple[Any, Any]:
    """Begin a second change on a server once the first has locked something; return what both return."""
    begun: list[Future[Any]] = []

    def begin(connection: Any, cursor: Any, statement: str, *_: Any) -> None:
        if " FOR " in statement and not begun:
            begun.append(others.submit(second))
            time.sleep(0.5)  # until it waits, or has locked what the first wants next

    with ThreadPoolExecutor() as others:
        event.listen(store.database.writer, "after_cursor_execute", begin)
        try:
            return first(), begun[0].result()
        finally:
            event.remove(store.database.writer, "after_cursor_execute", begin)


@pytest.mark.tools
def test_two_changes_at_once_wait_for_each_other_on_a_server_and_do_not_deadlock(server: Steps) -> None:
    store, photo, other = server.store, server.counted(), server.counted()
    ids = [photo.public_id, other.public_id]

    def changed(aperture: float, *, backwards: bool = False) -> Callable[[], bool]:
        order = ids[::-1] if backwards else ids
        return partial(store.photos.change, order, OWNER, {"aperture": aperture})

    assert at_once(store, changed(2.0), changed(2.8, backwards=True)) == (True, True)
    into = server.named(LensName("Canon", "EF24mm", "7"))
    merged = partial(store.lenses.merge, server.lens_id(photo), into, OWNER)
    assert at_once(store, changed(4.0), merged) == (True, True)
    gone = partial(store.lenses.delete, server.lens_id(photo), OWNER)
    assert at_once(store, changed(8.0), gone) == (True, True)

    deleted = partial(store.photos.delete, photo.public_id, OWNER)
    folder, again = at_once(store, deleted, partial(server.receive_again, photo))
    assert folder == photo.folder
    assert again.public_id != photo.public_id


@pytest.mark.tools
def test_who_names_a_photo_of_another_owner_does_not_wait_for_that_one(server: Steps) -> None:
    theirs = Steps(server.store, "somebody").counted()

    with ThreadPoolExecutor() as others, server.store.database.writing() as session:
        ensure_owner(session, "somebody")
        deleted = others.submit(server.store.photos.delete, theirs.public_id, OWNER)
        assert deleted.result(timeout=stretched(10.0)) is None


def test_pages_are_found_by_an_index(store: Store, steps: Steps) -> None:
    steps.correct(steps.counted(), method="fast")
    seen: list[tuple[str, Any]] = []

    def note(connection: object, cursor: object, statement: str, *rest: Any) -> None:
        if statement.startswith("SELECT"):
            seen.append((statement, rest[0]))

    event.listen(store.database.reader, "before_cursor_execute", note)
    for page in (store.lenses.page, store.photos.page, store.jobs.page):
        assert len(page(OWNER, before=None, limit=50)) == 1
    event.remove(store.database.reader, "before_cursor_execute", note)

    indexes = ("ix_lens_page", "ix_photo_page", "ix_correction_page")
    with store.database.reader.connect() as connection:
        for (statement, values), index in zip(seen, indexes, strict=True):
            explained = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", values)
            plan = [row[-1] for row in explained.all()]
            assert any(index in step for step in plan), plan
            assert not any(step.startswith(("SCAN", "USE TEMP B-TREE")) for step in plan), plan


def test_a_correction_is_finished_by_who_took_it_up_last_unless_cancelled(store: Store, steps: Steps) -> None:
    jobs, row = store.jobs, steps.correct(steps.counted())
    file = {"key": "k", "etag": "e", "media_type": "image/tiff", "bytes": 1, "name": "n"}
    lost, run = jobs.start(row.public_id, 1), jobs.start(row.public_id, 1)
    assert not jobs.finish(lost, {}, **file)
    jobs.progress(run, 1, 2)

    assert jobs.cancel(row.public_id, OWNER)

    assert not jobs.finish(run, {}, **file)
    assert not jobs.start(row.public_id, 1)
    assert not jobs.is_live(row.public_id, 1)
