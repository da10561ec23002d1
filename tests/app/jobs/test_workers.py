"""The duties of a worker, and several worker processes on one database, some of which die."""

from __future__ import annotations

import contextlib
import os
import signal
import time
from collections.abc import Callable, Iterator
from datetime import UTC, datetime, timedelta
from types import SimpleNamespace

import pytest
from conftest import Steps
from crew import CELLS, Crew, check_counts, databases, done_patches, pause, states
from deadline import stretched, until
from sqlalchemy import exc, update
from uploads import receive, send

from app.blobs.storage import Storage
from app.jobs.worker import Worker
from app.runtime.settings import Settings
from app.store import Store
from app.store.tables import GarbageRow
from lensmodel.cli.console import InterruptedByUser

FENCED = 70


SHORT_LEASE = pytest.mark.parametrize("lease_s", [3.0])
"""For tests of workers that lose theirs; others would, on a busy machine."""


@pytest.fixture
def lease_s() -> float:
    return 20.0


@pytest.fixture
def settings(settings: Settings, lease_s: float) -> Settings:
    return settings.model_copy(update={"lease_seconds": lease_s, "worker_slots": 2})


@pytest.fixture
def worker(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Worker:
    """Give a worker whose engine knows no job."""
    made = Worker(settings)
    monkeypatch.setattr(made, "_engine", SimpleNamespace(forget=lambda _: 0))
    return made


def test_a_worker_in_doubt_ends_what_broke_and_nothing_else(
    worker: Worker, store: Store, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    # all jobs ended, whatever they did
    monkeypatch.setattr(worker, "_engine", SimpleNamespace(take_over=lambda _: None, status=lambda _: "done"))
    counted, broken, waiting = steps.counted(), steps.receive(), steps.receive()
    steps.inspect(waiting, serial=None)
    listed = store.jobs.to_do(begun=True)
    store.photos.set_state(waiting.public_id, ("inspecting",), "needs_lens")
    monkeypatch.setattr(worker._store.jobs, "to_do", lambda **_: listed)  # it came to wait after we looked

    worker._reconcile()

    assert (steps.fresh(broken).state, steps.fresh(waiting).state) == ("failed", "needs_lens")
    (event,) = store.lenses.history(steps.lens(counted))
    assert event.metrics == {"error": None, "coverage": None, "problem": "internal_error"}


def test_blobs_that_cannot_be_deleted_keep_no_others(
    worker: Worker, store: Store, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    stuck, other = (store.photos.delete(steps.receive().public_id, "local") for _ in range(2))
    with store.database.writing() as session:
        session.execute(update(GarbageRow).values(not_before=datetime.now(UTC)))

    def delete(prefix: str) -> None:
        if prefix == stuck:
            raise OSError("read-only")

    monkeypatch.setattr(worker._context.storage, "delete", delete)
    monkeypatch.setattr(worker._store.jobs, "garbage", lambda: [stuck, other])
    worker._tidy()

    assert store.jobs.garbage(at=datetime.now(UTC) + timedelta(hours=1)) == [stuck]


def test_an_upload_that_ends_while_garbage_is_cleared_keeps_its_file(
    worker: Worker, store: Store, storage: Storage, monkeypatch: pytest.MonkeyPatch
) -> None:
    prefix = "photos/slow/"
    store.photos.expect(prefix, within=timedelta(hours=-3))  # as if it had begun hours ago
    storage.put(f"{prefix}original", b"a photo")
    listed = store.jobs.garbage()

    def receive_meanwhile() -> list[str]:
        receive(store, "slow")
        return listed

    monkeypatch.setattr(worker._store.jobs, "garbage", receive_meanwhile)
    worker._tidy()

    assert listed == [prefix]
    assert storage.get(f"{prefix}original") == b"a photo"


@SHORT_LEASE
def test_a_worker_keeps_its_lease_while_its_engine_starts(
    worker: Worker, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    beats: list[bool] = []

    def start(handlers: object) -> None:
        """As on a machine that is busy: the tables of the jobs take longer than a lease."""
        first = store.jobs.workers()[0].heartbeat_at
        beats.append(until(lambda: store.jobs.workers()[0].heartbeat_at > first))
        raise InterruptedByUser(signal.SIGTERM)

    monkeypatch.setattr(worker, "_engine", SimpleNamespace(start=start))

    with pytest.raises(InterruptedByUser):
        worker._begin()

    assert beats == [True]


def test_a_worker_without_connection_for_a_lease_stops(
    worker: Worker, monkeypatch: pytest.MonkeyPatch
) -> None:
    def beat(_: str) -> bool:
        raise exc.TimeoutError("QueuePool limit reached")

    stopped: list[str] = []
    monkeypatch.setattr(worker._store.jobs, "beat", beat)
    monkeypatch.setattr(worker, "_die", stopped.append)
    monkeypatch.setattr(worker, "_last_beat", time.monotonic() - 1000.0)

    with contextlib.suppress(exc.TimeoutError):
        worker._keep_lease()

    assert stopped == ["the database did not answer for a whole lease"]


# --- real workers -----------------------------------------------------------------------------


@pytest.fixture
def crew(settings: Settings, store: Store) -> Iterator[Crew]:
    with contextlib.closing(Crew(settings, settings.data_dir / "workers.log")) as made:
        yield made


@pytest.fixture
def sent(store: Store, storage: Storage) -> Callable[[int], None]:
    def send_all(count: int) -> None:
        for number in range(count):
            send(store, storage, number)

    return send_all


def are_counted(store: Store) -> bool:
    return set(states(store)) == {"counted"}


def test_photos_are_read_while_others_are_in_work(
    crew: Crew, store: Store, sent: Callable[[int], None]
) -> None:
    def are_read() -> bool:
        return all(row.width for row in store.photos.page("local", before=None, limit=8))

    sent(8)
    crew.hire()
    crew.until(are_read)
    waiting = states(store).count("received")
    crew.until(lambda: are_counted(store))

    assert waiting > 0
    check_counts(store, 8)


@SHORT_LEASE
@pytest.mark.slow
def test_another_worker_takes_over_from_one_that_died_for_ever(
    crew: Crew, store: Store, sent: Callable[[int], None]
) -> None:
    sent(1)
    first = crew.hire()
    crew.until(lambda: done_patches(store) >= 2)
    crew.kill(first)
    left = done_patches(store)

    crew.hire()
    crew.until(lambda: are_counted(store))

    assert left < CELLS
    check_counts(store, 1)
    crew.until(lambda: len(store.jobs.workers()) == 1)


@SHORT_LEASE
def test_the_loss_of_the_engines_database_loses_no_photo_and_that_of_the_tables_ends_a_worker(
    crew: Crew, store: Store, settings: Settings, sent: Callable[[int], None]
) -> None:
    sent(1)
    first = crew.hire()
    crew.until(lambda: done_patches(store) >= 2)
    crew.kill(first)
    for path in settings.data_dir.glob("jobs.db*"):
        path.unlink()

    second = crew.hire()
    crew.until(lambda: are_counted(store))

    check_counts(store, 1)
    path = settings.data_dir / "app.db"
    path.rename(path.with_suffix(".old"))
    path.write_bytes(path.with_suffix(".old").read_bytes())

    assert second.wait(stretched(60)) == FENCED
    assert "was replaced" in crew.log.read_text()


@SHORT_LEASE
@pytest.mark.slow
def test_a_worker_that_slept_through_its_lease_stops_and_counts_nothing_twice(
    crew: Crew, store: Store, settings: Settings, sent: Callable[[int], None]
) -> None:
    sent(3)
    sleeper = crew.hire()
    crew.until(lambda: done_patches(store) >= 1)
    pause(sleeper.pid, databases(settings))
    crew.hire()
    crew.until(lambda: are_counted(store))
    os.kill(sleeper.pid, signal.SIGCONT)

    assert sleeper.wait(stretched(60)) == FENCED
    check_counts(store, 3)


def test_photos_outlast_a_storage_that_is_away(crew: Crew, store: Store, storage: Storage) -> None:
    aside = storage.folder.with_name("aside")
    crew.hire()
    send(store, storage, 0)
    crew.until(lambda: are_counted(store))  # a worker without any photo founds a missing folder
    storage.folder.rename(aside)
    for number in (1, 2):
        send(store, Storage(f"file://{aside}"), number)
    crew.until(lambda: crew.log.read_text().count("is away") >= 4)
    seen = states(store)
    aside.rename(storage.folder)
    crew.until(lambda: are_counted(store))

    assert "failed" not in seen
    check_counts(store, 3)


@pytest.mark.slow
def test_workers_that_start_while_the_storage_is_away_wait_for_it(
    crew: Crew, store: Store, storage: Storage, sent: Callable[[int], None]
) -> None:
    sent(2)
    aside = storage.folder.with_name("aside")
    storage.folder.rename(aside)
    storage.folder.mkdir()  # as where nothing is mounted
    crew.hire()
    crew.until(lambda: crew.log.read_text().count("is away") >= 2)
    seen, left = states(store), list(storage.folder.iterdir())
    storage.folder.rmdir()
    aside.rename(storage.folder)
    crew.until(lambda: are_counted(store))

    assert "failed" not in seen
    assert left == []
    check_counts(store, 2)
