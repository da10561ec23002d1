"""A full disk, a hanging store, waiting photos and many at once: refused in time, and never for good."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import pytest
import small_disk as disks
from servers import postgres
from starlette.testclient import TestClient

from app.blobs.storage import MARK
from app.main import create_app
from app.routes import health
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import upgrade

TIFF = b"II*\x00" + bytes(9000)


# --- waiting for their owner ------------------------------------------------------------------


def test_photos_that_wait_for_their_owner_keep_no_others_out(
    settings: Settings, store: Store, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_UNFINISHED", 2)
    for _ in range(5):
        waiting = steps.receive()
        steps.inspect(waiting, serial=None)
        store.photos.set_state(waiting.public_id, ("inspecting",), "needs_lens")
    with TestClient(create_app(settings)) as client:
        sent = [client.post("/v1/photos", content=TIFF + bytes([k])).status_code for k in range(3)]

    assert sent == [202, 202, 429]


# --- a full disk ------------------------------------------------------------------------------


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    folder = tmp_path / "disk"
    folder.mkdir()
    with disks.small_disk(folder, 64) as made:
        if not made:
            pytest.skip("needs root and the right to mount a small disk")
        yield folder


@pytest.fixture
def on_small_disk(small_disk: Path, settings: Settings) -> Iterator[tuple[TestClient, Path]]:
    data = small_disk / "data"
    cramped = settings.model_copy(update={"data_dir": data, "database_url": "", "max_upload_mb": 200})
    opened = Store(cramped)
    upgrade(opened.database)
    with TestClient(create_app(cramped), raise_server_exceptions=False) as client:
        yield client, data
    opened.close()


def pieces(megabytes: int) -> Iterator[bytes]:
    yield b"II*\x00"
    for _ in range(megabytes):
        yield bytes(1 << 20)


@pytest.mark.tools
def test_an_upload_without_a_length_that_fills_the_disk_is_refused_and_leaves_nothing(
    on_small_disk: tuple[TestClient, Path],
) -> None:
    client, data = on_small_disk

    answer = client.post("/v1/photos", content=pieces(100))

    assert (answer.status_code, answer.json()["code"]) == (507, "quota_exceeded")
    assert "delete photos" in answer.json()["detail"]
    assert [path.name for path in (data / "blobs").rglob("*") if path.is_file()] == [MARK]
    end = time.monotonic() + 60
    while (small := client.post("/v1/photos", content=TIFF)).status_code != 202:
        assert time.monotonic() < end, small.text
        time.sleep(0.2)  # the store lets go of the torn file in a thread of its own


# --- the same bytes sent and deleted at once --------------------------------------------------


@pytest.mark.tools
@pytest.mark.slow
def test_the_same_bytes_are_sent_and_deleted_by_many_at_once(
    settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_UPLOADS", 50)
    with postgres() as server:
        many = settings.model_copy(update={"database_url": server.url("app")})
        opened = Store(many)
        upgrade(opened.database)
        said: Counter[tuple[str, int]] = Counter()
        with TestClient(create_app(many), raise_server_exceptions=False) as client:

            def send_and_delete() -> None:
                for _ in range(10):
                    sent = client.post("/v1/photos", content=TIFF)
                    said["sent", sent.status_code] += 1
                    if sent.status_code < 300:
                        gone = client.delete(f"/v1/photos/{sent.json()['id']}")
                        said["deleted", gone.status_code] += 1

            threads = [threading.Thread(target=send_and_delete) for _ in range(8)]
            for thread in threads:
                thread.start()
            for thread in threads:
                thread.join()
        opened.close()

    assert set(said) <= {("sent", 200), ("sent", 202), ("deleted", 204), ("deleted", 404)}, said


# --- a store that hangs -----------------------------------------------------------------------


@pytest.fixture
def hanging(settings: Settings, store: Store, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """A service whose object store takes connections and never answers."""
    monkeypatch.setattr(health, "READY_S", 0.5)
    with closing(socket.create_server(("127.0.0.1", 0))) as deaf:
        for name, value in {
            "AWS_ENDPOINT_URL": f"http://127.0.0.1:{deaf.getsockname()[1]}",
            "AWS_ALLOW_HTTP": "true",
            "AWS_REGION": "us-east-1",
            "AWS_ACCESS_KEY_ID": "x",
            "AWS_SECRET_ACCESS_KEY": "x",
        }.items():
            monkeypatch.setenv(name, value)
        elsewhere = settings.model_copy(update={"storage_url": "s3://bucket", "storage_seconds": 2.0})
        with TestClient(create_app(elsewhere), raise_server_exceptions=False) as client:
            yield client


def test_a_store_that_hangs_is_told_by_readiness_in_time(hanging: TestClient) -> None:
    began = time.monotonic()

    answer = hanging.get("/readyz")

    assert answer.status_code == 503
    assert "no answer within 0.5 s" in answer.json()["checks"]["storage"]
    assert answer.json()["checks"]["schema"] == "ok"
    assert time.monotonic() - began < 30  # of a busy machine; without a deadline it is minutes


def test_an_upload_to_a_store_that_hangs_ends_in_time(hanging: TestClient) -> None:
    began = time.monotonic()

    answer = hanging.post("/v1/photos", content=TIFF)

    assert (answer.status_code, answer.json()["code"]) == (503, "busy")
    assert "storage does not answer" in answer.json()["detail"]
    assert time.monotonic() - began < 30
