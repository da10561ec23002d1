"""A full disk, a hanging store, waiting photos and many at once: refused in time, and never for good."""

from __future__ import annotations

import os
import socket
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from unittest import mock

import pytest
import small_disk as disks
from conftest import Steps
from deadline import until
from servers import environment_of_s3, postgres
from starlette.testclient import TestClient

from app.blobs.storage import MARK
from app.main import create_app
from app.routes import health
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import upgrade

TIFF = b"II*\x00" + bytes(9000)


def installed(settings: Settings) -> TestClient:
    """Make the tables of an application, and return it."""
    with closing(Store(settings)) as opened:
        upgrade(opened.database)
    return TestClient(create_app(settings), raise_server_exceptions=False)


def test_photos_that_wait_for_their_owner_keep_no_others_out(
    client: TestClient, steps: Steps, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_UNFINISHED", 2)
    for _ in range(5):
        steps.waiting()

    *sent, refused = (client.post("/v1/photos", content=TIFF + bytes([k])) for k in range(3))

    assert [answer.status_code for answer in sent] == [202, 202]
    assert (refused.status_code, refused.json()["code"]) == (429, "quota_exceeded")
    assert int(refused.headers["retry-after"]) > 0


def pieces(megabytes: int) -> Iterator[bytes]:
    yield b"II*\x00"
    for _ in range(megabytes):
        yield bytes(1 << 20)


@pytest.mark.tools
def test_an_upload_without_a_length_that_fills_the_disk_is_refused_and_leaves_nothing(
    settings: Settings, tmp_path: Path
) -> None:
    disk = tmp_path / "disk"
    disk.mkdir()
    with disks.small_disk(disk, 64) as made:
        if not made:
            pytest.skip("needs root and the right to mount a small disk")
        cramped = settings.model_copy(update={"data_dir": disk / "data", "max_upload_mb": 200})
        with installed(cramped) as client:
            answer = client.post("/v1/photos", content=pieces(100))

            assert (answer.status_code, answer.json()["code"]) == (507, "quota_exceeded")
            assert "delete photos" in answer.json()["detail"]
            files = [path.name for path in (disk / "data/blobs").rglob("*") if path.is_file()]
            assert files == [MARK]
            # the store lets go of the torn file in a thread of its own
            until(lambda: client.post("/v1/photos", content=TIFF).status_code == 202, within_s=60)


@pytest.mark.tools
@pytest.mark.slow
def test_the_same_bytes_are_sent_and_deleted_by_many_at_once(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_UPLOADS", 50)
    said: Counter[tuple[str, int]] = Counter()

    def send_and_delete(client: TestClient) -> None:
        for _ in range(10):
            sent = client.post("/v1/photos", content=TIFF)
            said["sent", sent.status_code] += 1
            if sent.status_code < 300:
                gone = client.delete(f"/v1/photos/{sent.json()['id']}")
                said["deleted", gone.status_code] += 1

    with postgres() as server:
        many = settings.model_copy(update={"database_url": server.url("app")})
        with installed(many) as client, ThreadPoolExecutor(8) as threads:
            for done in [threads.submit(send_and_delete, client) for _ in range(8)]:
                done.result()

    assert set(said) <= {("sent", 200), ("sent", 202), ("deleted", 204), ("deleted", 404)}, said


@pytest.fixture
def hanging(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """A service whose object store takes connections and never answers."""
    monkeypatch.setattr(health, "READY_S", 0.5)
    elsewhere = settings.model_copy(update={"storage_url": "s3://bucket", "storage_seconds": 2.0})
    with closing(socket.create_server(("127.0.0.1", 0))) as deaf:
        environment = environment_of_s3(f"127.0.0.1:{deaf.getsockname()[1]}")
        with mock.patch.dict(os.environ, environment), TestClient(create_app(elsewhere)) as client:
            yield client


def test_a_store_that_hangs_is_told_by_readiness_and_uploads_in_time(hanging: TestClient) -> None:
    began = time.monotonic()
    ready = hanging.get("/readyz")
    between = time.monotonic()
    upload = hanging.post("/v1/photos", content=TIFF)
    ended = time.monotonic()

    assert (ready.status_code, upload.status_code, upload.json()["code"]) == (503, 503, "busy")
    assert "no answer within 0.5 s" in ready.json()["checks"]["storage"]
    assert ready.json()["checks"]["schema"] == "ok"
    assert "storage does not answer" in upload.json()["detail"]
    # of a busy machine; without a deadline it is minutes
    assert max(between - began, ended - between) < 30
