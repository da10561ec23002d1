"""The service around the resources: probes, problems, request ids, and its own description."""

from __future__ import annotations

import random
import re
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any
from urllib.parse import quote

import pytest
from obstore.exceptions import GenericError
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient
from states import TIFF, Steps, refusal, services_of

from app.http.errors import STATUS_OF_CODE, status_of
from app.main import create_app
from app.routes import health
from app.runtime.settings import Settings
from app.store import Store
from lensmodel.core import errors


def test_readiness_is_looked_up_once_and_changes_nothing(
    client: TestClient, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = services_of(client)
    written: list[str] = []
    monkeypatch.setattr(services.storage, "put", lambda key, _: written.append(key))
    looks: list[str] = []
    usable = services.storage.check_usable
    monkeypatch.setattr(services.storage, "check_usable", lambda: looks.append("") or usable())

    answers = [client.get("/readyz").json()["checks"]["storage"] for _ in range(5)]

    assert (answers, written, len(looks)) == (["ok"] * 5, [], 1)
    folder = Path(settings.storage.removeprefix("file://"))
    folder.rename(folder.with_name("aside"))
    services.readiness._until = 0.0
    assert "away" in client.get("/readyz").json()["checks"]["storage"]
    assert not folder.exists()


def test_ready_needs_schema_storage_and_a_live_worker(
    settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(health, "FRESH_S", 0.0)
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        before = client.get("/readyz")
        store.jobs.register("w")
        after = client.get("/readyz")
        store.jobs.bury("w")
        assert client.get("/readyz").status_code == 503

    checks = before.json()["checks"]
    assert (before.status_code, checks["schema"], checks["storage"]) == (503, "ok", "ok")
    assert "lensmodel worker" in checks["worker"]
    assert (after.status_code, after.json()["status"]) == (200, "ready")


def test_an_empty_database_is_not_ready_and_answers_with_a_problem(settings: Settings) -> None:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        assert client.get("/readyz").json()["checks"]["schema"] != "ok"
        assert refusal(client.get("/v1/photos")) == (503, "busy")


def test_health_formats_limits_and_version_are_told(client: TestClient, settings: Settings) -> None:
    formats = client.get("/v1/formats").json()

    assert client.get("/healthz").json() == {"status": "ok"}
    assert {"fast", "standard", "paper"} <= set(formats["methods"])
    assert "default" in formats["estimators"]
    assert client.get("/v1/limits").json()["max_upload_bytes"] == settings.max_upload_mb << 20
    assert client.get("/v1/version").json()["api"] == "v1"


@pytest.mark.parametrize(
    ("error", "told", "retry"),
    [
        (RuntimeError("the secret cause"), (500, "internal_error"), None),
        (OperationalError("SELECT", {}, Exception("the secret database is locked")), (503, "busy"), "5"),
    ],
)
def test_our_own_fault_and_a_locked_database_are_problems_without_their_cause(
    client: TestClient,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    told: tuple[int, str],
    retry: str | None,
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr(services_of(client).store.photos, "page", broken)
    answer = client.get("/v1/photos", headers={"X-Request-ID": "abc-1"})

    assert refusal(answer) == told
    assert "secret" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers.get("retry-after") == retry
    assert answer.json()["request_id"] == answer.headers["x-request-id"] == "abc-1"


@pytest.mark.parametrize(
    ("said", "told"),
    [
        ("Generic LocalFileSystem error: No space left on device (os error 28)", (507, "quota_exceeded")),
        ("Generic S3 error: 503 Service Unavailable", (503, "busy")),
    ],
)
def test_a_storage_that_is_full_or_away_is_told_so(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, said: str, told: tuple[int, str]
) -> None:
    @asynccontextmanager
    async def broken(key: str) -> AsyncIterator[None]:
        raise GenericError(said)
        yield

    monkeypatch.setattr(services_of(client).storage, "writer", broken)

    assert refusal(client.post("/v1/photos", content=TIFF)) == told
    assert client.get("/v1/photos").json()["items"] == []


def test_a_name_that_a_stranger_may_own_is_not_served(client: TestClient) -> None:
    ours = ("localhost:8000", "127.0.0.1", "[::1]:8000")
    hosts = (*ours, "rebound.example.org", "127.0.0.1.example.org:8000")

    answers = {host: client.get("/v1/photos", headers={"Host": host}).status_code for host in hosts}

    assert answers == dict.fromkeys(hosts, 400) | dict.fromkeys(ours, 200)


def test_a_request_id_is_echoed_if_it_is_a_plain_word(client: TestClient) -> None:
    for sent in ("my.id-7", "", "a b", "x" * 65, "naïve", "a;b"):
        echoed = client.get("/healthz", headers=[(b"X-Request-ID", sent.encode())]).headers["x-request-id"]

        assert echoed
        assert (echoed == sent) == (sent == "my.id-7"), sent


def _all_kinds(kind: type[Exception]) -> list[type[Exception]]:
    return [kind, *(deeper for child in kind.__subclasses__() for deeper in _all_kinds(child))]


def test_every_error_of_the_library_has_a_status_and_its_code_the_same_one() -> None:
    for kind in _all_kinds(errors.LensModelError)[1:]:
        if kind.__module__ != "lensmodel.core.errors":
            continue
        status = status_of(kind("x"))
        assert 400 <= status < 500, kind
        if kind is not errors.NoUsablePatchesError:  # as an answer "not yet", as the end of a job "never"
            assert STATUS_OF_CODE[kind.code] == status, kind  # type: ignore[attr-defined] # all have one


def operations(client: TestClient) -> list[tuple[str, str, dict[str, Any]]]:
    """Return address, method and description of all that programs may ask."""
    paths = client.get("/openapi.json").json()["paths"]
    return [(path, method, each) for path, methods in paths.items() for method, each in methods.items()]


def test_every_operation_has_its_own_id_and_describes_its_problems(client: TestClient) -> None:
    described = operations(client)
    names = [operation["operationId"] for _, _, operation in described]

    assert len(set(names)) == len(names)
    assert {"createPhoto", "getPsfAs", "getCorrectionResult"} <= set(names)  # generated clients name by them
    for path, method, operation in described:
        assert operation["summary"], path
        assert operation.get("description"), path
        for status, answer in operation["responses"].items():
            if status[0] in "45" and path != "/readyz":
                assert "application/problem+json" in answer["content"], (path, method, status)
                assert "HTTPValidationError" not in str(answer), (path, method)


HOSTILE = [
    *("", "0", "-1", "9" * 20, "1e999", "nan", "a" * 300, "[]", "{}", "true"),
    *("'; DROP TABLE lens;--", "\u202e", "%00"),
]
BODIES: list[Any] = [[], {}, {"photo_id": "\x00"}, {"aperture": []}, 7]


def test_no_question_that_the_description_allows_for_brings_the_service_down(
    client: TestClient, steps: Steps
) -> None:
    rng = random.Random(7)
    photo = steps.counted(patches=6)
    known = [photo.public_id, steps.lens_id(photo)]
    asked = [each for each in operations(client) if each[1] in {"get", "post", "patch"}]

    for path, method, operation in 4 * [each for each in asked if not each[0].endswith("/events")]:
        filled = re.sub(r"\{\w+\}", lambda _: quote(rng.choice([*known, *HOSTILE]), safe=""), path)
        names = [p["name"] for p in operation.get("parameters", []) if p["in"] == "query"]
        query = {name: rng.choice(HOSTILE) for name in names if name != "wait" and rng.random() < 0.5}
        body = None if method == "get" else rng.choice(BODIES)
        answer = client.request(method, filled, params=query, json=body)
        assert answer.status_code < 500 or path == "/readyz", (method, filled, query, body)
        if answer.status_code >= 400 and path != "/readyz":
            assert answer.headers["content-type"] == "application/problem+json"
