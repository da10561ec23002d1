"""Log lines for collectors, one JSON object a line, and what stands under /metrics, which tells no names."""

from __future__ import annotations

import contextvars
import io
import json
import logging
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import httpx2
import pytest
from conftest import Steps
from prometheus_client.parser import text_string_to_metric_families
from running import served
from servers import free_port
from starlette.testclient import TestClient

from app.jobs.queue import durable
from app.runtime import logs, metrics
from app.runtime.outage import OutageError
from app.runtime.settings import Settings
from app.store import Store

Said = Callable[[str], list[dict[str, Any]]]
NAMES = ("", "app", "app.access", "uvicorn.error")  # of loggers that a service sets up


@pytest.fixture
def as_before() -> Iterator[None]:
    """Leave the log of other tests as it was."""
    root, levels = logging.getLogger(), {name: logging.getLogger(name).level for name in NAMES}
    handlers = root.handlers[:]
    yield
    root.handlers = handlers
    for name, level in levels.items():
        logging.getLogger(name).setLevel(level)


@pytest.fixture
def said(as_before: None) -> Said:
    """Let every record of the service be written as a line of JSON; return those of a logger."""
    written = io.StringIO()
    handler = logging.StreamHandler(written)
    handler.setFormatter(logs.one_object("test"))
    logging.getLogger().addHandler(handler)
    logging.getLogger("app").setLevel(logging.INFO)
    logging.getLogger("app.access").setLevel(logging.NOTSET)

    def read(logger: str) -> list[dict[str, Any]]:
        assert "\x1b" not in written.getvalue()
        records = map(json.loads, written.getvalue().splitlines())
        return [record for record in records if record["logger"] == logger]

    return read


def test_a_record_is_one_object_on_one_line_whatever_it_holds(said: Said) -> None:
    try:
        int("12\n\x1b[2J")
    except ValueError:
        logging.getLogger("app.some").exception("two\nlines of %s", "a \x1b[31mstranger\u2028")

    (record,) = said("app.some")

    assert record["message"] == "two\nlines of a \x1b[31mstranger\u2028"
    assert (record["level"], record["part"]) == ("error", "test")
    assert "ValueError" in record["exception"]
    assert record["time"].endswith("Z")


TEXT = "at work\nINFO forged\x1b[2J\r\u2028y"


def test_lines_for_people_name_them_too_and_no_text_forges_one() -> None:
    record, written = logging.LogRecord("app", logging.INFO, "", 0, TEXT, (), None), list[str]()

    def work(*_: object) -> None:
        written.append(logs.OneRecord("%(message)s").format(record))

    contextvars.Context().run(durable("photo", work, print), "PHOTO", 1)
    ids = "job_id=photo/PHOTO/1 photo_id=PHOTO"
    assert written == [f"at work {ids}\n    | INFO forged\\x1b[2J\\x0d\\x2028y"]


def test_the_line_of_a_request_says_what_was_asked_and_answered_and_those_from_within_have_its_id(
    client: TestClient, said: Said, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise RuntimeError("unforeseen")

    monkeypatch.setattr("app.store.photos.Photos.get", broken)
    client.get("/v1/photos/PHOTO", headers={"X-Request-ID": "asked-1"})

    (record,), (within,) = said("app.access"), said("app.http.errors")

    about = {"request_id": "asked-1", "method": "GET", "path": "/v1/photos/PHOTO", "status": 500}
    assert record.items() >= {**about, "photo_id": "PHOTO"}.items()
    assert record["ms"] >= 0
    assert within["request_id"] == "asked-1"


def test_a_kept_connection_gives_nothing_to_the_next_request(
    settings: Settings, store: Store, said: Said
) -> None:
    with served(settings) as port, httpx2.Client(base_url=f"http://127.0.0.1:{port}") as http:
        sent = http.post("/v1/photos", content=b"\xff\xd8\xff" + bytes(500_000))  # reading it pauses
        http.get("/v1/formats")

    assert sent.status_code == 202
    assert "photo_id" not in {record["path"]: record for record in said("app.access")}["/v1/formats"]


@pytest.mark.parametrize(
    ("level", "form", "said"),
    [("info", "text", False), ("debug", "text", True), ("info", "json", True), ("warning", "text", False)],
)
def test_requests_are_logged_for_collectors_and_for_who_asks(
    as_before: None, level: str, form: logs.Format, said: bool
) -> None:
    logs.begin("api", level, form)

    assert logging.getLogger("app.access").isEnabledFor(logging.INFO) == said
    assert logging.getLogger("app.access").isEnabledFor(logging.WARNING)


# --- metrics ----------------------------------------------------------------------------------


def numbers(text: str) -> dict[str, float]:
    return {
        f"{sample.name}{dict(sorted(sample.labels.items()))}": sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def asked(client: TestClient) -> dict[str, float]:
    answer = client.get("/metrics")
    assert answer.status_code == 200
    assert answer.headers["content-type"].startswith("text/plain; version=1.0.0")
    return numbers(answer.text)


def test_depth_and_age_of_the_queue_are_those_of_the_tables(client: TestClient, steps: Steps) -> None:
    steps.receive()
    begun = steps.receive()
    steps.inspect(begun)

    values = asked(client)

    for kind, state, jobs in (
        ("photo", "received", 1),
        ("photo", "inspecting", 1),
        ("correction", "queued", 0),
    ):
        assert values[f"lensmodel_queue_jobs{{'kind': '{kind}', 'state': '{state}'}}"] == jobs
    assert 0 < values["lensmodel_queue_oldest_seconds{'kind': 'photo'}"] < 60
    assert values["lensmodel_workers{}"] == 0


def test_requests_are_counted_by_route_and_never_by_id(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted())
    before = asked(client)
    for _ in range(2):
        client.get(f"/v1/lenses/{lens}/psf", params={"r": 0.1, "phi": 0.2, "aperture": 1.4})
    client.get("/somewhere/else")

    after = asked(client)

    def risen(name: str) -> float:
        return after[name] - before.get(name, 0.0)

    route = "{'method': 'GET', 'route': '/v1/lenses/{lens_id}/psf', 'status': '200'}"
    assert risen(f"lensmodel_http_request_seconds_count{route}") == 2
    assert risen("lensmodel_model_cache_total{'outcome': 'fitted'}") == 1
    assert risen("lensmodel_model_cache_total{'outcome': 'known'}") == 1
    assert after["lensmodel_model_cache_bytes{}"] > 0
    assert not any(lens in name or "somewhere" in name for name in after)


def test_a_worker_tells_its_own_where_it_has_an_address(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.jobs.queue.sleep", lambda _: None)
    fails = mock.Mock(side_effect=[OutageError(), *[KeyError()] * 3, None], __name__="job")
    for _ in range(2):
        durable("photo", fails, lambda *_: None)("p", 1)
    address = f"127.0.0.1:{free_port()}"

    metrics.publish(address)

    values = numbers(httpx2.get(f"http://{address}/metrics").text)
    for ending in ("done", "internal_error"):
        assert values[f"lensmodel_job_seconds_count{{'ending': '{ending}', 'kind': 'photo'}}"] >= 1
    assert values["lensmodel_job_retries_total{'cause': 'outage', 'kind': 'photo'}"] >= 1
