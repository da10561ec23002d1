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
from app.store.jobs import Job
from app.store.owners import ANY_OWNER
from app.store.tables import PhotoRow

AWAY = exc.OperationalError("SELECT", {}, psycopg.OperationalError("the connection is closed"))


def sqlite_error(code: int) -> exc.OperationalError:
    error = sqlite3.OperationalError("said by SQLite")
    error.sqlite_errorcode = code
    return exc.OperationalError("SELECT", {}, error)


@pytest.mark.parametrize(
    "error",
    [
        AWAY,
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
        FileNotFoundError(errno.ENOENT, "gone"),
        stored.InvalidPathError("of ours"),
        exc.IntegrityError("INSERT", {}, Exception("of ours")),
        sqlite_error(sqlite3.SQLITE_ERROR),
    ],
)
def test_errors_of_ours_are_no_outage(error: Exception) -> None:
    assert not is_outage(error)


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


@pytest.fixture
def failed_photo(steps: Steps) -> PhotoRow:
    photo = steps.receive()
    steps.inspect(photo)
    assert steps.store.photos.fail(photo.public_id, 1, "outage", "for a test")
    return photo


@pytest.fixture
def failed_correction(steps: Steps) -> str:
    params = {"method": "fast", "strength": 1.0, "output": {"format": "png8"}, "roi": None}
    correction = steps.correct(steps.counted(), **params)
    assert steps.store.jobs.start(correction.public_id, 1)
    assert steps.store.jobs.fail(correction.public_id, 1, "outage", "for a test")
    return correction.public_id


def test_a_failed_photo_is_retried_by_one_call(
    client: TestClient, store: Store, failed_photo: PhotoRow
) -> None:
    address = f"/v1/jobs/{failed_photo.public_id}/retry"
    answer = client.post(address)

    assert (answer.status_code, answer.json()["state"], answer.json()["error"]) == (202, "queued", None)
    assert Job("photo", (failed_photo.public_id, 2), "local") in store.jobs.to_do()
    again = client.post(address)
    assert (again.status_code, again.json()["code"]) == (409, "conflict")
    assert client.post("/v1/jobs/nothing/retry").status_code == 404


def test_a_failed_correction_is_retried_as_another_job_of_the_engine(
    client: TestClient, store: Store, failed_correction: str
) -> None:
    answer = client.post(f"/v1/jobs/{failed_correction}/retry")

    assert (answer.status_code, answer.json()["state"]) == (202, "queued")
    assert Job("correction", (failed_correction, 2), "local") in store.jobs.to_do()
    assert not store.jobs.fail(failed_correction, 1, "outage", "said late by the first try")
    assert store.jobs.start(failed_correction, epoch=2)


def test_a_retry_gives_way_to_the_same_wish_made_again(store: Store, failed_correction: str) -> None:
    row = store.jobs.get(failed_correction, ANY_OWNER)
    store.jobs.correct(row.photo, row.lens, row.lens_version, row.params)

    assert not store.jobs.retry(failed_correction, ANY_OWNER)
