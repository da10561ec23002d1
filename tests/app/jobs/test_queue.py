"""What we rely on in the library behind the job engine, and what outlasts an outage: every job."""

from __future__ import annotations

import errno
import itertools
import random
import sqlite3
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path
from unittest import mock

import psycopg
import pytest
from conftest import Steps
from dbos import DBOS
from deadline import stretched, until
from obstore import exceptions as stored
from sqlalchemy import exc
from starlette.testclient import TestClient

from app.jobs.queue import MAX_DEATHS, POLL_S, DbosEngine, Handler, durable, end_job, insist
from app.jobs.worker import Worker
from app.runtime.outage import is_outage
from app.runtime.settings import Settings
from app.store import Store
from app.store.jobs import Job, Kind
from app.store.owners import ANY_OWNER

KINDS = ("photo", "correction", "measure")
JOB = Job("correction", ("p", 1))
Start = Callable[..., DbosEngine]


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path / 'jobs.db'}"


@pytest.fixture
def ran() -> list[tuple[str, ...]]:
    """Give a list of what ran."""
    return []


@pytest.fixture
def start(url: str, ran: list[tuple[str, ...]]) -> Iterator[Start]:
    """Start an engine whose handlers note what they are asked for, but for those that are given."""

    def noting(kind: str) -> Handler:
        return lambda *arguments: ran.append((kind, *map(str, arguments)))

    def begin(**handlers: Handler) -> DbosEngine:
        engine = DbosEngine(url, "this-process", slots=2)
        engine.start({kind: noting(kind) for kind in KINDS} | handlers)
        return engine

    yield begin
    DBOS.destroy(destroy_registry=True)


def test_a_job_runs_once_however_often_it_is_asked_for(start: Start, ran: list[tuple[str, ...]]) -> None:
    engine, job = start(), Job("photo", ("p1", 1))
    assert engine.status(job) == "unknown"
    for _ in range(3):
        engine.enqueue(job)
    until(lambda: engine.status(job) == "done")
    engine._enqueued.clear()  # another process would not know that it was enqueued
    engine.enqueue(job)
    engine.enqueue(Job("photo", ("p1", 2)))

    until(lambda: len(ran) == 2)

    assert ran == [("photo", "p1", "1"), ("photo", "p1", "2")]


def test_photos_run_side_by_side_one_more_than_there_are_slots(start: Start) -> None:
    together, running, most = threading.Barrier(3, timeout=stretched(20)), set[int](), list[int]()

    def photo(number: int) -> None:
        running.add(number)
        most.append(len(running))
        together.wait()
        time.sleep(3.0 * POLL_S)  # so long that a fourth could begin
        running.remove(number)

    engine, jobs = start(photo=photo), [Job("photo", (n,)) for n in range(6)]
    for job in jobs:
        engine.enqueue(job)
    until(lambda: all(engine.status(job) == "done" for job in jobs))

    assert (together.broken, max(most)) == (False, 3)


def test_forgotten_jobs_leave_no_row(start: Start) -> None:
    engine, job = start(), Job("measure", ("lens", 3))
    engine.enqueue(job)
    until(lambda: engine.status(job) == "done")

    assert engine.forget(datetime.now(UTC) - timedelta(hours=1)) == 0
    assert engine.forget(datetime.now(UTC) + timedelta(hours=1)) == 1
    assert engine.status(job) == "unknown"


def dies(url: str, name: str, then: str) -> bool:
    """Say whether a worker process that asks for a job or takes one over died of it."""
    script = f"""
        import os, time
        from app.jobs.queue import DbosEngine
        from app.store.jobs import Job
        engine = DbosEngine({url!r}, {name!r}, slots=1)
        engine.start({{"correction": lambda *arguments: os.kill(os.getpid(), 9)}})
        {then}
        time.sleep(3)
        os._exit(0)
        """
    return subprocess.run([sys.executable, "-c", textwrap.dedent(script)], check=False).returncode == -9


ASKS = 'engine.enqueue(Job("correction", ("p", 1))); time.sleep(30)'
TAKES_OVER = "engine.take_over(set)"


def test_jobs_of_a_killed_worker_are_taken_over_only_when_somebody_says_so(
    start: Start, url: str, ran: list[tuple[str, ...]]
) -> None:
    assert dies(url, "a-worker-that-died", ASKS)
    engine = start()
    time.sleep(0.5)
    assert (engine.status(JOB), ran) == ("waiting", [])

    engine.take_over(set)

    until(lambda: ran == [("correction", "p", "1")])
    until(lambda: engine.status(JOB) == "done")


@pytest.mark.slow
def test_a_job_that_kills_all_workers_is_given_up(start: Start, url: str, ran: list[tuple[str, ...]]) -> None:
    assert dies(url, "a-worker-that-died", ASKS)
    for number in range(MAX_DEATHS["correction"] + 1):
        if not dies(url, f"worker-{number}", TAKES_OVER):
            break

    assert number == MAX_DEATHS["correction"]
    assert start().status(JOB) == "lost"
    assert ran == []


# --- what is away for a while costs time and no photo ------------------------------------------

AWAY = exc.OperationalError("SELECT", {}, psycopg.OperationalError("the connection is closed"))


def sqlite_error(code: int) -> exc.OperationalError:
    error = sqlite3.OperationalError("said by SQLite")
    error.sqlite_errorcode = code
    return exc.OperationalError("SELECT", {}, error)


@pytest.mark.parametrize(
    ("error", "is_so"),
    [
        (AWAY, True),
        (exc.TimeoutError("no connection within 30 s"), True),
        (sqlite_error(sqlite3.SQLITE_FULL), True),
        (stored.PermissionDeniedError("credentials are being changed"), True),
        (OSError(errno.ENOSPC, "no space"), True),
        (MemoryError(), True),
        (ValueError("of ours"), False),
        (FileNotFoundError(errno.ENOENT, "gone"), False),
        (stored.InvalidPathError("of ours"), False),
        (sqlite_error(sqlite3.SQLITE_ERROR), False),
    ],
)
def test_errors_of_the_machinery_are_known_from_ours(error: Exception, is_so: bool) -> None:
    assert is_outage(error) is is_so


def away(error: Exception, times: int = 10**6) -> mock.Mock:
    """Give a job that fails so often before it succeeds."""
    return mock.Mock(side_effect=itertools.chain(itertools.repeat(error, times), [None]), __name__="job")


@pytest.fixture
def pauses(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Let jobs wait in no time; tell how long they would have waited before each retry."""
    waited: list[float] = []
    monkeypatch.setattr("app.jobs.queue.monotonic", lambda: sum(waited))
    monkeypatch.setattr("app.jobs.queue.sleep", waited.append)
    monkeypatch.setattr("app.jobs.queue.uniform", random.Random(3).uniform)
    return waited


def test_pauses_grow_from_a_second_to_a_minute_until_hours_have_passed(pauses: list[float]) -> None:
    with pytest.raises(ConnectionResetError):
        insist(away(ConnectionResetError()), 3600.0)

    assert 1.0 <= min(pauses) < 2.0
    assert 45.0 < max(pauses) <= 60.0
    assert pauses[0] <= 2.0
    assert len({round(pause, 3) for pause in pauses}) == len(pauses)  # never in step with others
    assert 3600.0 < sum(pauses) <= 3660.0


@pytest.mark.parametrize(
    ("job", "runs", "state", "code"),
    [
        (away(AWAY, times=9), 10, "inspecting", None),
        (away(OSError(errno.ENOSPC, "full")), None, "failed", "outage"),  # after a night
        (away(KeyError("a bug"), times=10), 3, "failed", "internal_error"),
    ],
)
def test_a_job_outlasts_an_outage_of_hours_and_a_few_bugs(
    store: Store,
    steps: Steps,
    pauses: list[float],
    job: mock.Mock,
    runs: int | None,
    state: str,
    code: str | None,
) -> None:
    photo = steps.receive()
    steps.inspect(photo)

    durable("photo", job, partial(end_job, store))(photo.public_id, 1)

    ended = steps.fresh(photo)
    assert (ended.state, ended.error_code) == (state, code)
    assert job.call_count == (runs or len(pauses) + 1)
    assert sum(pauses) < 13 * 3600


def test_reading_ahead_pauses_in_an_outage_but_keeps_to_no_photo_for_ever(
    settings: Settings, steps: Steps, pauses: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    worker, photo, read = Worker(settings), steps.receive(), away(OSError(errno.EIO, "a bad block"))
    monkeypatch.setattr("app.jobs.worker.read_ahead", read)
    monkeypatch.setattr(worker._store.photos, "unread", lambda: photo)

    with pytest.raises(OSError, match="a bad block"):
        worker._read_ahead()

    assert read.call_count == len(pauses) + 1
    assert 60.0 < sum(pauses) < 180.0


def failed(steps: Steps, kind: Kind) -> str:
    """Let a photo or a correction fail; return its id."""
    if kind == "photo":
        works, row = steps.store.photos, steps.planned()
    else:
        params = {"method": "fast", "strength": 1.0, "output": {"format": "png8"}, "roi": None}
        works, row = steps.store.jobs, steps.correct(steps.counted(), **params)
        assert works.start(row.public_id, 1)
    assert works.fail(row.public_id, 1, "outage", "for a test")
    return row.public_id


@pytest.mark.parametrize("kind", ["photo", "correction"])
def test_a_failed_job_is_retried_as_another_job(client: TestClient, steps: Steps, kind: Kind) -> None:
    key = failed(steps, kind)

    answer, again = (client.post(f"/v1/jobs/{key}/retry") for _ in range(2))

    assert (answer.status_code, answer.json()["state"], answer.json()["error"]) == (202, "queued", None)
    assert (again.status_code, again.json()["code"]) == (409, "conflict")
    assert client.post("/v1/jobs/nothing/retry").status_code == 404
    assert Job(kind, (key, 2), "local") in steps.store.jobs.to_do()
    works = steps.store.photos if kind == "photo" else steps.store.jobs
    assert not works.fail(key, 1, "outage", "said late by the first try")
    assert works.start(key, epoch=2)


def test_a_retry_gives_way_to_the_same_wish_made_again(store: Store, steps: Steps) -> None:
    key = failed(steps, "correction")
    row = store.jobs.get(key, ANY_OWNER)
    store.jobs.correct(row.photo, row.lens, row.lens_version, row.params)

    assert not store.jobs.retry(key, ANY_OWNER)


def test_the_engines_file_is_in_wal_mode(start: Start, tmp_path: Path) -> None:
    start()
    with closing(sqlite3.connect(tmp_path / "jobs.db")) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)
