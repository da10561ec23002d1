"""Lenses renamed, merged, set back; their profiles and reports over HTTP."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import replace
from typing import Any

import pytest
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.runtime.settings import Settings
from app.store import LensName, Store
from app.store.lenses import report_key
from app.store.owners import ANY_OWNER
from lensmodel.core.codec import to_json
from lensmodel.model import LensModel, ModelSettings
from lensmodel.model.answer import PAPER
from lensmodel.model.profile import Camera, read_profile, write_profile
from lensmodel.report import lens_report

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other


def put_profile(client: TestClient, lens: str, content: bytes, **query: bool) -> tuple[dict[str, Any], Any]:
    """Send a profile; return its job once that has ended, and the lens."""
    answer = client.put(f"/v1/lenses/{lens}/profile", content=content, params=query)
    assert answer.status_code == 202, answer.text
    job = {"state": "queued"}
    while job["state"] in {"queued", "running"}:
        job = client.get(answer.headers["location"], params={"wait": 2}).json()
    return job, client.get(f"/v1/lenses/{lens}").json()


def test_several_photos_are_named_at_once(client: TestClient, steps: Steps, store: Store) -> None:
    photos = [steps.receive() for _ in range(3)]
    for photo in photos:
        steps.inspect(photo, serial=None)
        store.photos.set_state(photo.public_id, ("inspecting",), "needs_lens")
    keys = [photo.public_id for photo in photos]

    named = client.patch(
        "/v1/photos", json={"photo_ids": keys, "new_lens": {"label": "Mine"}, "aperture": 2.0}
    )

    assert named.status_code == 200, named.text
    rows = [steps.fresh(photo) for photo in photos]
    assert len({row.given["lens_id"] for row in rows}) == 1
    assert {row.given["aperture"] for row in rows} == {2.0}
    assert {row.state for row in rows} == {"received"}


def test_a_lens_is_renamed_and_named_after_its_model_again(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted())

    assert client.patch(f"/v1/lenses/{lens}", json={"label": "Old one"}).json()["label"] == "Old one"
    assert client.patch(f"/v1/lenses/{lens}", json={"label": None}).json()["label"] is None


def test_merged_lenses_are_one(client: TestClient, steps: Steps, store: Store) -> None:
    one, two = (steps.counted(serial=serial) for serial in ("1", "2"))
    first, second = steps.lens_id(one), steps.lens_id(two)

    asked = client.patch(f"/v1/lenses/{first}", json={"merge_into": second})
    merged = client.patch(f"/v1/lenses/{first}", json={"merge_into": second, "any_lens": True}).json()

    assert (asked.status_code, asked.json()["code"]) == (409, "other_lens")
    assert "its serial number is 1, that of the lens 2" in asked.json()["detail"]
    assert (merged["id"], merged["photos"], merged["samples"]) == (second, 2, 12)
    assert client.get(f"/v1/lenses/{first}").status_code == 404
    assert steps.lens_id(one) == second
    busy = steps.receive()
    steps.inspect(busy, serial="3")
    third = steps.lens_id(busy)
    refused = client.patch(f"/v1/lenses/{third}", json={"merge_into": second, "any_lens": True})
    assert (refused.status_code, refused.json()["code"]) == (409, "conflict")


@pytest.mark.usefixtures("reading")
def test_its_own_profile_tells_a_lens_nothing(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted())
    file = client.get(f"/v1/lenses/{lens}/profile").content
    known = client.get(f"/v1/lenses/{lens}").json()

    _, again = put_profile(client, lens, file)

    assert [again[name] for name in ("photos", "samples", "version")] == [
        known[name] for name in ("photos", "samples", "version")
    ]


@pytest.mark.usefixtures("reading")
def test_a_profile_goes_out_and_comes_back(client: TestClient, steps: Steps, store: Store) -> None:
    lens = steps.lens_id(steps.counted(patches=4))
    other = steps.named(LensName(None, None, None, label="Another"))
    sent = client.get(f"/v1/lenses/{lens}/profile")
    assert sent.headers["content-disposition"].endswith(".lensprofile")

    job, taken = put_profile(client, other, sent.content)
    _, again = put_profile(client, other, sent.content)

    assert job["state"] == "succeeded", job
    assert (taken["photos"], taken["samples"]) == (1, 12)
    assert again == taken
    question = {"r": 0.5, "phi": 0.4, "aperture": 1.4}
    kernels = [
        client.get(f"/v1/lenses/{key}/psf.json", params=question).json()["psf"] for key in (lens, other)
    ]
    assert kernels[0] == kernels[1]
    photo = client.get("/v1/photos", params={"lens_id": other}).json()["items"][0]
    refused = client.post("/v1/corrections", json={"photo_id": photo["id"]})
    assert refused.status_code == 409
    bad = client.put(f"/v1/lenses/{other}/profile", content=b"no profile")
    assert (bad.status_code, bad.json()["code"]) == (400, "malformed_upload")
    assert client.put("/v1/lenses/gone/profile", content=sent.content).status_code == 404
    listed = client.get("/v1/photos").json()["items"]
    assert {entry["kind"] for entry in listed} == {None}  # photos, and no files of profiles


@pytest.mark.usefixtures("reading")
def test_a_profile_of_another_lens_is_refused_until_its_owner_insists(
    client: TestClient, steps: Steps
) -> None:
    first, second = (steps.lens_id(steps.counted(patches=4, serial=serial)) for serial in ("1", "2"))
    sent = client.get(f"/v1/lenses/{first}/profile").content

    refused, untouched = put_profile(client, second, sent)
    assert (refused["error"]["status"], refused["error"]["code"]) == (409, "other_lens")
    assert "its serial number is 1, that of the lens 2" in refused["error"]["detail"]
    assert untouched["photos"] == 1
    taken, lens = put_profile(client, second, sent, any_lens=True)
    assert (taken["state"], lens["photos"]) == ("succeeded", 2)


@pytest.mark.usefixtures("reading")
def test_a_lens_is_made_of_a_profile_alone(client: TestClient, steps: Steps) -> None:
    sent = client.get(f"/v1/lenses/{steps.lens_id(steps.counted(patches=4))}/profile").content

    made = client.post("/v1/lenses", json={"label": "Given away"})
    assert (made.status_code, made.json()["label"], made.json()["photos"]) == (201, "Given away", 0)
    assert put_profile(client, made.json()["id"], sent)[1]["photos"] == 1
    assert "Given away" in client.get("/").text


D750, BODY = Camera("NIKON CORPORATION", "NIKON D750", "1"), Camera("Leica", "M8")


@pytest.mark.usefixtures("reading")
@pytest.mark.parametrize(
    ("lens", "cameras", "name"),
    [
        ({"label": "Grandfather's", "maker": "Zeiss", "model": "Biotar"}, (D750,), "Grandfather's"),
        ({"maker": "Canon", "model": "EF24mm f/1.4L"}, (D750,), "Canon EF24mm f/1.4L"),
        ({"serial": "77"}, (D750, replace(D750, serial="2")), "Nikon D750, 24 mm"),
        ({}, (D750, BODY), "file"),
        ({}, tuple(Camera("Leica", f"M{k}") for k in range(101)), "file"),
        ({}, (), "file"),
        ({"label": "two\nlines"}, (), "file"),
    ],
)
def test_a_lens_made_of_a_profile_is_called_as_that_says_else_as_its_file(
    client: TestClient, steps: Steps, lens: dict[str, str], cameras: tuple[Camera, ...], name: str
) -> None:
    sent, of = io.BytesIO(), steps.lens_id(steps.counted(patches=4))
    known = read_profile(io.BytesIO(client.get(f"/v1/lenses/{of}/profile").content), "The answer")
    write_profile(sent, replace(known, lens=lens, cameras=cameras))
    made, kept = (client.post("/v1/lenses", json={"label": "file"}).json()["id"] for _ in range(2))

    for lens_id, rename, called in ((made, True, name), (kept, False, "file")):
        job, shown = put_profile(client, lens_id, sent.getvalue(), rename=rename)
        assert (job["state"], shown["label"]) == ("succeeded", called)


def test_a_profile_is_not_read_beside_the_keys_of_the_database(
    client: TestClient, steps: Steps, store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = steps.lens_id(steps.counted(patches=4))
    sent = client.get(f"/v1/lenses/{lens}/profile").content
    other = steps.named(LensName(None, None, None, label="Another"))
    read: list[object] = []
    monkeypatch.setattr(zipfile.ZipFile, "read", lambda *_: read.append("read"))

    answer = client.put(f"/v1/lenses/{other}/profile", content=sent)

    assert (answer.status_code, read) == (202, [])
    job = client.get(answer.headers["location"]).json()
    assert (job["state"], job["id"]) == ("queued", store.jobs.to_do()[-1].arguments[0])
    assert client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 202


@pytest.mark.usefixtures("reading")
def test_a_profile_of_another_model_is_refused(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted(patches=4))
    profile = read_profile(io.BytesIO(client.get(f"/v1/lenses/{lens}/profile").content), "The answer")
    sent = io.BytesIO()
    paper = LensModel.fit(profile.model.samples, ModelSettings(mode=PAPER))
    write_profile(sent, replace(profile, model=paper))

    job, _ = put_profile(client, lens, sent.getvalue())

    assert job["error"]["code"] == "conflict"


@pytest.fixture
def reported(client: TestClient, steps: Steps, store: Store, settings: Settings) -> str:
    """A lens whose newest version has its report."""
    lens_id: str = steps.lens_id(steps.counted(patches=6))
    _, stored = store.lenses.samples_of(lens_id)
    test = lens_report(LensModel.fit(stored), "A lens", rows=5, size=15, channels=("g",))
    lens = store.lenses.get(lens_id, ANY_OWNER)
    assert lens is not None
    key = report_key(lens_id, lens.version, lens.rebuild_epoch)
    Storage(settings.storage).put(key, json.dumps(to_json(test)).encode())
    return lens_id


@pytest.mark.parametrize(
    ("form", "begins"),
    [("json", b"{"), ("csv", b"quantity,"), ("pdf", b"%PDF-")],
)
def test_a_report_comes_in_each_form(client: TestClient, reported: str, form: str, begins: bytes) -> None:
    address = f"/v1/lenses/{reported}/report.{form}"
    answer = client.get(address)

    assert answer.status_code == 200, answer.text
    assert answer.content.startswith(begins)
    if form == "json":
        details = answer.json()["details"]
        assert details["Photos"].endswith(".dng")
        assert details["Written"].startswith("20")
    assert client.get(address, headers={"If-None-Match": answer.headers["etag"]}).status_code == 304


def test_a_report_that_is_not_made_yet_says_so(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted())
    answer = client.get(f"/v1/lenses/{lens}/report.json")

    assert (answer.status_code, answer.json()["code"]) == (409, "not_ready")


def test_the_page_of_a_lens_shows_its_test(client: TestClient, reported: str) -> None:
    first, page = client.get(f"/lenses/{reported}").text, client.get(f"/lenses/{reported}/tests").text

    for title in ("What it does to your pictures", "Is it a good copy?", "Which photo next?"):
        assert title in first
    assert "this copy is" in first
    assert 'alt="MTF50 in cycles/pixel' in page
    charts = client.get(f"/ui/lenses/{reported}/charts", params={"unit": "lp/mm", "aperture": "1.4"})
    assert "MTF50 in line pairs per mm" in charts.text
    for wrong in ({"aperture": ".."}, {"aperture": "x"}):
        answer = client.get(f"/ui/lenses/{reported}/charts", params=wrong)
        assert answer.status_code == 422, (wrong, answer.text)
    assert "PATCH" not in page


def test_photos_that_cannot_all_change_stay_as_they_are(client: TestClient, steps: Any) -> None:
    lens, photo = steps.lens_id(steps.counted()), steps.receive()

    answer = client.patch("/v1/photos", json={"photo_ids": [photo.public_id, "gone"], "lens_id": lens})

    assert (answer.status_code, answer.json()["code"]) == (404, "unknown_photo")
    assert "lens_id" not in steps.fresh(photo).given


@pytest.mark.usefixtures("reading")
def test_a_profile_that_unpacks_to_more_than_a_lens_needs_is_not_unpacked(
    client: TestClient, steps: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = steps.lens_id(steps.counted())
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", bytes(1 << 20))
    monkeypatch.setattr("app.jobs.work.MAX_UNPACKED", (1 << 20) - 1)
    read: list[str] = []
    monkeypatch.setattr("app.jobs.tasks.read_profile", lambda *_: read.append("read"))

    job, _ = put_profile(client, lens, bomb.getvalue())

    assert (job["error"]["status"], read) == (413, [])
    assert client.put(f"/v1/lenses/{lens}/profile", content=b"no archive").status_code == 400
