"""The contract that the job engine must keep: it pins what we rely on in the library behind it."""

from __future__ import annotations

import sqlite3
import subprocess
import sys
import textwrap
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from dbos import DBOS
from deadline import stretched, until

from app.jobs.queue import MAX_DEATHS, DbosEngine, Handler
from app.store.jobs import Job

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


def test_a_failing_job_ends_and_is_not_repeated(start: Start) -> None:
    calls = []

    def photo(photo_id: str) -> None:
        calls.append(photo_id)
        raise RuntimeError("deliberate")

    engine, job = start(photo=photo), Job("photo", ("p",))
    engine.enqueue(job)
    until(lambda: engine.status(job) == "done")

    assert calls == ["p"]


def test_photos_run_side_by_side_one_more_than_there_are_slots(start: Start) -> None:
    together = threading.Barrier(3, timeout=stretched(20))
    engine, jobs = start(photo=lambda *_: together.wait()), [Job("photo", (n,)) for n in range(3)]
    for job in jobs:
        engine.enqueue(job)
    until(lambda: all(engine.status(job) == "done" for job in jobs))

    assert not together.broken


def test_the_engines_file_is_in_wal_mode(start: Start, tmp_path: Path) -> None:
    start()
    with closing(sqlite3.connect(tmp_path / "jobs.db")) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


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
def test_a_job_that_kills_every_worker_is_given_up(
    start: Start, url: str, ran: list[tuple[str, ...]]
) -> None:
    assert dies(url, "a-worker-that-died", ASKS)
    for number in range(MAX_DEATHS["correction"] + 1):
        if not dies(url, f"worker-{number}", TAKES_OVER):
            break

    assert number == MAX_DEATHS["correction"]
    assert start().status(JOB) == "lost"
    assert ran == []
