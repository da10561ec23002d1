"""What the service tells of itself under /metrics, and that it tells no names."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families
from starlette.testclient import TestClient

from app.jobs.job_log import accounted
from app.runtime import metrics
from app.runtime.outage import OutageError
from app.runtime.settings import Settings


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


def test_depth_and_age_of_the_queue_are_those_of_the_tables(client: TestClient, steps: Any) -> None:
    steps.receive()
    begun = steps.receive()
    steps.inspect(begun)

    values = asked(client)

    assert values["lensmodel_queue_jobs{'kind': 'photo', 'state': 'received'}"] == 1
    assert values["lensmodel_queue_jobs{'kind': 'photo', 'state': 'inspecting'}"] == 1
    assert values["lensmodel_queue_jobs{'kind': 'correction', 'state': 'queued'}"] == 0
    assert 0 < values["lensmodel_queue_oldest_seconds{'kind': 'photo'}"] < 60
    assert values["lensmodel_workers{}"] == 0
    assert values["lensmodel_rows{'table': 'photo'}"] == 2


def test_requests_and_psf_queries_are_counted_by_route_and_never_by_id(
    client: TestClient, steps: Any
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
    assert risen("lensmodel_psf_query_seconds_count{}") == 2
    assert risen("lensmodel_model_cache_total{'outcome': 'fitted'}") == 1
    assert risen("lensmodel_model_cache_total{'outcome': 'known'}") == 1
    assert after["lensmodel_model_cache_bytes{}"] > 0
    assert not any(lens in name or "somewhere" in name for name in after)


def test_what_workers_leave_in_files_is_told_by_the_api_and_added_up(
    client: TestClient, settings: Settings
) -> None:
    with accounted("photo", ("p", 1)) as record:
        record.retries(OutageError())
    own = numbers(metrics.generate_latest(metrics.WORKER).decode())
    for worker in ("one", "two"):
        metrics.leave(settings.data_dir, worker)

    values = asked(client)

    for name in (
        "lensmodel_job_seconds_count{'ending': 'done', 'kind': 'photo'}",
        "lensmodel_job_retries_total{'cause': 'outage', 'kind': 'photo'}",
    ):
        assert own[name] >= 1
        assert values[name] == 2 * own[name]


def test_numbers_of_workers_long_gone_are_forgotten(tmp_path: Path) -> None:
    metrics.leave(tmp_path, "old")
    old = tmp_path / metrics.FOLDER / "old.prom"
    os.utime(old, (0, time.time() - metrics.KEEP_S - 60))

    metrics.leave(tmp_path, "new")

    assert [path.name for path in (tmp_path / metrics.FOLDER).iterdir()] == ["new.prom"]


def test_a_torn_file_of_a_worker_hides_nothing_else(client: TestClient, settings: Settings) -> None:
    metrics.leave(settings.data_dir, "whole")
    (settings.data_dir / metrics.FOLDER / "torn.prom").write_text('lensmodel_job_seconds_count{kind="ph')

    assert "lensmodel_workers_fenced_total{}" in asked(client)


@pytest.mark.parametrize(("ending", "error"), [("done", None), ("raised", RuntimeError)])
def test_a_job_is_timed_however_it_ends(ending: str, error: type[Exception] | None) -> None:
    name = f"lensmodel_job_seconds_count{{'ending': '{ending}', 'kind': 'measure'}}"
    before = numbers(metrics.generate_latest(metrics.WORKER).decode()).get(name, 0.0)
    try:
        with accounted("measure", ("lens", 1)):
            if error is not None:
                raise error
    except RuntimeError:
        pass

    assert numbers(metrics.generate_latest(metrics.WORKER).decode())[name] == before + 1
