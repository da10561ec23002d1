"""The client sends again what may be sent again, and tells how far an upload is."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import pytest
from starlette.testclient import TestClient

from app.client import Client
from app.client_retries import Retrying

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other


class Flaky(httpx2.BaseTransport):
    """Answers in turn; an exception is raised."""

    def __init__(self, *answers: httpx2.Response | Exception) -> None:
        self.answers, self.asked = list(answers), 0

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        self.asked += 1
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


def pauses_of(flaky: Flaky, method: str = "GET", **options: Any) -> tuple[int, list[float]]:
    pauses: list[float] = []
    with httpx2.Client(transport=Retrying(3, flaky, sleep=pauses.append), base_url="http://x") as http:
        return http.request(method, "/", **options).status_code, pauses


def test_a_service_that_restarts_is_asked_again() -> None:
    status, pauses = pauses_of(Flaky(httpx2.ConnectError("no"), httpx2.Response(502), httpx2.Response(200)))

    assert (status, pauses) == (200, [0.5, 1.0])


def test_a_busy_service_is_left_alone_for_as_long_as_it_says() -> None:
    busy = httpx2.Response(429, headers={"Retry-After": "7"})

    assert pauses_of(Flaky(busy, httpx2.Response(202)), "POST", json={}) == (202, [7.0])


def test_a_refusal_for_an_hour_is_handed_on() -> None:
    busy = httpx2.Response(503, headers={"Retry-After": "3600"})

    assert pauses_of(Flaky(busy)) == (503, [])


def test_at_last_the_answer_is_handed_on() -> None:
    assert pauses_of(Flaky(*[httpx2.Response(503) for _ in range(4)])) == (503, [0.5, 1.0, 2.0])


def test_what_may_have_begun_is_not_sent_twice() -> None:
    flaky = Flaky(httpx2.ReadError("gone"))

    with pytest.raises(httpx2.ReadError):
        pauses_of(flaky, "POST", json={})
    assert flaky.asked == 1


def test_an_upload_that_was_refused_is_not_sent_from_its_middle() -> None:
    def pieces() -> Iterator[bytes]:
        yield b"x"

    assert pauses_of(Flaky(httpx2.Response(503)), "POST", content=pieces()) == (503, [])


def test_an_upload_says_how_far_it_is(client: TestClient, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\x00" + bytes(600_000))
    progress: list[tuple[int, int]] = []

    Client(http=client).upload(path, calibrate=False, on_progress=lambda *far: progress.append(far))

    assert progress == [(600_004, 600_004)]
