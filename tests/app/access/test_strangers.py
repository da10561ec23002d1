"""What strangers send: bodies without end, pages of other sites, names of others, forged lines of the log."""

from __future__ import annotations

import logging
import re
import socket
from collections.abc import Iterator
from contextlib import closing
from typing import Any

import pytest
from running import served
from starlette.testclient import TestClient
from states import TIFF, Steps, refusal, services_of

from app.http.middleware import MAX_JSON_BYTES
from app.main import create_app
from app.routes import photos
from app.runtime.settings import Settings
from app.store import Store

JSON = {"Content-Type": "application/json"}
PATIENCE_S = 60.0


def test_json_is_read_to_the_limit_and_declared_as_such(client: TestClient) -> None:
    def post(content: bytes | Iterator[bytes], **headers: str) -> Any:
        return client.post("/v1/corrections", content=content, headers={**JSON, **headers})

    body = b'{"photo_id": "nothing"}'.ljust(MAX_JSON_BYTES)
    declared = post(b"{}", **{"Content-Length": "600000000"})
    endless = (b" " * 65536 for _ in range(1000))

    assert refusal(post(body)) == (404, "unknown_photo")
    for refused in (declared, post(endless), post(body + b" ")):
        assert refusal(refused) == (413, "body_too_large")
    assert declared.headers["connection"] == "close"
    for kind in ("text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""):
        assert refusal(post(body, **{"Content-Type": kind})) == (415, "unsupported_format"), kind


def head(method: str, path: str, length: int | str, kind: str = "application/json") -> bytes:
    fields = f"Host: localhost\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\n"
    return f"{method} {path} HTTP/1.1\r\n{fields}\r\n".encode()


def answer_of(port: int, sent: bytes) -> bytes:
    """Send bytes, and return all that comes until the service closes."""
    with closing(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)) as opened:
        opened.sendall(sent)
        said = b""
        while piece := opened.recv(65536):
            said += piece
        return said


@pytest.fixture
def port(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(photos, "UPLOAD_S", 0.5)
    with served(settings) as opened:
        yield opened


def test_too_slow_a_body_is_answered_and_the_connection_closed(port: int, steps: Steps) -> None:
    lens, raw = steps.lens_id(steps.counted()), "application/octet-stream"
    for sent in (
        head("POST", "/v1/photos", 9004, raw) + TIFF[:500],
        head("POST", "/v1/photos", 9004, "multipart/form-data; boundary=b") + b"--b\r\n",
        head("PUT", f"/v1/lenses/{lens}/profile", 9004, raw) + b"PK" + TIFF[:500],
    ):
        said = answer_of(port, sent)

        assert said.startswith(b"HTTP/1.1 408"), sent
        assert b'"code":"too_slow"' in said


def test_a_length_that_is_nonsense_or_not_that_of_the_body_ends_the_connection(port: int) -> None:
    for length in ("ten", "-1", "+5", "1e3", "9" * 40):
        said = answer_of(port, head("POST", "/v1/photos", length, "application/octet-stream"))
        assert said.startswith((b"HTTP/1.1 400", b"HTTP/1.1 413")), length

    said = answer_of(port, head("POST", "/v1/corrections", 2) + b"{}" + b"\x00" * 1000)
    assert said.count(b"HTTP/1.1 422") == 1
    assert said.count(b"HTTP/1.1") <= 2  # of the rest, at most that it is no request


def test_only_so_many_photos_are_received_at_once(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    places = services_of(client).uploads

    with monkeypatch.context() as full:
        full.setattr(places, "locked", lambda: True)
        refused = client.post("/v1/photos", content=TIFF)
    taken = client.post("/v1/photos", content=TIFF)

    assert refusal(refused) == (503, "busy")
    assert refused.headers["retry-after"] == "5"
    assert (taken.status_code, places._value) == (202, photos.MAX_UPLOADS)


FOREIGN = [
    {"Origin": "https://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://localhost:9"},  # another service of the same machine
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_changes_asked_by_other_sites_are_refused(
    client: TestClient, steps: Steps, headers: dict[str, str]
) -> None:
    photo = steps.receive()
    asked = [
        client.post("/v1/photos", files={"file": ("p.tif", TIFF)}, headers=headers),
        client.post("/v1/photos", content=TIFF, headers={**headers, "Content-Type": "text/plain"}),
        client.post(f"/v1/jobs/{photo.public_id}/cancel", headers=headers),
        client.patch(f"/v1/photos/{photo.public_id}", json={"aperture": 2.8}, headers=headers),
        client.delete(f"/v1/photos/{photo.public_id}", headers=headers),
    ]

    assert {refusal(answer) for answer in asked} == {(403, "cross_site")}
    assert steps.fresh(photo).state == "received"
    assert len(client.get("/v1/photos", headers=headers).json()["items"]) == 1


def test_every_route_that_changes_something_asks_where_it_comes_from(client: TestClient) -> None:
    described = client.get("/openapi.json").json()["paths"].items()
    changing = [(method, path) for path, methods in described for method in methods if method != "get"]

    for method, path in changing:
        answer = client.request(method, re.sub(r"\{\w+\}", "x", path), headers=FOREIGN[0])
        assert answer.status_code == 403, (method, path)
    assert len(changing) > 5


def test_a_public_service_answers_to_the_names_that_it_is_given(settings: Settings, store: Store) -> None:
    public = settings.model_copy(update={"allowed_hosts": "Lens.example.org, other.example"})
    key = {"Authorization": f"Bearer {store.accounts.create_key('anna', ['write'])}"}
    with TestClient(create_app(public)) as client:
        hosts = ("lens.example.org", "lens.example.org:443", "other.example", "evil.example", "127.0.0.1")
        answers = {host: client.get("/healthz", headers={"Host": host}).status_code for host in hosts}
        passed_on = {"Host": "127.0.0.1:8000", "Origin": "https://lens.example.org", **key}
        behind = client.post("/v1/photos", content=TIFF, headers=passed_on)

    assert {host for host, status in answers.items() if status != 200} == {"evil.example"}
    assert behind.status_code == 202  # a proxy that passes on an address as Host


def test_every_answer_says_what_a_browser_may_do_with_it(client: TestClient) -> None:
    api = ("/healthz", "/v1/photos", "/openapi.json", "/nothing")
    for path in (*api, "/", "/docs", "/static/app.js", "/lenses/nothing"):
        headers = client.get(path, headers={"Accept": "text/html"}).headers

        assert headers["x-content-type-options"] == "nosniff", path
        assert "frame-ancestors 'none'" in headers["content-security-policy"], path
        assert "unsafe-eval" not in headers["content-security-policy"], path


def test_the_interface_is_shown_with_every_operation(client: TestClient) -> None:
    page = client.get("/docs").text

    assert [path for path in client.get("/openapi.json").json()["paths"] if path not in page] == []
    assert "<script>" not in page


def test_the_log_names_requests_without_their_query_and_no_path_forges_a_line(
    client: TestClient, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.INFO, logger="app.access"):
        client.get("/v1/lenses?serial=SECRET-77", headers={"X-Request-ID": "r-1"})
        client.get("/v1/x%0a2026-01-01 INFO api: forged %1b[2J")

    said = [record.getMessage() for record in caplog.records if record.name.startswith("app")]
    assert "SECRET-77" not in "".join(said)
    asked, forged = said
    assert asked.startswith("GET /v1/lenses 200")
    assert "r-1" in asked
    assert forged.startswith("GET /v1/x%0A2026-01-01%20INFO")
    assert forged.isprintable()
