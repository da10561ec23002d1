"""What the service tells of itself under /metrics, and that it tells no names."""

from __future__ import annotations

import httpx2
import pytest
from conftest import Steps
from prometheus_client.parser import text_string_to_metric_families
from servers import free_port
from starlette.testclient import TestClient

from app.jobs.queue import durable
from app.runtime import metrics
from app.runtime.outage import OutageError


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

    assert values["lensmodel_queue_jobs{'kind': 'photo', 'state': 'received'}"] == 1
    assert values["lensmodel_queue_jobs{'kind': 'photo', 'state': 'inspecting'}"] == 1
    assert values["lensmodel_queue_jobs{'kind': 'correction', 'state': 'queued'}"] == 0
    assert 0 < values["lensmodel_queue_oldest_seconds{'kind': 'photo'}"] < 60
    assert values["lensmodel_workers{}"] == 0


def test_requests_and_psf_queries_are_counted_by_route_and_never_by_id(
    client: TestClient, steps: Steps
) -> None:
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
    failures = iter([OutageError(), *[KeyError()] * 3])

    def fail(*_: object) -> None:
        error = next(failures, None)
        if error is not None:
            raise error

    durable("photo", fail, lambda *_: None)("p", 1)
    durable("photo", fail, lambda *_: None)("p", 1)
    address = f"127.0.0.1:{free_port()}"

    metrics.publish(address)

    values = numbers(httpx2.get(f"http://{address}/metrics").text)
    for ending in ("done", "internal_error"):
        assert values[f"lensmodel_job_seconds_count{{'ending': '{ending}', 'kind': 'photo'}}"] >= 1
    assert values["lensmodel_job_retries_total{'cause': 'outage', 'kind': 'photo'}"] >= 1
