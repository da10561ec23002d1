"""Many wait for jobs: the tables are looked at once for all of them, and each hears of its own job."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Hashable
from typing import Any

import pytest
from starlette.testclient import TestClient

from app.http.job_watch import Watch
from app.main import create_app
from app.routes import jobs
from app.runtime.settings import Settings
from app.store import Store
from app.store.access.owners import ANY_OWNER
from app.store.jobs import JobStore


def test_two_hundred_that_wait_cost_no_more_looks_than_one() -> None:
    looks: list[int] = []
    state: dict[str, Hashable] = {f"j{k}": 0 for k in range(200)}

    def look(ids: list[str]) -> dict[str, Hashable]:
        looks.append(len(ids))
        return {job_id: state[job_id] for job_id in ids}

    async def wait_for(watch: Watch, job_id: str, woken: list[str]) -> None:
        with watch.of(job_id) as waiting:
            await waiting.changed(60)  # the first look
            await waiting.changed(60)
            woken.append(job_id)

    async def run() -> tuple[list[str], int]:
        watch, woken = Watch(look), list[str]()
        tasks = [asyncio.create_task(wait_for(watch, job_id, woken)) for job_id in state]
        while not looks:  # noqa: ASYNC110 - the look runs in a thread
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.3)
        state["j7"] = 1
        while not woken:  # noqa: ASYNC110 - any of them
            await asyncio.sleep(0.01)
        first = list(woken)
        for job_id in state:
            state[job_id] = 2
        await asyncio.gather(*tasks[:7], *tasks[8:])
        count = len(looks)
        await asyncio.sleep(0.3)
        return first, len(looks) - count

    first, after = asyncio.run(run())

    assert first == ["j7"]
    assert max(looks) == 200
    assert looks.count(200) >= 1
    assert after <= 1  # nobody waits any more, nobody looks


def test_a_change_of_any_job_is_seen(store: Store, steps: Any) -> None:
    photo, marks = steps.receive(), JobStore(store.database).marks
    seen = [marks([photo.public_id, "nothing"])]
    steps.inspect(photo)
    seen.append(marks([photo.public_id]))
    steps.plan(photo)
    seen.append(marks([photo.public_id]))
    steps.estimate(photo, (0,))
    seen.append(marks([photo.public_id]))
    store.photos.cancel(photo.public_id, ANY_OWNER)
    seen.append(marks([photo.public_id]))
    store.photos.delete(photo.public_id, "local")

    assert len({str(mark) for mark in seen}) == len(seen)
    assert marks([photo.public_id]) == {}


def test_waiting_clients_read_their_job_only_when_it_changes(
    settings: Settings, store: Store, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    patient = settings.model_copy(update={"long_poll_seconds": 20.0})
    photo, reads = steps.receive(), []
    really = jobs.find_job

    def find_job(call: Any, job_id: str) -> Any:
        reads.append(job_id)
        return really(call, job_id)

    monkeypatch.setattr(jobs, "find_job", find_job)
    answers: list[str] = []
    with TestClient(create_app(patient)) as client:

        def wait() -> None:
            answers.append(client.get(f"/v1/jobs/{photo.public_id}?wait=20").json()["state"])

        threads = [threading.Thread(target=wait) for _ in range(5)]
        for thread in threads:
            thread.start()
        while len(reads) < 10:  # each has read its job, and again after the first look
            time.sleep(0.01)
        time.sleep(0.5)
        before = len(reads)
        store.photos.cancel(photo.public_id, ANY_OWNER)
        for thread in threads:
            thread.join()

    assert before == 10
    assert answers == ["cancelled"] * 5
