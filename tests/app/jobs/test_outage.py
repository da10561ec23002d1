"""A database, a storage or a disk that is away for a while costs time and no photo."""

from __future__ import annotations

import contextlib
import errno
import random
import sqlite3
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import Any

import psycopg
import pytest
from crew import Crew, check_counts, states, until
from obstore import exceptions as stored
from servers import postgres
from sqlalchemy import exc
from starlette.testclient import TestClient
from uploads import receive

from app.blobs.storage import Storage
from app.jobs.queue import durable, end_job, insist
from app.jobs.worker import Worker
from app.runtime.outage import is_outage
from app.runtime.settings import Settings
from app.store import LensName, Store
from app.store.database import new_id, upgrade
from app.store.jobs import Job
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow
from lensmodel.cli.ending import InterruptedByUser

PATIENCE_S = 180.0
"""Of an idle machine, see `deadline`."""


def sqlite_error(code: int) -> exc.OperationalError:
    error = sqlite3.OperationalError("said by SQLite")
    error.sqlite_errorcode = code
    return exc.OperationalError("SELECT", {}, error)


@pytest.mark.parametrize(
    "error",
    [
        exc.OperationalError("SELECT", {}, psycopg.OperationalError("the connection is closed")),
        exc.InterfaceError("SELECT", {}, psycopg.InterfaceError("the connection is lost")),
        exc.TimeoutError("no connection within 30 s"),
        sqlite_error(sqlite3.SQLITE_BUSY),
        sqlite_error(sqlite3.SQLITE_FULL),
        stored.GenericError("error sending request"),
        stored.PermissionDeniedError("credentials are being changed"),
        OSError(errno.ENOSPC, "no space"),
        ConnectionRefusedError(),
        MemoryError(),
    ],
)
def test_errors_of_the_machinery_are_known(error: Exception) -> None:
    assert is_outage(error)


@pytest.mark.parametrize(
    "error",
    [
        ValueError("of ours"),
        KeyError("of ours"),
        FileNotFoundError(errno.ENOENT, "gone"),
        stored.InvalidPathError("of ours"),
        exc.IntegrityError("INSERT", {}, Exception("of ours")),
        sqlite_error(sqlite3.SQLITE_ERROR),
    ],
)
def test_errors_of_ours_are_no_outage(error: Exception) -> None:
    assert not is_outage(error)


def pauses_of(monkeypatch: pytest.MonkeyPatch, error: Exception, outage_s: float) -> list[float]:
    """Return how long a job that always fails waits before each retry."""
    pauses: list[float] = []
    monkeypatch.setattr("app.jobs.queue.monotonic", lambda: sum(pauses))
    monkeypatch.setattr("app.jobs.queue.sleep", pauses.append)
    monkeypatch.setattr("app.jobs.queue.uniform", random.Random(3).uniform)
    with pytest.raises(type(error)):
        insist(Away(error, times=10**6), outage_s)
    return pauses


def test_pauses_grow_from_a_second_to_a_minute_until_hours_have_passed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    pauses = pauses_of(monkeypatch, ConnectionResetError(), 3600.0)

    assert 1.0 <= min(pauses) < 2.0
    assert 45.0 < max(pauses) <= 60.0
    assert pauses[0] <= 2.0
    assert len({round(pause, 3) for pause in pauses}) == len(pauses)  # never in step with others
    assert 3600.0 < sum(pauses) <= 3660.0


def test_what_nobody_foresaw_is_tried_three_times(monkeypatch: pytest.MonkeyPatch) -> None:
    first, second = pauses_of(monkeypatch, KeyError(), 3600.0)

    assert 1.0 <= first <= 2.0
    assert 1.0 <= second <= 4.0


class Away:
    """A job that fails so often before it succeeds."""

    def __init__(self, error: Exception, times: int) -> None:
        self.error, self.left, self.runs = error, times, 0
        self.__name__ = "job"

    def __call__(self, *arguments: object) -> None:
        self.runs += 1
        if self.left:
            self.left -= 1
            raise self.error


@pytest.fixture
def worker(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Worker:
    monkeypatch.setattr("app.jobs.queue.sleep", lambda _: None)
    return Worker(settings)


def test_a_job_outlasts_an_outage(worker: Worker, store: Store, steps: Any) -> None:
    photo = steps.receive()
    job = Away(exc.OperationalError("SELECT", {}, psycopg.OperationalError("away")), times=9)

    durable("photo", job, partial(end_job, store))(photo.public_id, 1)

    assert job.runs == 10
    assert steps.fresh(photo).state == "received"


def test_a_job_that_waited_in_vain_ends_as_such(
    worker: Worker, store: Store, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.jobs.queue.OUTAGE_S", 0.0)
    photo = steps.receive()
    steps.inspect(photo)

    durable("photo", Away(OSError(errno.ENOSPC, "full"), times=10**6), partial(end_job, store))(
        photo.public_id, 1
    )

    failed = steps.fresh(photo)
    assert (failed.state, failed.error_code) == ("failed", "outage")


def test_a_bug_ends_the_job_after_three_tries(store: Store, steps: Any) -> None:
    photo, job = steps.receive(), Away(KeyError("a bug"), times=10)

    durable("photo", job, partial(end_job, store))(photo.public_id, 1)

    assert (steps.fresh(photo).error_code, job.runs) == ("internal_error", 3)


def test_reading_ahead_pauses_in_an_outage_but_keeps_to_no_photo_for_ever(
    worker: Worker, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pauses, photo, read = list[float](), steps.receive(), Away(OSError(errno.EIO, "a bad block"), 10**6)
    monkeypatch.setattr("app.jobs.queue.monotonic", lambda: sum(pauses))
    monkeypatch.setattr("app.jobs.queue.sleep", pauses.append)
    monkeypatch.setattr("app.jobs.worker.read_ahead", read)
    monkeypatch.setattr(worker._store.photos, "unread", lambda: photo)

    with pytest.raises(OSError, match="a bad block"):
        worker._read_ahead()

    assert read.runs == len(pauses) + 1
    assert 60.0 < sum(pauses) < 180.0


def test_a_worker_keeps_its_lease_while_its_engine_starts(
    worker: Worker, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Slow:
        """As on a machine that is busy: the tables of the jobs take longer than a lease."""

        def start(self, handlers: object) -> None:
            del handlers
            first = store.jobs.workers()[0].heartbeat_at
            end = time.monotonic() + PATIENCE_S
            while store.jobs.workers()[0].heartbeat_at == first and time.monotonic() < end:
                time.sleep(0.02)
            beats.append(store.jobs.workers()[0].heartbeat_at > first)
            raise InterruptedByUser(15)

    beats: list[bool] = []
    monkeypatch.setattr(worker, "_engine", Slow())
    monkeypatch.setattr(worker, "_settings", worker._settings.model_copy(update={"lease_seconds": 1.0}))

    with pytest.raises(InterruptedByUser):
        worker._begin()

    assert beats == [True]


def failed_photo(store: Store, steps: Any, code: str = "outage") -> PhotoRow:
    photo: PhotoRow = steps.receive()
    steps.inspect(photo)
    assert store.photos.fail(photo.public_id, 1, code, "for a test")
    return photo


def failed_correction(store: Store, steps: Any, strength: float = 1.0) -> str:
    photo = steps.counted()
    params = {"method": "fast", "strength": strength, "output": {"format": "png8"}, "roi": None}
    correction = steps.correct(photo, **params)
    assert store.jobs.start(correction.public_id, 1)
    assert store.jobs.fail(correction.public_id, 1, "outage", "for a test")
    return correction.public_id


def test_a_failed_photo_is_retried_by_one_call(client: TestClient, store: Store, steps: Any) -> None:
    photo = failed_photo(store, steps)

    answer = client.post(f"/v1/jobs/{photo.public_id}/retry")

    assert (answer.status_code, answer.json()["state"], answer.json()["error"]) == (202, "queued", None)
    assert Job("photo", (photo.public_id, 2), "local") in store.jobs.to_do()
    again = client.post(f"/v1/jobs/{photo.public_id}/retry")
    assert (again.status_code, again.json()["code"]) == (409, "conflict")


def test_a_failed_correction_is_retried_as_another_job_of_the_engine(
    client: TestClient, store: Store, steps: Any
) -> None:
    correction = failed_correction(store, steps)

    answer = client.post(f"/v1/jobs/{correction}/retry")

    assert (answer.status_code, answer.json()["state"]) == (202, "queued")
    assert Job("correction", (correction, 2), "local") in store.jobs.to_do()
    assert not store.jobs.fail(correction, 1, "outage", "said late by the first try")
    assert store.jobs.start(correction, epoch=2)


def test_a_retry_gives_way_to_the_same_wish_made_again(client: TestClient, store: Store, steps: Any) -> None:
    correction = failed_correction(store, steps)
    row = store.jobs.get(correction, ANY_OWNER)
    assert row is not None
    store.jobs.correct(row.photo, row.lens, row.lens_version, row.params)

    assert client.post(f"/v1/jobs/{correction}/retry").status_code == 409


def test_an_unknown_job_cannot_be_retried(client: TestClient) -> None:
    assert client.post("/v1/jobs/nothing/retry").status_code == 404


# --- real workers -----------------------------------------------------------------------------


@contextmanager
def hired(settings: Settings) -> Iterator[subprocess.Popen[bytes]]:
    with contextlib.closing(Crew(settings, settings.data_dir / "workers.log")) as crew:
        yield crew.hire()


def send(store: Store, storage: Storage, count: int, first: int = 0) -> list[str]:
    ids = []
    for number in range(first, first + count):
        public_id = new_id()
        store.photos.expect(f"photos/{public_id}/", within=timedelta(minutes=1))
        storage.put(f"photos/{public_id}/original", b"a photo")
        receive(store, public_id, sha256=f"{number:064x}")
        ids.append(public_id)
    return ids


def test_photos_outlast_a_storage_that_is_away(settings: Settings, store: Store, tmp_path: Path) -> None:
    settings = settings.model_copy(update={"worker_slots": 2})
    storage = Storage(settings.storage)
    assert storage.folder is not None
    aside = storage.folder.with_name("aside")
    log = settings.data_dir / "workers.log"
    with hired(settings):
        send(store, storage, 1)
        until(
            lambda: set(states(store)) == {"counted"}, log
        )  # a worker without any photo founds a missing folder
        storage.folder.rename(aside)
        send(store, Storage(f"file://{aside}"), 2, first=1)
        until(lambda: log.read_text().count("is away") >= 4, log)
        seen = states(store)
        aside.rename(storage.folder)
        until(lambda: set(states(store)) == {"counted"}, log)

    assert "failed" not in seen
    check_counts(store, 3)


@pytest.mark.slow
def test_workers_that_start_while_the_storage_is_away_wait_for_it(settings: Settings, store: Store) -> None:
    settings = settings.model_copy(update={"worker_slots": 2})
    storage = Storage(settings.storage)
    assert storage.folder is not None
    send(store, storage, 2)
    aside = storage.folder.with_name("aside")
    storage.folder.rename(aside)
    storage.folder.mkdir()  # as where nothing is mounted
    log = settings.data_dir / "workers.log"
    with hired(settings):
        until(lambda: log.read_text().count("is away") >= 2, log)
        seen, left = states(store), list(storage.folder.iterdir())
        storage.folder.rmdir()
        aside.rename(storage.folder)
        until(lambda: set(states(store)) == {"counted"}, log)

    assert "failed" not in seen
    assert left == []
    check_counts(store, 2)


@pytest.mark.tools
@pytest.mark.slow
def test_photos_outlast_a_database_that_is_away(tmp_path: Path) -> None:
    with postgres() as server:
        settings = Settings(
            data_dir=tmp_path / "data",
            database_url=server.url("app"),
            storage_url=f"file://{tmp_path}/blobs",
            worker_slots=2,
            min_free_mb=0,
        )
        settings.data_dir.mkdir()
        store = Store(settings)
        upgrade(store.database)
        send(store, Storage(settings.storage), 6)
        log = settings.data_dir / "workers.log"

        with hired(settings) as worker:
            until(lambda: "estimating" in states(store), log)
            server.stop()
            time.sleep(9.0)  # long enough for three quick tries
            server.start()
            until(lambda: set(states(store)) == {"counted"}, log)
            survived = worker.poll() is None

        check_counts(store, 6)
        assert survived
        store.close()


def test_a_lens_named_by_hand_keeps_its_name_after_a_retry(
    client: TestClient, store: Store, steps: Any
) -> None:
    photo = failed_photo(store, steps)
    assert store.photos.change([photo.public_id], "local", {}, lens=LensName(None, None, None, label="mine"))
    lens_id = steps.fresh(photo).given["lens_id"]
    store.photos.fail(photo.public_id, 2, "outage", "again")

    client.post(f"/v1/jobs/{photo.public_id}/retry")

    assert steps.fresh(photo).given["lens_id"] == lens_id


def test_a_worker_that_gets_no_connection_for_a_lease_stops(
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
