"""Uploads: what arrives is what is stored, and what cannot be a photo never gets a row."""

from __future__ import annotations

import asyncio
import hashlib
import os
import socket
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from typing import Any
from unittest import mock
from urllib.parse import urlencode

import pytest
from deadline import until
from servers import environment_of_s3, postgres
from small_disk import small_disk
from starlette.testclient import TestClient
from states import Steps, refusal, services_of

from app.blobs.storage import MARK
from app.http.upload import safe_name
from app.main import create_app
from app.routes import health
from app.routes.photos import MAX_UPLOADS
from app.runtime.settings import Settings
from app.store import Store
from app.store.database import upgrade

TIFF = b"II*\x00" + bytes(range(256)) * 100
BOUNDARY = "x-boundary-x"
FORM = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}


def form(*parts: tuple[str, bytes], end: bool = True) -> bytes:
    body = b"".join(
        f"--{BOUNDARY}\r\nContent-Disposition: form-data; {head}\r\n\r\n".encode() + value + b"\r\n"
        for head, value in parts
    )
    return body + (f"--{BOUNDARY}--\r\n".encode() if end else b"")


def blobs(settings: Settings) -> list[Path]:
    files = (settings.data_dir / "blobs").rglob("*")
    return [path for path in files if path.is_file() and path.name != MARK]


def send(client: TestClient, query: str = "", content: Any = TIFF, **said: str) -> Any:
    """Send a photo as the body or, with fields, in a form."""
    if said:
        return client.post(f"/v1/photos?{query}", files={"file": ("p1.tif", content)}, data=said)
    return client.post(f"/v1/photos?{query}", content=content)


def test_a_photo_is_stored_once_as_it_was_sent(client: TestClient, settings: Settings) -> None:
    answer = send(client, aperture="1.4")
    again = send(client, "filename=other.tif&aperture=2.8")

    photo = answer.json()
    assert (answer.status_code, again.status_code) == (202, 200)
    assert photo["id"] == again.json()["id"]
    assert (photo["filename"], photo["state"], photo["aperture"]) == ("p1.tif", "received", 1.4)
    assert photo["sha256"] == hashlib.sha256(TIFF).hexdigest()
    assert answer.headers["location"] == photo["links"]["self"] == f"/v1/photos/{photo['id']}"
    assert [path.read_bytes() for path in blobs(settings)] == [TIFF]


def test_fields_of_the_form_go_before_those_of_the_query(client: TestClient) -> None:
    answer = send(client, "aperture=2&calibrate=true", aperture="4", calibrate="false", lens_serial="")

    assert (answer.json()["aperture"], answer.json()["calibrate"]) == (4.0, False)


def test_a_body_in_small_pieces_arrives_whole(client: TestClient, settings: Settings) -> None:
    fields = ('name="aperture"', b"1.4"), ('name="lens_model"', b"x")
    body = form(fields[0], ('name="file"; filename="p.tif"', TIFF), fields[1])
    pieces = (body[k : k + 7] for k in range(0, len(body), 7))

    assert client.post("/v1/photos", content=pieces, headers=FORM).status_code == 202
    assert blobs(settings)[0].read_bytes() == TIFF


ONE = ('name="file"; filename="a"', TIFF)
NO_PHOTOS = {
    "text": (b"hello, I am a text", {}),
    "zeros": (b"\x00" * 9000, {}),
    "program": (b"MZ" + b"\x90" * 9000, {}),
    "svg": (b"<svg xmlns='http://www.w3.org/2000/svg'/>", {}),
}
MALFORMED = {
    "empty": (b"", {}),
    "no-file": (form(('name="other"', b"1")), FORM),
    "two-files": (form(ONE, ONE), FORM),
    "cut-off": (form(ONE, end=False), FORM),
    "empty-file": (form(('name="file"; filename="a"', b"")), FORM),
    "file-elsewhere": (form(('name="aperture"; filename="a"', TIFF)), FORM),
    "nameless": (form(("", TIFF)), FORM),
    "not-multipart": (b"garbage", FORM),
    "no-boundary": (TIFF, {"Content-Type": "multipart/form-data"}),
    "urlencoded": (b"a=1", {"Content-Type": "application/x-www-form-urlencoded"}),
    "many-parts": (form(*((f'name="f{k}"', b"") for k in range(40))), FORM),
    "huge-field": (form(('name="lens_model"', b"x" * 100000)), FORM),
    "file-without-a-name": (form(('name="lens_model"', b"x"), ('name="file"', TIFF)), FORM),
    "twice": (form(ONE, ('name="aperture"', b"1.4"), ('name="aperture"', b"2")), FORM),
}


# Starlette leaves the file of a part that never ended to the collector
@pytest.mark.filterwarnings("ignore:.*SpooledTemporaryFile:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("name", [*NO_PHOTOS, *MALFORMED])
def test_what_is_no_upload_is_refused_and_leaves_nothing(
    client: TestClient, settings: Settings, store: Store, name: str
) -> None:
    body, headers = (NO_PHOTOS | MALFORMED)[name]
    answer = client.post("/v1/photos", content=body, headers=headers)

    assert refusal(answer) == ((415, "not_an_image") if name in NO_PHOTOS else (400, "malformed_upload"))
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.json()["detail"]
    assert blobs(settings) == []
    assert store.photos.page("local", before=None, limit=10) == []


BAD_FIELDS = {
    "aperture": ("nan", "inf", "0.4", "129", "f/2"),
    "pixel_pitch_um": ("1e9",),
    "lens_serial": ("a\x00b",),
    "lens_id": ("../../etc",),
    "lens_model": ("x" * 201,),
    "apperture": ("2",),
}


def test_a_bad_field_is_named_with_its_value(client: TestClient, settings: Settings) -> None:
    for field, value in ((field, value) for field, values in BAD_FIELDS.items() for value in values):
        query = urlencode({field: value})
        for answer in (send(client, query), send(client, **{field: value})):
            assert (field, value, *refusal(answer)) == (field, value, 422, "invalid_parameter")
            assert [error["field"] for error in answer.json()["errors"]] == [field]
            assert field in answer.json()["detail"]
    assert blobs(settings) == []


def test_an_unknown_selector_is_refused_with_the_known_ones(client: TestClient, settings: Settings) -> None:
    answer = send(client, "selector=best")

    assert refusal(answer) == (422, "invalid_parameter")
    assert "good-regions" in answer.json()["detail"]
    assert blobs(settings) == []


def test_too_long_a_body_is_refused_unread_or_cut_off(client: TestClient, settings: Settings) -> None:
    declared = client.post("/v1/photos", content=TIFF, headers={"Content-Length": str(10**15)})
    silent = send(client, content=(TIFF for _ in range(60)))

    assert refusal(declared) == refusal(silent) == (413, "image_too_large")
    assert "LENS_MAX_UPLOAD_MB" in declared.json()["detail"]
    assert blobs(settings) == []


def test_a_photo_for_a_full_disk_is_refused_unread(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(services_of(client).storage, "free_bytes", lambda: len(TIFF) - 1)

    assert send(client).status_code == 507


def test_a_name_is_only_shown_and_never_a_path(client: TestClient, settings: Settings) -> None:
    for sent, shown in {
        "../../etc/passwd": "passwd",
        "C:\\photos\\p1.dng": "p1.dng",
        "..": "photo",
        None: "photo",
        "": "photo",
        "a\x00b\n.dng": "ab.dng",
        "x" * 500 + ".dng": "x" * 187 + ".dng",
        "\u202egnd.exe": "gnd.exe",
    }.items():
        assert safe_name(sent) == shown

    for number, name in enumerate(("../../../evil.dng", "фото.dng", "Größe 写真.dng")):
        body = form((f'name="file"; filename="{name}"', TIFF + bytes([number])))
        photo = client.post("/v1/photos", content=body, headers=FORM).json()
        assert photo["filename"] == name.removeprefix("../../../")
    assert {path.name for path in blobs(settings)} == {"original"}


def test_what_is_said_with_the_same_bytes_later_counts(client: TestClient, store: Store) -> None:
    photo = send(client, "calibrate=false").json()["id"]

    learn = send(client)
    assert (learn.status_code, learn.json()["calibrate"]) == (202, True)
    assert send(client).status_code == 200

    store.photos.set_state(photo, ("received",), "needs_lens")
    assert send(client).json()["state"] == "needs_lens"
    assert send(client, "lens_serial=7").json()["state"] == "received"


def test_an_upload_cut_off_by_the_client_leaves_no_blob(client: TestClient, settings: Settings) -> None:
    messages = iter([{"type": "http.request", "body": TIFF, "more_body": True}, {"type": "http.disconnect"}])
    sent: list[Any] = []

    async def receive() -> Any:
        return next(messages)

    async def send(message: Any) -> None:
        sent.append(message)

    path = {"path": "/v1/photos", "raw_path": b"/v1/photos", "query_string": b""}
    asked = {"type": "http", "http_version": "1.1", "scheme": "http", "method": "POST", "headers": []}
    scope = {**asked, **path, "client": None, "server": None, "app": client.app}
    asyncio.run(client.app(scope, receive, send))  # type: ignore[arg-type] # the client's idea of ASGI

    assert blobs(settings) == []
    assert sent[0]["status"] == 400
    assert services_of(client).uploads._value == MAX_UPLOADS  # its place is free again


# --- a full disk, a hanging store, many at once: refused in time, and never for good -----------


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
    with small_disk(disk, 64) as made:
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
