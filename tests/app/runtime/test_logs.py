"""Log lines for collectors: one JSON object a line, which says what it is about."""

from __future__ import annotations

import contextvars
import io
import json
import logging
from collections.abc import Iterator
from typing import Any

import httpx2
import pytest
from running import served
from starlette.testclient import TestClient

from app.jobs.queue import durable
from app.runtime import logs
from app.runtime.settings import Settings
from app.store import Store


@pytest.fixture
def lines() -> Iterator[io.StringIO]:
    """Let every record of the service be written as JSON into a text."""
    written = io.StringIO()
    handler = logging.StreamHandler(written)
    handler.setFormatter(logs.one_object("test"))
    root, log = logging.getLogger(), logging.getLogger("app")
    of_requests = logging.getLogger("app.access")  # others may have begun the log of a service before
    before = log.level, of_requests.level
    root.addHandler(handler)
    log.setLevel(logging.INFO)
    of_requests.setLevel(logging.NOTSET)
    yield written
    root.removeHandler(handler)
    log.setLevel(before[0])
    of_requests.setLevel(before[1])


def read(lines: io.StringIO) -> list[dict[str, Any]]:
    return [json.loads(line) for line in lines.getvalue().splitlines()]


def test_a_record_is_one_object_on_one_line_whatever_it_holds(lines: io.StringIO) -> None:
    try:
        int("12\n\x1b[2J")
    except ValueError:
        logging.getLogger("app.some").exception("two\nlines of %s", "a \x1b[31mstranger\u2028")

    (record,) = read(lines)

    assert record["message"] == "two\nlines of a \x1b[31mstranger\u2028"
    assert (record["level"], record["logger"], record["part"]) == ("error", "app.some", "test")
    assert "ValueError" in record["exception"]
    assert "\x1b" not in lines.getvalue()
    assert record["time"].endswith("Z")


def test_a_line_of_a_job_names_the_job_and_its_photo(lines: io.StringIO) -> None:
    durable("photo", lambda *_: logging.getLogger("app.jobs").info("at work"), print)("PHOTO", 1)
    logging.getLogger("app.jobs").info("at rest")

    during, after = read(lines)

    assert (during["job_id"], during["photo_id"]) == ("photo/PHOTO/1", "PHOTO")
    assert "job_id" not in after


TEXT = "at work\nINFO forged\x1b[2J\r\u2028y"


def test_lines_for_people_name_them_too_and_no_text_forges_one() -> None:
    record, written = logging.LogRecord("app", logging.INFO, "", 0, TEXT, (), None), list[str]()

    def work(*_: object) -> None:
        written.append(logs.OneRecord("%(message)s").format(record))

    contextvars.Context().run(durable("photo", work, print), "PHOTO", 1)
    ids = "job_id=photo/PHOTO/1 photo_id=PHOTO"
    assert written == [f"at work {ids}\n    | INFO forged\\x1b[2J\\x0d\\x2028y"]


def test_the_line_of_a_request_says_what_was_asked_and_answered(
    client: TestClient, lines: io.StringIO
) -> None:
    client.get("/v1/photos/PHOTO", headers={"X-Request-ID": "asked-1"})

    record = next(record for record in read(lines) if record["logger"] == "app.access")

    assert {name: record[name] for name in ("request_id", "method", "path", "status", "photo_id")} == {
        "request_id": "asked-1",
        "method": "GET",
        "path": "/v1/photos/PHOTO",
        "status": 404,
        "photo_id": "PHOTO",
    }
    assert record["ms"] >= 0


def test_a_line_from_within_a_request_has_its_id(
    client: TestClient, lines: io.StringIO, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr("app.store.lenses.Lenses.page", broken)
    answer = client.get("/v1/lenses", headers={"X-Request-ID": "asked-2"})
    assert answer.status_code == 500

    said = [record for record in read(lines) if record["logger"] == "app.http.errors"]

    assert [record["request_id"] for record in said] == ["asked-2"]


def test_a_connection_that_is_kept_gives_nothing_of_one_request_to_the_next(
    settings: Settings, store: Store, lines: io.StringIO
) -> None:
    with served(settings) as port, httpx2.Client(base_url=f"http://127.0.0.1:{port}") as http:
        sent = http.post("/v1/photos", content=b"\xff\xd8\xff" + bytes(500_000))  # reading it pauses
        http.get("/v1/formats")

    assert sent.status_code == 202
    said = {record["path"]: record for record in read(lines) if record["logger"] == "app.access"}
    assert "photo_id" not in said["/v1/formats"]


@pytest.mark.parametrize(
    ("level", "form", "said"),
    [("info", "text", False), ("debug", "text", True), ("info", "json", True), ("warning", "text", False)],
)
def test_requests_are_logged_for_collectors_and_for_who_asks(
    level: str, form: logs.Format, said: bool
) -> None:
    root = logging.getLogger()
    before = root.level, root.handlers[:]
    try:
        logs.begin("api", level, form)
        assert logging.getLogger("app.access").isEnabledFor(logging.INFO) == said
        assert logging.getLogger("app.access").isEnabledFor(logging.WARNING)
    finally:
        root.level, root.handlers = before[0], before[1]
        for name in ("app.access", "uvicorn.error"):
            logging.getLogger(name).setLevel(logging.NOTSET)
