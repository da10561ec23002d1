"""The service around the resources: probes, problems, request ids, and its own description."""

from __future__ import annotations

import logging
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

from app.http.errors import STATUS_OF_CODE, status_of
from app.main import create_app
from app.routes import health
from app.runtime.settings import Settings
from app.store import Store
from lensmodel.core import errors


def test_the_process_says_that_it_lives(client: TestClient) -> None:
    assert client.get("/healthz").json() == {"status": "ok"}


def test_readiness_is_looked_up_once_and_changes_nothing(
    client: TestClient, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute
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
        ready_needs_all(client, store)


def ready_needs_all(client: TestClient, store: Store) -> None:
    before = client.get("/readyz")
    assert before.status_code == 503
    assert before.json()["checks"]["schema"] == before.json()["checks"]["storage"] == "ok"
    assert "lensmodel worker" in before.json()["checks"]["worker"]

    store.jobs.register("w")

    after = client.get("/readyz")
    assert (after.status_code, after.json()["status"]) == (200, "ready")
    store.jobs.bury("w")
    assert client.get("/readyz").status_code == 503


def test_an_empty_database_is_not_ready_and_answers_with_a_problem(settings: Settings) -> None:
    with TestClient(create_app(settings), raise_server_exceptions=False) as client:
        assert "schema" in client.get("/readyz").json()["checks"]
        assert client.get("/readyz").json()["checks"]["schema"] != "ok"
        answer = client.get("/v1/photos")

    assert (answer.status_code, answer.json()["code"]) == (503, "busy")


def test_formats_limits_and_version_are_told(client: TestClient, settings: Settings) -> None:
    formats = client.get("/v1/formats").json()
    assert {"fast", "standard", "paper"} <= set(formats["methods"])
    assert "default" in formats["estimators"]
    assert client.get("/v1/limits").json()["max_upload_bytes"] == settings.max_upload_mb << 20
    assert client.get("/v1/version").json()["api"] == "v1"


def test_our_own_fault_is_a_problem_without_its_cause(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute

    def broken(*args: object, **options: object) -> None:
        raise RuntimeError("the secret cause")

    monkeypatch.setattr(services.store.photos, "page", broken)
    answer = client.get("/v1/photos", headers={"X-Request-ID": "abc-1"})

    assert (answer.status_code, answer.json()["code"]) == (500, "internal_error")
    assert "secret" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.json()["request_id"] == answer.headers["x-request-id"] == "abc-1"


def test_a_locked_database_is_busy_and_not_broken(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute

    def locked(*args: object, **options: object) -> None:
        raise OperationalError("SELECT", {}, Exception("database is locked"))

    monkeypatch.setattr(services.store.photos, "page", locked)
    answer = client.get("/v1/photos")

    assert (answer.status_code, answer.json()["code"]) == (503, "busy")
    assert answer.headers["retry-after"] == "5"


@pytest.mark.parametrize(
    ("said", "status", "code"),
    [
        ("Generic LocalFileSystem error: No space left on device (os error 28)", 507, "quota_exceeded"),
        ("Generic S3 error: 503 Service Unavailable", 503, "busy"),
    ],
)
def test_a_storage_that_is_full_or_away_is_told_so(
    client: TestClient, monkeypatch: pytest.MonkeyPatch, said: str, status: int, code: str
) -> None:
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute

    @asynccontextmanager
    async def broken(key: str) -> AsyncIterator[None]:
        raise GenericError(said)
        yield

    monkeypatch.setattr(services.storage, "writer", broken)
    answer = client.post("/v1/photos", content=b"II*\x00" + bytes(9000))

    assert (answer.status_code, answer.json()["code"]) == (status, code)
    assert client.get("/v1/photos").json()["items"] == []


@pytest.mark.parametrize(
    ("host", "status"),
    [
        ("localhost:8000", 200),
        ("127.0.0.1", 200),
        ("[::1]:8000", 200),
        ("rebound.example.org", 400),
        ("127.0.0.1.example.org:8000", 400),
    ],
)
def test_a_name_that_a_stranger_may_own_is_not_served(client: TestClient, host: str, status: int) -> None:
    assert client.get("/v1/photos", headers={"Host": host}).status_code == status


@pytest.mark.parametrize("bad", ["", "a b", "x" * 65, "naïve", "a;b"])
def test_a_request_id_is_echoed_if_it_is_a_plain_word(client: TestClient, bad: str) -> None:
    good = client.get("/healthz", headers={"X-Request-ID": "my.id-7"})
    assert good.headers["x-request-id"] == "my.id-7"

    other = client.get("/healthz", headers=[(b"X-Request-ID", bad.encode())])
    assert other.headers["x-request-id"] not in {"", bad}


def test_the_log_names_the_request_but_no_query(client: TestClient, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="app.access"):
        client.get("/v1/lenses?serial=SECRET-77", headers={"X-Request-ID": "r-1"})

    assert "GET /v1/lenses 200" in caplog.text
    assert "r-1" in caplog.text
    assert "SECRET-77" not in "".join(
        record.getMessage() for record in caplog.records if record.name.startswith("app")
    )


def _all_kinds(kind: type[Exception]) -> list[type[Exception]]:
    return [kind, *(deeper for child in kind.__subclasses__() for deeper in _all_kinds(child))]


def test_every_error_of_the_library_has_a_status_and_its_code_the_same_one() -> None:
    own = [kind for kind in _all_kinds(errors.LensModelError) if kind.__module__ == "lensmodel.core.errors"]

    for kind in own:
        if kind is errors.LensModelError:
            continue
        status = status_of(kind("x"))
        assert 400 <= status < 500, kind
        if kind is not errors.NoUsablePatchesError:  # as an answer "not yet", as the end of a job "never"
            assert STATUS_OF_CODE[kind.code] == status, kind  # type: ignore[attr-defined] # all have one


def schema_of(client: TestClient) -> dict[str, Any]:
    return dict(client.get("/openapi.json").json())


def test_every_operation_has_its_own_id_and_describes_its_problems(client: TestClient) -> None:
    operations = [
        (path, method, operation)
        for path, methods in schema_of(client)["paths"].items()
        for method, operation in methods.items()
    ]

    names = [operation["operationId"] for _, _, operation in operations]
    assert len(set(names)) == len(names)
    assert {"createPhoto", "getPsfAs", "getCorrectionResult"} <= set(names)  # generated clients name by them
    for path, method, operation in operations:
        assert operation["summary"], path
        assert operation.get("description"), path
        for status, answer in operation["responses"].items():
            if status[0] in "45" and path != "/readyz":
                assert "application/problem+json" in answer["content"], (path, method, status)
                assert "HTTPValidationError" not in str(answer), (path, method)


HOSTILE = [
    "",
    "0",
    "9" * 20,
    "-1",
    "1e999",
    "nan",
    "'; DROP TABLE lens;--",
    "\u202e",
    "%00",
    "a" * 300,
    "[]",
    "{}",
    "true",
]


def test_no_question_that_the_description_allows_for_brings_the_service_down(
    client: TestClient, steps: Any
) -> None:
    rng = random.Random(7)
    photo = steps.counted(patches=6)
    known = [photo.public_id, steps.lens_id(photo)]

    for path, methods in sorted(schema_of(client)["paths"].items()):
        for method, operation in sorted(methods.items()):
            if method not in {"get", "post", "patch"} or path.endswith("/events"):
                continue
            for _ in range(4):
                filled = re.sub(r"\{\w+\}", lambda _: quote(rng.choice([*known, *HOSTILE]), safe=""), path)
                names = [p["name"] for p in operation.get("parameters", []) if p["in"] == "query"]
                query = {name: rng.choice(HOSTILE) for name in names if name != "wait" and rng.random() < 0.5}
                body = (
                    None
                    if method == "get"
                    else rng.choice([[], {}, {"photo_id": "\x00"}, {"aperture": []}, 7])
                )
                answer = client.request(method, filled, params=query, json=body)
                assert answer.status_code < 500 or path == "/readyz", (method, filled, query, body)
                if answer.status_code >= 400 and path != "/readyz":
                    assert answer.headers["content-type"] == "application/problem+json"
