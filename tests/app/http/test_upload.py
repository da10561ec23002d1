"""Uploads: what arrives is what is stored, and what cannot be a photo never gets a row."""

from __future__ import annotations

import asyncio
import hashlib
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from app.blobs.storage import MARK
from app.http.upload import safe_name
from app.runtime.settings import Settings
from app.store import Store

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


def test_a_photo_is_stored_as_it_was_sent(client: TestClient, settings: Settings) -> None:
    answer = client.post("/v1/photos", files={"file": ("p1.tif", TIFF)}, data={"aperture": "1.4"})

    assert answer.status_code == 202
    photo = answer.json()
    assert photo["sha256"] == hashlib.sha256(TIFF).hexdigest()
    assert photo["state"] == "received"
    assert photo["aperture"] == 1.4
    assert answer.headers["location"] == photo["links"]["self"] == f"/v1/photos/{photo['id']}"
    assert [path.read_bytes() for path in blobs(settings)] == [TIFF]


def test_the_raw_body_and_the_form_are_the_same_upload(client: TestClient, settings: Settings) -> None:
    first = client.post("/v1/photos?filename=p1.tif&aperture=2.8", content=TIFF)
    second = client.post("/v1/photos", files={"file": ("other.tif", TIFF)})

    assert (first.status_code, second.status_code) == (202, 200)
    assert first.json()["id"] == second.json()["id"]
    assert first.json()["aperture"] == 2.8
    assert len(blobs(settings)) == 1


def test_fields_of_the_form_go_before_those_of_the_query(client: TestClient) -> None:
    answer = client.post(
        "/v1/photos?aperture=2&calibrate=true",
        files={"file": ("p.tif", TIFF)},
        data={"aperture": "4", "calibrate": "false", "lens_serial": ""},
    )

    assert answer.json()["aperture"] == 4.0
    assert answer.json()["calibrate"] is False


@pytest.mark.parametrize("where", ["form", "query"])
def test_a_photo_may_name_who_chooses_its_patches(client: TestClient, store: Store, where: str) -> None:
    query, data = ("", {"selector": "good-regions"}) if where == "form" else ("?selector=good-regions", {})
    answer = client.post(f"/v1/photos{query}", files={"file": ("p.tif", TIFF)}, data=data)

    assert answer.status_code == 202, answer.text
    row = store.photos.get(answer.json()["id"], "local")
    assert row is not None
    assert row.given == {"selector": "good-regions"}


def test_a_body_in_small_pieces_arrives_whole(client: TestClient, settings: Settings) -> None:
    body = form(
        ('name="aperture"', b"1.4"), ('name="file"; filename="p.tif"', TIFF), ('name="lens_model"', b"x")
    )

    answer = client.post(
        "/v1/photos", content=(body[k : k + 7] for k in range(0, len(body), 7)), headers=FORM
    )

    assert answer.status_code == 202
    assert answer.json()["sha256"] == hashlib.sha256(TIFF).hexdigest()
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
    "twice": (form(('name="aperture"', b"1.4"), ('name="aperture"', b"2")), FORM),
}


# Starlette leaves the file of a part that never ended to the collector
@pytest.mark.filterwarnings("ignore:.*SpooledTemporaryFile:pytest.PytestUnraisableExceptionWarning")
@pytest.mark.parametrize("name", [*NO_PHOTOS, *MALFORMED])
def test_what_is_no_upload_is_refused_and_leaves_nothing(
    client: TestClient, settings: Settings, store: Store, name: str
) -> None:
    body, headers = (NO_PHOTOS | MALFORMED)[name]
    answer = client.post("/v1/photos", content=body, headers=headers)

    problem = answer.json()
    expected = (415, "not_an_image") if name in NO_PHOTOS else (400, "malformed_upload")
    assert (answer.status_code, problem["code"]) == expected
    assert answer.headers["content-type"] == "application/problem+json"
    assert problem["detail"]
    assert problem["request_id"] == answer.headers["x-request-id"]
    assert blobs(settings) == []
    assert store.photos.page("local", before=None, limit=10) == []


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("aperture", "nan"),
        ("aperture", "inf"),
        ("aperture", "0.4"),
        ("aperture", "129"),
        ("aperture", "f/2"),
        ("focal_length_mm", "-1"),
        ("focus_distance_m", "0"),
        ("pixel_pitch_um", "1e9"),
        ("calibrate", "perhaps"),
        ("lens_serial", "a\x00b"),
        ("lens_id", "../../etc"),
        ("lens_model", "x" * 201),
        ("apperture", "2"),
    ],
)
def test_a_bad_field_is_named_with_its_value(
    client: TestClient, settings: Settings, field: str, value: str
) -> None:
    in_query = client.post("/v1/photos", params={field: value}, content=TIFF)
    in_form = client.post("/v1/photos", files={"file": ("p.tif", TIFF)}, data={field: value})

    for answer in (in_query, in_form):
        assert answer.status_code == 422
        problem = answer.json()
        assert problem["code"] == "invalid_parameter"
        assert [error["field"] for error in problem["errors"]] == [field]
        assert field in problem["detail"]
    assert blobs(settings) == []


def test_an_unknown_lens_is_refused_before_a_row_is_made(client: TestClient, settings: Settings) -> None:
    answer = client.post("/v1/photos?lens_id=nothing", content=TIFF)

    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_lens")
    assert blobs(settings) == []


def test_a_declared_length_beyond_the_limit_is_refused_unread(client: TestClient) -> None:
    answer = client.post("/v1/photos", content=TIFF, headers={"Content-Length": str(10**15)})

    assert (answer.status_code, answer.json()["code"]) == (413, "image_too_large")
    assert "LENS_MAX_UPLOAD_MB" in answer.json()["detail"]


def test_a_longer_body_than_allowed_is_cut_off_though_it_declares_nothing(
    client: TestClient, settings: Settings
) -> None:
    pieces = (TIFF for _ in range(60))

    answer = client.post("/v1/photos", content=pieces)

    assert answer.status_code == 413
    assert blobs(settings) == []


def test_too_many_unfinished_photos_are_refused(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.routes.photos.MAX_UNFINISHED", 1)
    client.post("/v1/photos", content=TIFF)

    answer = client.post("/v1/photos", content=TIFF + b"x")

    assert (answer.status_code, answer.json()["code"]) == (429, "quota_exceeded")
    assert int(answer.headers["retry-after"]) > 0


def test_a_photo_that_would_fill_the_disk_is_refused_unread(
    client: TestClient, monkeypatch: pytest.MonkeyPatch
) -> None:
    storage = client.app.state.services.storage  # type: ignore[attr-defined] # Starlette's own attribute
    monkeypatch.setattr(storage, "free_bytes", lambda: len(TIFF) - 1)

    assert client.post("/v1/photos", content=TIFF).status_code == 507


@pytest.mark.parametrize(
    ("sent", "shown"),
    [
        ("../../etc/passwd", "passwd"),
        ("C:\\photos\\p1.dng", "p1.dng"),
        ("..", "photo"),
        (None, "photo"),
        ("", "photo"),
        ("a\x00b\n.dng", "ab.dng"),
        ("Größe 写真.dng", "Größe 写真.dng"),
        ("x" * 500 + ".dng", "x" * 187 + ".dng"),
        ("\u202egnd.exe", "gnd.exe"),
    ],
)
def test_a_name_is_only_shown_and_never_a_path(sent: str | None, shown: str) -> None:
    assert safe_name(sent) == shown


def test_what_is_said_with_the_same_bytes_later_counts(client: TestClient, store: Store) -> None:
    photo = client.post("/v1/photos?calibrate=false", content=TIFF).json()["id"]

    learn = client.post("/v1/photos", content=TIFF)
    assert (learn.status_code, learn.json()["calibrate"]) == (202, True)
    assert client.post("/v1/photos", content=TIFF).status_code == 200

    store.photos.set_state(photo, ("received",), "needs_lens")
    assert client.post("/v1/photos", content=TIFF).json()["state"] == "needs_lens"
    assert client.post("/v1/photos?lens_serial=7", content=TIFF).json()["state"] == "received"


def test_an_upload_cut_off_by_the_client_leaves_no_blob(client: TestClient, settings: Settings) -> None:
    messages = iter([{"type": "http.request", "body": TIFF, "more_body": True}, {"type": "http.disconnect"}])
    sent: list[Any] = []

    async def receive() -> Any:
        return next(messages)

    async def send(message: Any) -> None:
        sent.append(message)

    scope: dict[str, Any] = {
        "type": "http",
        "method": "POST",
        "path": "/v1/photos",
        "raw_path": b"/v1/photos",
        "query_string": b"",
        "headers": [],
        "client": None,
        "server": None,
        "scheme": "http",
        "http_version": "1.1",
        "app": client.app,
    }
    asyncio.run(client.app(scope, receive, send))  # type: ignore[arg-type] # the client's idea of ASGI

    assert blobs(settings) == []
    assert sent[0]["status"] == 400


@pytest.mark.parametrize(
    ("query", "said"),
    [("selector=best", "good-regions"), ("selector=good-regions&kind=target", "leave one out")],
)
def test_a_selector_that_nobody_can_follow_is_refused(
    client: TestClient, settings: Settings, query: str, said: str
) -> None:
    answer = client.post(f"/v1/photos?filename=p.tif&{query}", content=TIFF)

    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_parameter")
    assert said in answer.json()["detail"]
    assert blobs(settings) == []


@pytest.mark.parametrize("name", ["фото.dng", "Müller.dng"])
def test_a_form_names_its_file_in_any_script(client: TestClient, name: str) -> None:
    body = form((f'name="file"; filename="{name}"', TIFF))

    assert client.post("/v1/photos", content=body, headers=FORM).json()["filename"] == name


def test_a_name_with_folders_does_not_leave_the_storage(client: TestClient, settings: Settings) -> None:
    photo = client.post("/v1/photos", files={"file": ("../../../evil.dng", TIFF)}).json()

    assert photo["filename"] == "evil.dng"
    assert [path.name for path in blobs(settings)] == ["original"]
