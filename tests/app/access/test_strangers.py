"""What strangers send: bodies without end, pages of other sites, names of others, forged lines of the log."""

from __future__ import annotations

import logging
import re
import socket
from collections.abc import Callable, Iterator
from contextlib import closing
from typing import Any

import pytest
from running import served
from starlette.testclient import TestClient

from app.http.middleware import MAX_JSON_BYTES
from app.main import create_app
from app.routes import photos
from app.runtime.settings import Settings
from app.store import Store

TIFF = b"II*\x00" + bytes(9000)
JSON = {"Content-Type": "application/json"}
PATIENCE_S = 60.0


# --- bodies -----------------------------------------------------------------------------------


def test_a_long_json_body_is_refused_by_its_length_alone(client: TestClient) -> None:
    answer = client.post("/v1/corrections", content=b"{}", headers={**JSON, "Content-Length": "600000000"})

    assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")
    assert answer.headers["connection"] == "close"


def test_a_json_body_without_a_length_is_read_to_the_limit_only(client: TestClient) -> None:
    sent = 0

    def pieces() -> Iterator[bytes]:
        nonlocal sent
        for _ in range(1000):
            sent += 65536
            yield b" " * 65536

    answer = client.post("/v1/corrections", content=pieces(), headers=JSON)

    assert (answer.status_code, answer.json()["code"]) == (413, "body_too_large")


def test_json_up_to_the_limit_is_read(client: TestClient) -> None:
    body = b'{"photo_id": "nothing"}'.ljust(MAX_JSON_BYTES)

    assert client.post("/v1/corrections", content=body, headers=JSON).json()["code"] == "unknown_photo"
    assert client.post("/v1/corrections", content=body + b" ", headers=JSON).status_code == 413


@pytest.mark.parametrize(
    "kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", ""]
)
def test_what_is_not_declared_as_json_is_not_read(client: TestClient, kind: str) -> None:
    answer = client.post("/v1/corrections", content=b'{"photo_id": "x"}', headers={"Content-Type": kind})

    assert (answer.status_code, answer.json()["code"]) == (415, "unsupported_format")


def test_calls_without_a_body_need_no_type(client: TestClient, steps: Any) -> None:
    photo = steps.receive()

    assert client.post(f"/v1/jobs/{photo.public_id}/cancel").status_code == 202
    assert client.delete(f"/v1/photos/{photo.public_id}").status_code == 204


def head(method: str, path: str, length: int | str, kind: str = "application/json") -> bytes:
    lines = (
        f"{method} {path} HTTP/1.1",
        "Host: localhost",
        f"Content-Type: {kind}",
        f"Content-Length: {length}",
    )
    return "\r\n".join([*lines, "", ""]).encode()


def answer_of(port: int, sent: bytes, then: Callable[[socket.socket], None] = lambda _: None) -> bytes:
    """Send bytes, do something more, and return all that comes until the service closes."""
    with closing(socket.create_connection(("127.0.0.1", port), timeout=PATIENCE_S)) as opened:
        opened.sendall(sent)
        then(opened)
        said = b""
        while piece := opened.recv(65536):
            said += piece
        return said


@pytest.fixture
def port(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    monkeypatch.setattr(photos, "UPLOAD_S", 0.5)
    with served(settings) as opened:
        yield opened


@pytest.mark.parametrize(
    "sent",
    [
        head("POST", "/v1/photos", 9004, "application/octet-stream") + TIFF[:500],
        head("POST", "/v1/photos", 9004, "multipart/form-data; boundary=b") + b"--b\r\n",
        head("PUT", "/v1/lenses/LENS/profile", 9004, "application/octet-stream") + b"PK" + TIFF[:500],
    ],
)
def test_a_body_that_does_not_come_in_time_is_answered_and_the_connection_closed(
    port: int, sent: bytes, steps: Any
) -> None:
    said = answer_of(port, sent.replace(b"LENS", steps.lens_id(steps.counted()).encode()))

    assert said.startswith(b"HTTP/1.1 408")
    assert b'"code":"too_slow"' in said


@pytest.mark.parametrize("length", ["ten", "-1", "+5", "1e3", "9" * 40])
def test_a_nonsense_length_is_refused(port: int, length: str) -> None:
    said = answer_of(port, head("POST", "/v1/photos", length, "application/octet-stream"))

    assert said.startswith((b"HTTP/1.1 400", b"HTTP/1.1 413"))


def test_a_body_longer_than_its_length_ends_the_connection(port: int) -> None:
    said = answer_of(port, head("POST", "/v1/corrections", 2) + b"{}" + b"\x00" * 1000)

    assert said.count(b"HTTP/1.1 422") == 1
    assert said.count(b"HTTP/1.1") <= 2  # of the rest, at most that it is no request


def test_photos_are_received_only_so_many_at_once(client: TestClient) -> None:
    places = client.app.state.services.uploads  # type: ignore[attr-defined]  # an application of ours
    free, places._value = places._value, 0

    refused = client.post("/v1/photos", content=TIFF)
    places._value = 1
    taken = client.post("/v1/photos", content=TIFF)

    assert (refused.status_code, refused.json()["code"]) == (503, "busy")
    assert refused.headers["retry-after"] == "5"
    assert taken.status_code == 202
    assert (places._value, free) == (1, photos.MAX_UPLOADS)


# --- other sites ------------------------------------------------------------------------------

FOREIGN = [
    {"Origin": "https://evil.example"},
    {"Origin": "null"},
    {"Origin": "http://localhost:9"},  # another service of the same machine
    {"Sec-Fetch-Site": "cross-site"},
    {"Sec-Fetch-Site": "same-site"},
]


@pytest.mark.parametrize("headers", FOREIGN)
def test_a_change_that_another_site_asks_for_is_refused(
    client: TestClient, steps: Any, headers: dict[str, str]
) -> None:
    photo = steps.receive()
    asked = [
        client.post("/v1/photos", files={"file": ("p.tif", TIFF)}, headers=headers),
        client.post("/v1/photos", content=TIFF, headers={**headers, "Content-Type": "text/plain"}),
        client.post(f"/v1/jobs/{photo.public_id}/cancel", headers=headers),
        client.patch(f"/v1/photos/{photo.public_id}", json={"aperture": 2.8}, headers=headers),
        client.delete(f"/v1/photos/{photo.public_id}", headers=headers),
    ]

    assert {(answer.status_code, answer.json()["code"]) for answer in asked} == {(403, "cross_site")}
    assert steps.fresh(photo).state == "received"
    assert len(client.get("/v1/photos", headers=headers).json()["items"]) == 1


@pytest.mark.parametrize(
    "headers",
    [{}, {"Origin": "http://testserver", "Sec-Fetch-Site": "same-origin"}, {"Sec-Fetch-Site": "none"}],
)
def test_our_own_pages_and_programs_may_change_things(client: TestClient, headers: dict[str, str]) -> None:
    assert client.post("/v1/photos", content=TIFF, headers=headers).status_code == 202


def test_every_route_that_changes_something_asks_where_it_comes_from(client: TestClient) -> None:
    described = client.get("/openapi.json").json()["paths"]
    changing = [
        (method, path) for path, methods in described.items() for method in methods if method != "get"
    ]

    for method, path in changing:
        filled = re.sub(r"\{\w+\}", "x", path)
        answer = client.request(method, filled, headers={"Origin": "https://evil.example"})
        assert answer.status_code == 403, (method, path)
    assert len(changing) > 5


def test_a_public_service_answers_to_the_names_that_it_is_given(settings: Settings, store: Store) -> None:
    public = settings.model_copy(update={"allowed_hosts": "Lens.example.org, other.example"})
    key = {"Authorization": f"Bearer {store.accounts.create_key('anna', ['write'])}"}
    with TestClient(create_app(public)) as client:
        hosts = ("lens.example.org", "lens.example.org:443", "other.example", "evil.example", "127.0.0.1")
        answers = {host: client.get("/healthz", headers={"Host": host}).status_code for host in hosts}
        behind = client.post(
            "/v1/photos",
            content=TIFF,
            headers={"Host": "127.0.0.1:8000", "Origin": "https://lens.example.org", **key},
        )

    assert {host for host, status in answers.items() if status != 200} == {"evil.example"}
    assert behind.status_code == 202  # a proxy that passes on an address as Host


@pytest.mark.parametrize(
    "path",
    [
        "/healthz",
        "/v1/photos",
        "/openapi.json",
        "/",
        "/docs",
        "/nothing",
        "/static/app.js",
        "/lenses/nothing",
    ],
)
def test_every_answer_says_what_a_browser_may_do_with_it(client: TestClient, path: str) -> None:
    headers = client.get(path, headers={"Accept": "text/html"}).headers

    assert headers["x-content-type-options"] == "nosniff"
    assert "frame-ancestors 'none'" in headers["content-security-policy"]
    assert "unsafe-eval" not in headers["content-security-policy"]


@pytest.mark.parametrize("path", ["/", "/docs"])
def test_pages_load_nothing_from_elsewhere(client: TestClient, path: str) -> None:
    page = client.get(path, headers={"Accept": "text/html"}).text

    loaded = re.findall(r"<(?:script|link|img|iframe)[^>]*?(?:src|href)=\"([^\"]+)\"", page)
    assert loaded
    assert [address for address in loaded if not address.startswith("/static/")] == []
    for address in loaded:
        assert client.get(address).status_code == 200


def test_the_interface_is_shown_with_every_operation(client: TestClient) -> None:
    page = client.get("/docs").text

    for path in client.get("/openapi.json").json()["paths"]:
        assert path in page
    assert "<script>" not in page


# --- the log ----------------------------------------------------------------------------------


def test_a_path_cannot_forge_a_line_of_the_log(client: TestClient, caplog: pytest.LogCaptureFixture) -> None:
    with caplog.at_level(logging.INFO, logger="app.access"):
        client.get("/v1/x%0a2026-01-01 INFO api: forged %1b[2J")

    said = [record.getMessage() for record in caplog.records if record.name == "app.access"]
    assert said[-1].startswith("GET /v1/x%0A2026-01-01%20INFO")
    assert "\n" not in said[-1]
    assert "\x1b" not in said[-1]
