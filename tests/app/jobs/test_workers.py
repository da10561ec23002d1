"""Several worker processes on one database, some of which die."""

from __future__ import annotations

import os
import random
import signal
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from crew import CELLS, Crew, check_counts, databases, done_patches, pause, states, until
from deadline import stretched
from sqlalchemy import update
from uploads import receive

from app.blobs.storage import Storage
from app.jobs.worker import Worker
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import GarbageRow, PhotoRow

LEASE_S = 3.0


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", lease_seconds=LEASE_S, worker_slots=2, min_free_mb=0)


@pytest.fixture
def crew(settings: Settings, store: Store) -> Iterator[Crew]:
    with closing(Crew(settings, settings.data_dir / "workers.log")) as made:
        yield made


@pytest.fixture
def send(settings: Settings, store: Store, steps: Any) -> Callable[[int], list[PhotoRow]]:
    storage = Storage(settings.storage)

    def send(count: int) -> list[PhotoRow]:
        photos = [steps.receive() for _ in range(count)]
        for photo in photos:
            storage.put(photo.blob_key, b"a photo")
        return photos

    return send


def test_a_worker_in_doubt_ends_what_broke_and_nothing_else(
    settings: Settings, store: Store, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = SimpleNamespace(
        take_over=lambda _: None, status=lambda _: "done"
    )  # all jobs ended, whatever they did
    lens_id = steps.lens_id(steps.counted())
    broken, waiting = steps.receive(), steps.receive()
    steps.inspect(waiting, serial=None)
    worker = Worker(settings)
    monkeypatch.setattr(worker, "_engine", engine)
    listed = store.jobs.to_do(begun=True)
    store.photos.set_state(waiting.public_id, ("inspecting",), "needs_lens")
    monkeypatch.setattr(worker._store.jobs, "to_do", lambda **_: listed)  # it came to wait after we looked

    worker._reconcile()

    assert (steps.fresh(broken).state, steps.fresh(waiting).state) == ("failed", "needs_lens")
    lens = store.lenses.get(lens_id, ANY_OWNER)
    assert lens is not None
    assert [event.metrics for event in store.lenses.history(lens)] == [
        {"error": None, "coverage": None, "problem": "internal_error"}
    ]


def test_blobs_that_cannot_be_deleted_keep_no_others(
    settings: Settings, store: Store, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    photos = [steps.receive() for _ in range(2)]
    stuck, other = (store.photos.delete(photo.public_id, "local") for photo in photos)
    with store.database.writing() as session:
        session.execute(update(GarbageRow).values(not_before=datetime.now(UTC)))
    worker = Worker(settings)

    def delete(prefix: str) -> None:
        if prefix == stuck:
            raise OSError("read-only")

    monkeypatch.setattr(worker._context.storage, "delete", delete)
    monkeypatch.setattr(worker, "_engine", SimpleNamespace(forget=lambda _: 0))
    monkeypatch.setattr(worker._store.jobs, "garbage", lambda: [stuck, other])

    worker._tidy()

    assert store.jobs.garbage(at=datetime.now(UTC) + timedelta(hours=1)) == [stuck]


def test_photos_in_the_queue_are_read_while_others_are_worked_on(
    crew: Crew, store: Store, send: Callable[[int], list[PhotoRow]]
) -> None:
    def are_read() -> bool:
        return all(row.width for row in store.photos.page("local", before=None, limit=12))

    send(12)
    crew.hire()
    until(are_read, crew.log)
    waiting = states(store).count("received")
    until(lambda: states(store) == ["counted"] * 12, crew.log)

    assert waiting > 0
    check_counts(store, 12)


@pytest.mark.slow
def test_another_worker_takes_over_from_one_that_died_for_ever(
    crew: Crew, store: Store, send: Callable[[int], list[PhotoRow]]
) -> None:
    send(1)
    first = crew.hire()
    until(lambda: done_patches(store) >= 2)
    crew.kill(first)
    left = done_patches(store)

    crew.hire()
    until(lambda: states(store) == ["counted"])

    assert left < CELLS
    check_counts(store, 1)
    until(lambda: len(store.jobs.workers()) == 1)


def test_the_loss_of_the_engines_database_loses_no_photo_and_that_of_the_tables_ends_a_worker(
    crew: Crew, store: Store, settings: Settings, send: Callable[[int], list[PhotoRow]]
) -> None:
    send(1)
    first = crew.hire()
    until(lambda: done_patches(store) >= 2)
    crew.kill(first)
    for path in settings.data_dir.glob("jobs.db*"):
        path.unlink()

    second = crew.hire()
    until(lambda: states(store) == ["counted"])

    check_counts(store, 1)
    path = settings.data_dir / "app.db"
    path.rename(path.with_suffix(".old"))
    path.write_bytes(path.with_suffix(".old").read_bytes())

    assert second.wait(stretched(60)) == 70
    crew.processes.remove(second)
    assert "was replaced" in (settings.data_dir / "workers.log").read_text()


@pytest.mark.slow
def test_a_worker_that_slept_through_its_lease_stops_and_counts_nothing_twice(
    crew: Crew, store: Store, settings: Settings, send: Callable[[int], list[PhotoRow]]
) -> None:
    send(3)
    sleeper = crew.hire()
    until(lambda: done_patches(store) >= 1)
    pause(sleeper.pid, databases(settings))
    crew.hire()
    until(lambda: states(store) == ["counted"] * 3)
    os.kill(sleeper.pid, signal.SIGCONT)

    assert sleeper.wait(stretched(60)) == 70
    crew.processes.remove(sleeper)
    check_counts(store, 3)


@pytest.mark.slow
def test_twenty_random_deaths_lose_nothing_and_count_nothing_twice(
    crew: Crew, store: Store, send: Callable[[int], list[PhotoRow]]
) -> None:
    chance = random.Random(7)  # `make torture` draws others
    photos, kills = 8, 20
    send(photos)
    for _ in range(3):
        crew.hire()
    until(lambda: done_patches(store) >= 1)
    for _ in range(kills):
        time.sleep(chance.uniform(0.3, 2.0))
        victim = chance.choice(crew.processes)
        crew.kill(victim, group=chance.random() < 0.5)
        crew.hire()

    until(lambda: set(states(store)) == {"counted"}, within_s=240)

    check_counts(store, photos)


def test_an_upload_that_ends_while_garbage_is_cleared_keeps_its_file(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    prefix, storage = "photos/slow/", Storage(settings.storage)
    store.photos.expect(prefix, within=timedelta(hours=-3))  # as if it had begun hours ago
    storage.put(f"{prefix}original", b"a photo")
    worker = Worker(settings)
    listed = store.jobs.garbage()

    def receive_meanwhile() -> list[str]:
        receive(store, "slow")
        return listed

    monkeypatch.setattr(worker._store.jobs, "garbage", receive_meanwhile)
    monkeypatch.setattr(worker, "_engine", SimpleNamespace(forget=lambda _: 0))
    worker._tidy()

    assert listed == [prefix]
    assert storage.get(f"{prefix}original") == b"a photo"
