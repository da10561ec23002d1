"""What holds for all resources, and the service around them: probes, problems, and its own description."""

from __future__ import annotations

import json
import random
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import quote

import pytest
from sqlalchemy.exc import OperationalError
from starlette.testclient import TestClient
from states import Steps, finish, refusal, services_of

from app.http.errors import STATUS_OF_CODE, status_of
from app.main import create_app
from app.routes import health
from app.runtime.settings import Settings
from app.store import Store
from lensmodel.core import errors

Filled = Callable[[str], str]
JSON = {"Content-Type": "application/json"}


@pytest.fixture
def filled(client: TestClient, steps: Steps) -> Filled:
    """Put the ids of a counted photo, its lens and a finished correction in place of their names."""
    photo = steps.counted()
    row = steps.correct(photo, method="fast", strength=1.0, output={"format": "png8"}, roi=None)
    finish(client, row.public_id)
    ids = {"PHOTO": photo.public_id, "LENS": steps.lens_id(photo), "CORRECTION": row.public_id}
    return lambda text: re.sub("|".join(ids), lambda name: ids[name[0]], text)


def jobs(steps: Steps, number: int) -> list[str]:
    photo = steps.counted()
    asked = {"method": "fast", "output": {"format": "png8"}, "roi": None}
    made = [steps.correct(photo, strength=k / 10, **asked).public_id for k in range(number - 1)]
    return [photo.public_id, *made]


MAKERS: dict[str, Callable[[Steps, int], list[str]]] = {
    "/photos": lambda steps, number: [steps.receive().public_id for _ in range(number)],
    "/jobs": jobs,
    "/lenses": lambda steps, number: [
        steps.lens_id(steps.counted(serial=str(k), patches=1)) for k in range(number)
    ],
    "/corrections": lambda steps, number: jobs(steps, number + 1)[1:],
}


@pytest.mark.parametrize("path", MAKERS)
def test_pages_join_without_gap_or_overlap(client: TestClient, steps: Steps, path: str) -> None:
    made, seen = MAKERS[path](steps, 5), list[str]()
    link: str | None = f"/v1{path}?limit=2"
    while link is not None:
        answer = client.get(link)
        seen += [item["id"] for item in answer.json()["items"]]
        link = answer.json()["next"]
        assert answer.headers.get("link") == (None if link is None else f'<{link}>; rel="next"')

    assert seen == made[::-1]


@pytest.mark.parametrize(
    "path",
    ["/v1/jobs/PHOTO", "/v1/jobs/CORRECTION", "/v1/corrections/CORRECTION/result", "/ui/parts?page=home"],
)
def test_what_has_not_changed_is_not_sent_again(client: TestClient, filled: Filled, path: str) -> None:
    first = client.get(filled(path))

    for known, status in ((first.headers["etag"], 304), ('"other"', 200)):
        again = client.get(filled(path), headers={"If-None-Match": known})
        assert (known, again.status_code, bool(again.content)) == (known, status, status == 200)


@pytest.mark.parametrize("kind", ["photo", "job", "lens", "correction"])
def test_an_unknown_id_is_a_plain_404(client: TestClient, kind: str) -> None:
    rooms = {"lens": "lenses"}.get(kind, f"{kind}s")
    for bad in ("nothing", "..", "%2e%2e%2fetc", "a' OR 1=1 --", "💥", "x" * 3000, "%00"):
        told = refusal(client.get(f"/v1/{rooms}/{bad}"))

        assert told in {(404, f"unknown_{kind}"), (404, "not_found")}, bad


INVALID = "invalid_parameter"
NEW = {"label": "mine"}
# A bad change of a photo is refused with 422, a bad wish for a correction too
CHANGES: list[object] = [
    *({}, [], {"colour": "red"}, {"lens_id": "a", "lens_serial": "b"}, {"lens_model": "EF"}),
    *({"aperture": bad} for bad in (0.1, "wide", True)),
    *({"new_lens": {"label": ""}}, {"lens_serial": "\x07"}),
]
WISHES: list[dict[str, Any]] = [
    *({"method": "magic"}, {"method": ""}, {"strength": 1.5}, {"strength": "NaN"}, {"iterations": 5}),
    *({"halo": -0.1}, {"halo": "NaN"}, {"denoise": 1.5}, {"lens_version": 0}, {"lens_version": 10**20}),
    *({"output": bad} for bad in ({"format": "bmp"}, {"quality": 0}, {"color_space": "adobe"})),
    {"roi": {"x": 0, "y": 0, "width": 6001, "height": 10}},
]
PAGES = ("limit=0", "limit=201", "limit=x", f"cursor={'x' * 50}")
QUERIES = [
    *(f"{path}?{page}" for path in MAKERS for page in PAGES),
    *(f"/lenses/LENS/field.png?grid={grid}" for grid in ("0x3", "26x1", "axb", "9", "-1x2")),
    "/lenses/LENS/field.png?grid=25x25&size=255&aperture=1.4",
    *(f"/jobs/PHOTO?wait={wait}" for wait in ("-1", "21", "nan", "soon")),
    f"/lenses/LENS/calibrations?cursor={10**20}",
    *("/lenses/LENS/psf.exe?r=0", "/photos?state=lost"),
]
REFUSED: list[tuple[str, str, Any, int, str]] = [
    *(("PATCH", "/v1/photos/PHOTO", change, 422, INVALID) for change in CHANGES),
    ("PATCH", "/v1/photos/PHOTO", {"lens_id": "nothing"}, 404, "unknown_lens"),
    *(("POST", "/v1/corrections", {"photo_id": "PHOTO"} | wish, 422, INVALID) for wish in WISHES),
    ("POST", "/v1/corrections", {"photo_id": "nothing"}, 404, "unknown_photo"),
    ("POST", "/v1/corrections", {"photo_id": "PHOTO", "lens_id": "nothing"}, 404, "unknown_lens"),
    ("POST", "/v1/corrections", {"photo_id": "PHOTO", "lens_version": 7}, 409, "conflict"),
    ("PATCH", "/v1/photos", {"photo_ids": ["PHOTO"]}, 422, INVALID),
    ("PATCH", "/v1/photos", {"photo_ids": ["PHOTO"], "lens_id": "x", "new_lens": NEW}, 422, INVALID),
    ("PATCH", "/v1/photos", {"photo_ids": ["gone"], "lens_id": "LENS"}, 404, "unknown_photo"),
    ("PATCH", "/v1/photos", {"photo_ids": ["PHOTO"], "lens_id": "gone"}, 404, "unknown_lens"),
    ("PATCH", "/v1/lenses/LENS", {"merge_into": "LENS"}, 422, INVALID),
    *(("GET", f"/v1{query}", None, 422, INVALID) for query in QUERIES),
    ("GET", "/v1/nothing", None, 404, "not_found"),
    ("PUT", "/v1/photos", None, 405, "method_not_allowed"),
]


def test_what_makes_no_sense_is_refused_with_a_problem(client: TestClient, filled: Filled) -> None:
    for method, path, body, status, code in REFUSED:
        content = None if body is None else filled(json.dumps(body))
        answer = client.request(method, filled(path), content=content, headers=JSON)

        case, problem = (method, path, body), answer.json()
        assert (case, answer.status_code, problem["code"]) == (case, status, code)
        assert answer.headers["content-type"] == "application/problem+json", case
        assert {"type", "title", "status", "detail", "errors", "request_id"} <= set(problem), case
        assert problem["detail"], case


@pytest.mark.parametrize(
    "body", [b"{", b"", b"\xff\xfe", b'{"aperture": NaN}', b"[" * 5000, b'{"\\ud800": "\\ud800"}']
)
def test_bad_json_is_a_problem_and_not_a_crash(client: TestClient, filled: Filled, body: bytes) -> None:
    for method, path in (("PATCH", "/v1/photos/PHOTO"), ("POST", "/v1/corrections")):
        answer = client.request(method, filled(path), content=body, headers=JSON)

        assert answer.status_code in {400, 422}
        assert answer.headers["content-type"] == "application/problem+json"


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


def test_ready_needs_schema_storage_worker(
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
    client: TestClient, monkeypatch: pytest.MonkeyPatch, error: Exception, told: Any, retry: str | None
) -> None:
    monkeypatch.setattr(services_of(client).store.photos, "page", mock.Mock(side_effect=error))
    answer = client.get("/v1/photos", headers={"X-Request-ID": "abc-1"})

    assert refusal(answer) == told
    assert "secret" not in answer.text
    assert answer.headers["x-content-type-options"] == "nosniff"
    assert answer.headers.get("retry-after") == retry
    assert answer.json()["request_id"] == answer.headers["x-request-id"] == "abc-1"


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


def test_no_described_question_brings_the_service_down(client: TestClient, steps: Steps) -> None:
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
