"""A database, a storage or a disk that is away for a while costs time and no photo."""

from __future__ import annotations

import errno
import random
import sqlite3
from functools import partial

import psycopg
import pytest
from conftest import Steps
from obstore import exceptions as stored
from sqlalchemy import exc
from starlette.testclient import TestClient

from app.jobs.queue import durable, end_job, insist
from app.jobs.worker import Worker
from app.runtime.outage import is_outage
from app.runtime.settings import Settings
from app.store import Store
from app.store.jobs import Job, Kind
from app.store.owners import ANY_OWNER

AWAY = exc.OperationalError("SELECT", {}, psycopg.OperationalError("the connection is closed"))


def sqlite_error(code: int) -> exc.OperationalError:
    error = sqlite3.OperationalError("said by SQLite")
    error.sqlite_errorcode = code
    return exc.OperationalError("SELECT", {}, error)


@pytest.mark.parametrize(
    ("error", "is_so"),
    [
        (AWAY, True),
        (exc.InterfaceError("SELECT", {}, psycopg.InterfaceError("the connection is lost")), True),
        (exc.TimeoutError("no connection within 30 s"), True),
        (sqlite_error(sqlite3.SQLITE_BUSY), True),
        (sqlite_error(sqlite3.SQLITE_FULL), True),
        (stored.GenericError("error sending request"), True),
        (stored.PermissionDeniedError("credentials are being changed"), True),
        (OSError(errno.ENOSPC, "no space"), True),
        (ConnectionRefusedError(), True),
        (MemoryError(), True),
        (ValueError("of ours"), False),
        (FileNotFoundError(errno.ENOENT, "gone"), False),
        (stored.InvalidPathError("of ours"), False),
        (exc.IntegrityError("INSERT", {}, Exception("of ours")), False),
        (sqlite_error(sqlite3.SQLITE_ERROR), False),
    ],
)
def test_errors_of_the_machinery_are_known_from_ours(error: Exception, is_so: bool) -> None:
    assert is_outage(error) is is_so


class Away:
    """A job that fails so often before it succeeds."""

    def __init__(self, error: Exception, times: int = 10**6) -> None:
        self.error, self.left, self.runs = error, times, 0
        self.__name__ = "job"

    def __call__(self, *arguments: object) -> None:
        self.runs += 1
        if self.left:
            self.left -= 1
            raise self.error


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
        insist(Away(ConnectionResetError()), 3600.0)

    assert 1.0 <= min(pauses) < 2.0
    assert 45.0 < max(pauses) <= 60.0
    assert pauses[0] <= 2.0
    assert len({round(pause, 3) for pause in pauses}) == len(pauses)  # never in step with others
    assert 3600.0 < sum(pauses) <= 3660.0


@pytest.mark.parametrize(
    ("job", "runs", "state", "code"),
    [
        (Away(AWAY, times=9), 10, "inspecting", None),
        (Away(OSError(errno.ENOSPC, "full")), None, "failed", "outage"),  # after a night
        (Away(KeyError("a bug"), times=10), 3, "failed", "internal_error"),
    ],
)
def test_a_job_outlasts_an_outage_of_hours_and_a_few_bugs(
    store: Store,
    steps: Steps,
    pauses: list[float],
    job: Away,
    runs: int | None,
    state: str,
    code: str | None,
) -> None:
    photo = steps.receive()
    steps.inspect(photo)

    durable("photo", job, partial(end_job, store))(photo.public_id, 1)

    ended = steps.fresh(photo)
    assert (ended.state, ended.error_code) == (state, code)
    assert job.runs == (runs or len(pauses) + 1)
    assert sum(pauses) < 13 * 3600


def test_reading_ahead_pauses_in_an_outage_but_keeps_to_no_photo_for_ever(
    settings: Settings, steps: Steps, pauses: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    worker, photo, read = Worker(settings), steps.receive(), Away(OSError(errno.EIO, "a bad block"))
    monkeypatch.setattr("app.jobs.worker.read_ahead", read)
    monkeypatch.setattr(worker._store.photos, "unread", lambda: photo)

    with pytest.raises(OSError, match="a bad block"):
        worker._read_ahead()

    assert read.runs == len(pauses) + 1
    assert 60.0 < sum(pauses) < 180.0


# --- retries ----------------------------------------------------------------------------------


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
def test_a_failed_job_is_retried_as_another_job_of_the_engine(
    client: TestClient, steps: Steps, kind: Kind
) -> None:
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
