"""Lenses renamed, merged, set back; their profiles and reports over HTTP."""

from __future__ import annotations

import io
import zipfile
from dataclasses import replace
from typing import Any

import pytest
from starlette.testclient import TestClient
from states import Steps, refusal, store_report

from app.store import LensName, Store
from lensmodel.model import LensModel, LensProfile, ModelSettings
from lensmodel.model.answer import PAPER
from lensmodel.model.profile import Camera, read_profile, write_profile


def put_profile(client: TestClient, lens: str, content: bytes, **query: bool) -> tuple[dict[str, Any], Any]:
    """Send a profile; return its job once that has ended, and the lens."""
    answer = client.put(f"/v1/lenses/{lens}/profile", content=content, params=query)
    assert answer.status_code == 202, answer.text
    job = {"state": "queued"}
    while job["state"] in {"queued", "running"}:
        job = client.get(answer.headers["location"], params={"wait": 2}).json()
    return job, client.get(f"/v1/lenses/{lens}").json()


@pytest.fixture
def lens(steps: Steps) -> str:
    """A lens that knows its blur at four places."""
    return steps.lens_id(steps.counted(patches=4))


@pytest.fixture
def profile(client: TestClient, lens: str) -> bytes:
    sent = client.get(f"/v1/lenses/{lens}/profile")
    assert sent.headers["content-disposition"].endswith(".lensprofile")
    return sent.content


def changed(profile: bytes, **changes: Any) -> bytes:
    """Return a profile in which something else is written."""
    known: LensProfile = read_profile(io.BytesIO(profile), "The answer")
    out = io.BytesIO()
    write_profile(out, replace(known, **changes))
    return out.getvalue()


@pytest.fixture
def other(steps: Steps) -> str:
    """A lens without photos."""
    return steps.named(LensName(None, None, None, label="Another"))


def test_several_photos_are_named_at_once_or_none(client: TestClient, steps: Steps, lens: str) -> None:
    photos = [steps.waiting() for _ in range(3)]
    keys = [photo.public_id for photo in photos]

    gone = client.patch("/v1/photos", json={"photo_ids": [keys[0], "gone"], "lens_id": lens})
    assert refusal(gone) == (404, "unknown_photo")
    assert "lens_id" not in steps.fresh(photos[0]).given
    change = {"photo_ids": keys, "new_lens": {"label": "Mine"}, "aperture": 2.0}
    named = client.patch("/v1/photos", json=change)

    assert named.status_code == 200, named.text
    rows = [steps.fresh(photo) for photo in photos]
    assert len({row.given["lens_id"] for row in rows}) == 1
    assert {(row.given["aperture"], row.state) for row in rows} == {(2.0, "received")}


def test_a_lens_is_renamed_and_named_after_its_model_again(client: TestClient, lens: str) -> None:
    for label in ("Old one", None):
        assert client.patch(f"/v1/lenses/{lens}", json={"label": label}).json()["label"] == label


def test_merged_lenses_are_one(client: TestClient, steps: Steps) -> None:
    def merge(one: str, other: str, **insisting: bool) -> Any:
        return client.patch(f"/v1/lenses/{one}", json={"merge_into": other, **insisting})

    one, two = (steps.counted(serial=serial) for serial in ("1", "2"))
    first, second = steps.lens_id(one), steps.lens_id(two)

    asked = merge(first, second)
    merged = merge(first, second, any_lens=True).json()

    assert refusal(asked) == (409, "other_lens")
    assert "its serial number is 1, that of the lens 2" in asked.json()["detail"]
    assert (merged["id"], merged["photos"], merged["samples"]) == (second, 2, 12)
    assert client.get(f"/v1/lenses/{first}").status_code == 404
    assert steps.lens_id(one) == second
    busy = steps.receive()
    steps.inspect(busy, serial="3")
    assert refusal(merge(steps.lens_id(busy), second, any_lens=True)) == (409, "conflict")


@pytest.mark.usefixtures("reading")
def test_a_profile_goes_out_and_comes_back_once(
    client: TestClient, lens: str, other: str, profile: bytes
) -> None:
    known = client.get(f"/v1/lenses/{lens}").json()

    job, taken = put_profile(client, other, profile)
    _, again = put_profile(client, other, profile)
    _, itself = put_profile(client, lens, profile)  # its own tells a lens nothing

    assert job["state"] == "succeeded", job
    assert (taken["photos"], taken["samples"], again) == (1, 12, taken)
    assert all(itself[name] == known[name] for name in ("photos", "samples", "version"))
    question = {"r": 0.5, "phi": 0.4, "aperture": 1.4}
    kernels = [client.get(f"/v1/lenses/{key}/psf.json", params=question).json() for key in (lens, other)]
    assert kernels[0]["psf"] == kernels[1]["psf"]
    photo = client.get("/v1/photos", params={"lens_id": other}).json()["items"][0]["id"]
    assert client.post("/v1/corrections", json={"photo_id": photo}).status_code == 409
    bad = client.put(f"/v1/lenses/{other}/profile", content=b"no profile")
    assert refusal(bad) == (400, "malformed_upload")
    assert client.put("/v1/lenses/gone/profile", content=profile).status_code == 404
    listed = client.get("/v1/photos").json()["items"]
    assert {entry["kind"] for entry in listed} == {None}  # photos, and no files of profiles


@pytest.mark.usefixtures("reading")
def test_a_profile_of_another_lens_is_refused_until_its_owner_insists(
    client: TestClient, steps: Steps, profile: bytes
) -> None:
    second = steps.lens_id(steps.counted(serial="2"))

    refused, untouched = put_profile(client, second, profile)
    taken, lens = put_profile(client, second, profile, any_lens=True)

    assert (refused["error"]["status"], refused["error"]["code"]) == (409, "other_lens")
    assert "its serial number is 123, that of the lens 2" in refused["error"]["detail"]
    assert (untouched["photos"], taken["state"], lens["photos"]) == (1, "succeeded", 2)


D750, BODY = Camera("NIKON CORPORATION", "NIKON D750", "1"), Camera("Leica", "M8")


@pytest.mark.usefixtures("reading")
@pytest.mark.parametrize(
    ("lens_is", "cameras", "name"),
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
def test_a_lens_made_of_a_profile_alone_is_called_as_that_says_else_as_its_file(
    client: TestClient, profile: bytes, lens_is: dict[str, str], cameras: tuple[Camera, ...], name: str
) -> None:
    sent = changed(profile, lens=lens_is, cameras=cameras)

    for rename, called in ((True, name), (False, "file")):
        made = client.post("/v1/lenses", json={"label": "file"})
        assert (made.status_code, made.json()["label"], made.json()["photos"]) == (201, "file", 0)
        job, shown = put_profile(client, made.json()["id"], sent, rename=rename)
        assert (job["state"], shown["label"], shown["photos"]) == ("succeeded", called, 1)


def test_a_profile_is_not_read_beside_the_keys_of_the_database(
    client: TestClient, store: Store, other: str, profile: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delattr(zipfile.ZipFile, "read")

    answer = client.put(f"/v1/lenses/{other}/profile", content=profile)

    assert answer.status_code == 202
    job = client.get(answer.headers["location"]).json()
    assert (job["state"], job["id"]) == ("queued", store.jobs.to_do()[-1].arguments[0])
    assert client.post(f"/v1/jobs/{job['id']}/cancel").status_code == 202


@pytest.mark.usefixtures("reading")
def test_a_profile_of_another_model_is_refused(client: TestClient, lens: str, profile: bytes) -> None:
    samples = read_profile(io.BytesIO(profile), "The answer").model.samples
    paper = LensModel.fit(samples, ModelSettings(mode=PAPER))

    job, _ = put_profile(client, lens, changed(profile, model=paper))

    assert job["error"]["code"] == "conflict"


@pytest.mark.usefixtures("reading")
def test_a_profile_that_unpacks_to_more_than_a_lens_needs_is_not_unpacked(
    client: TestClient, lens: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", bytes(1 << 20))
    monkeypatch.setattr("app.jobs.work.MAX_UNPACKED", (1 << 20) - 1)
    read: list[str] = []
    monkeypatch.setattr("app.jobs.tasks.read_profile", lambda *_: read.append("read"))

    job, _ = put_profile(client, lens, bomb.getvalue())

    assert (job["error"]["status"], read) == (413, [])


def test_a_report_comes_in_each_form_once_it_is_made_and_its_page_shows_it(
    client: TestClient, steps: Steps
) -> None:
    lens = steps.lens_id(steps.counted(patches=6))
    assert refusal(client.get(f"/v1/lenses/{lens}/report.json")) == (409, "not_ready")
    store_report(client, lens)

    for form, begins in (("json", b"{"), ("csv", b"quantity,"), ("pdf", b"%PDF-")):
        answer = client.get(f"/v1/lenses/{lens}/report.{form}")
        tag = {"If-None-Match": answer.headers["etag"]}
        assert answer.content.startswith(begins), answer.text
        assert client.get(f"/v1/lenses/{lens}/report.{form}", headers=tag).status_code == 304
    details = client.get(f"/v1/lenses/{lens}/report.json").json()["details"]
    assert details["Photos"].endswith(".dng")
    assert details["Written"].startswith("20")

    first, page = client.get(f"/lenses/{lens}").text, client.get(f"/lenses/{lens}/tests").text
    for title in ("What it does to your pictures", "Is it a good copy?", "Which photo next?"):
        assert title in first
    assert 'alt="MTF50 in cycles/pixel' in page
    assert "PATCH" not in page
    charts = f"/ui/lenses/{lens}/charts"
    assert "MTF50 in line pairs per mm" in client.get(f"{charts}?unit=lp/mm&aperture=1.4").text
    assert [client.get(f"{charts}?aperture={wrong}").status_code for wrong in ("..", "x")] == [422, 422]
