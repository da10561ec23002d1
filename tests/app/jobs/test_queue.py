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
from deadline import Deadline, stretched

from app.jobs.queue import MAX_DEATHS, DbosEngine, Handler
from app.store.jobs import Job, Kind

DEAD = "a-worker-that-died"


class Ran:
    """Handlers that note what ran."""

    def __init__(self) -> None:
        self.jobs: list[tuple[str, ...]] = []
        self.handlers: dict[Kind, Handler] = {
            kind: self._handler(kind) for kind in ("photo", "correction", "measure")
        }

    def _handler(self, kind: str) -> Handler:
        def run(*arguments: str | int) -> None:
            self.jobs.append((kind, *map(str, arguments)))

        return run


@pytest.fixture
def url(tmp_path: Path) -> str:
    return f"sqlite:///{tmp_path / 'jobs.db'}"


@pytest.fixture
def ran() -> Ran:
    return Ran()


@pytest.fixture
def engine(url: str, ran: Ran) -> Iterator[DbosEngine]:
    made = DbosEngine(url, "this-process", slots=2)
    made.start(ran.handlers)
    yield made
    DBOS.destroy(destroy_registry=True)


def until(condition: Callable[[], object], within_s: float = 20.0) -> None:
    deadline = Deadline(within_s)
    while not condition():
        assert not deadline.passed(), "it never happened"
        time.sleep(0.02)


def test_a_job_runs_once_however_often_it_is_asked_for(engine: DbosEngine, ran: Ran) -> None:
    job = Job("photo", ("p1", 1))
    for _ in range(3):
        engine.enqueue(job)
    until(lambda: engine.status(job) == "done")
    engine._enqueued.clear()  # another process would not know that it was enqueued
    engine.enqueue(job)
    engine.enqueue(Job("photo", ("p1", 2)))

    until(lambda: len(ran.jobs) == 2)

    assert ran.jobs == [("photo", "p1", "1"), ("photo", "p1", "2")]


def test_a_failing_job_ends_and_is_not_repeated(url: str) -> None:
    calls = []

    def photo(photo_id: str) -> None:
        calls.append(photo_id)
        raise RuntimeError("deliberate")

    engine = DbosEngine(url, "this-process", slots=2)
    engine.start({"photo": photo})
    try:
        engine.enqueue(Job("photo", ("p",)))
        until(lambda: engine.status(Job("photo", ("p",))) == "done")
    finally:
        DBOS.destroy(destroy_registry=True)

    assert calls == ["p"]


def test_photos_run_side_by_side_one_more_than_there_are_slots(url: str) -> None:
    together = threading.Barrier(3, timeout=stretched(20))
    engine = DbosEngine(url, "this-process", slots=2)
    engine.start({"photo": lambda *_: together.wait()})
    try:
        jobs = [Job("photo", (number,)) for number in range(3)]
        for job in jobs:
            engine.enqueue(job)
        until(lambda: all(engine.status(job) == "done" for job in jobs))
    finally:
        DBOS.destroy(destroy_registry=True)

    assert not together.broken


def test_the_engines_file_is_in_wal_mode(engine: DbosEngine, tmp_path: Path) -> None:
    with closing(sqlite3.connect(tmp_path / "jobs.db")) as connection:
        assert connection.execute("PRAGMA journal_mode").fetchone() == ("wal",)


def test_forgotten_jobs_leave_no_row(engine: DbosEngine) -> None:
    job = Job("measure", ("lens", 3))
    engine.enqueue(job)
    until(lambda: engine.status(job) == "done")

    assert engine.forget(datetime.now(UTC) - timedelta(hours=1)) == 0
    assert engine.forget(datetime.now(UTC) + timedelta(hours=1)) == 1
    assert engine.status(job) == "unknown"


def die_in_a_job(url: str, executor_id: str = DEAD) -> None:
    script = textwrap.dedent(
        f"""
        import os, time
        from app.jobs.queue import DbosEngine
        from app.store.jobs import Job
        engine = DbosEngine({url!r}, {executor_id!r}, slots=1)
        engine.start({{"correction": lambda *arguments: os.kill(os.getpid(), 9)}})
        engine.enqueue(Job("correction", ("p", 1)))
        time.sleep(30)
        """
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == -9


def test_jobs_of_a_killed_worker_are_taken_over_only_when_somebody_says_so(url: str, ran: Ran) -> None:
    die_in_a_job(url)
    job = Job("correction", ("p", 1))
    engine = DbosEngine(url, "this-process", slots=2)
    engine.start(ran.handlers)
    try:
        time.sleep(0.5)
        held_before = (engine.status(job), list(ran.jobs))
        engine.take_over(set)
        until(lambda: ran.jobs == [("correction", "p", "1")])
        until(lambda: engine.status(job) == "done")
    finally:
        DBOS.destroy(destroy_registry=True)

    assert held_before == ("waiting", [])


@pytest.mark.slow
def test_a_job_that_kills_every_worker_is_given_up(url: str, ran: Ran) -> None:
    die_in_a_job(url)
    for number in range(MAX_DEATHS["correction"] + 1):
        script = textwrap.dedent(
            f"""
            import os, time
            from app.jobs.queue import DbosEngine
            engine = DbosEngine({url!r}, "worker-{number}", slots=1)
            engine.start({{"correction": lambda *arguments: os.kill(os.getpid(), 9)}})
            engine.take_over(set)
            time.sleep(3)
            os._exit(0)
            """
        )
        if subprocess.run([sys.executable, "-c", script], check=False).returncode == 0:
            break
    engine = DbosEngine(url, "this-process", slots=2)
    engine.start(ran.handlers)
    try:
        status = engine.status(Job("correction", ("p", 1)))
    finally:
        DBOS.destroy(destroy_registry=True)

    assert number == MAX_DEATHS["correction"]
    assert status == "lost"
    assert ran.jobs == []


def test_a_job_that_nobody_asked_for_is_unknown(engine: DbosEngine) -> None:
    assert engine.status(Job("photo", ("never", 1))) == "unknown"
