"""Several worker processes on one database, some of which die."""

from __future__ import annotations

import os
import random
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from deadline import Deadline, stretched
from sqlalchemy import func, select, update
from uploads import receive

from app.blobs.storage import Storage
from app.jobs.worker import Worker
from app.runtime.settings import Settings
from app.runtime.supervisor import environment
from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import EventRow, GarbageRow, PatchRow, PhotoRow, SampleRow

HERE = Path(__file__).parents[1]
STAND_INS = HERE / "stand_ins"
CELLS = 8
LEASE_S = 3.0


class Crew:
    """Worker processes of one database."""

    def __init__(self, settings: Settings) -> None:
        self._log = (settings.data_dir / "workers.log").open("a")
        path = os.pathsep.join([str(STAND_INS), os.environ.get("PYTHONPATH", "")])
        self._environment = os.environ | environment(settings) | {"PYTHONPATH": path}
        self.processes: list[subprocess.Popen[bytes]] = []

    def hire(self) -> subprocess.Popen[bytes]:
        process = subprocess.Popen(
            [sys.executable, str(STAND_INS / "quick_worker.py")],
            env=self._environment,
            stderr=self._log,
            start_new_session=True,
        )
        self.processes.append(process)
        return process

    def kill(self, process: subprocess.Popen[bytes]) -> None:
        process.kill()
        process.wait()
        self.processes.remove(process)

    def close(self) -> None:
        for process in self.processes:
            process.kill()
            process.wait()
        self._log.close()


@pytest.fixture
def settings(tmp_path: Path) -> Settings:
    return Settings(data_dir=tmp_path / "data", lease_seconds=LEASE_S, worker_slots=2, min_free_mb=0)


@pytest.fixture
def crew(settings: Settings, store: Store) -> Iterator[Crew]:
    made = Crew(settings)
    yield made
    made.close()


@pytest.fixture
def send(settings: Settings, store: Store, steps: Any) -> Callable[[int], list[PhotoRow]]:
    storage = Storage(settings.storage)

    def send(count: int) -> list[PhotoRow]:
        photos = [steps.receive() for _ in range(count)]
        for photo in photos:
            storage.put(photo.blob_key, b"a photo")
        return photos

    return send


def until(condition: Callable[[], object], within_s: float = 90.0) -> None:
    deadline = Deadline(within_s)
    while not condition():
        assert not deadline.passed(), "it never happened"
        time.sleep(0.05)


def states(store: Store) -> list[str]:
    with store.database.reading() as session:
        return list(session.scalars(select(PhotoRow.state)))


def done_patches(store: Store) -> int:
    with store.database.reading() as session:
        return session.scalar(select(func.count()).where(PatchRow.state == "done")) or 0


def stop_outside_of_transactions(pid: int, settings: Settings) -> None:
    """Stop a process that holds no write lock: with one it would stop everybody, not only itself."""
    while True:
        os.kill(pid, signal.SIGSTOP)
        try:
            for name in ("app.db", "jobs.db"):
                path = settings.data_dir / name
                with closing(sqlite3.connect(path, timeout=0, isolation_level=None)) as opened:
                    opened.execute("BEGIN IMMEDIATE")
                    opened.execute("ROLLBACK")
        except sqlite3.OperationalError:
            os.kill(pid, signal.SIGCONT)
            time.sleep(0.02)
        else:
            return


def check_counts(store: Store, photos: int) -> None:
    """Each photo counted exactly once, each patch sampled exactly once."""
    lens = store.lenses.page("local", before=None, limit=10)[0]
    with store.database.reading() as session:
        samples = session.scalar(select(func.count()).select_from(SampleRow))
        events = session.scalar(select(func.count()).where(EventRow.kind == "photo_added"))
    assert states(store) == ["counted"] * photos
    assert (lens.version, lens.photo_count, lens.sample_count) == (photos, photos, photos * CELLS * 3)
    assert (samples, events) == (photos * CELLS * 3, photos)
    assert done_patches(store) == photos * CELLS


def test_a_worker_in_doubt_ends_what_broke_and_nothing_else(
    settings: Settings, store: Store, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    engine = SimpleNamespace(holders=set, status=lambda _: "done")  # all jobs ended, whatever they did
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
    stop_outside_of_transactions(sleeper.pid, settings)
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
        if chance.random() < 0.5:
            os.killpg(victim.pid, signal.SIGKILL)  # the fork server with it; its children notice
        crew.kill(victim)
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
