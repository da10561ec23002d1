"""Lenses over HTTP: their PSFs, always current and in each format; merged, taken along, reported."""

from __future__ import annotations

import io
import math
import zipfile
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from sqlalchemy import update
from starlette.testclient import TestClient
from states import Steps, refusal, store_report

from app.http import model_cache
from app.http.model_cache import ModelCache
from app.routes.psf import accepted
from app.schemas import PsfQuery
from app.store import LensName, Store
from app.store.tables import SampleRow
from lensmodel.core.psf import centroid, rms_width
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.model.identity import Camera
from lensmodel.model.profile import read_profile, write_profile
from lensmodel.model.query import PAPER

PLACE = "r=0.9&phi=0.59&aperture=1.4"


@pytest.fixture
def lens(steps: Steps) -> str:
    """Return the path of a lens with one counted photo of six patches."""
    return f"/v1/lenses/{steps.lens_id(steps.counted(patches=6))}"


def ask(client: TestClient, lens: str, **query: float | str) -> dict[str, Any]:
    answer = client.get(f"{lens}/psf", params={"r": 0.9, "phi": 0.59, "aperture": 1.4, **query})
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def test_a_lens_tells_who_it_is_and_what_it_knows(client: TestClient, lens: str) -> None:
    shown = client.get(lens).json()

    told = {"maker": "Canon", "model": "EF24mm f/1.4L", "serial": "123", "serial_source": "exif"}
    known = {"version": 1, "photos": 1, "samples": 18, "apertures": [1.4], "focal_lengths_mm": [24.0]}
    assert shown.items() >= (told | known).items()
    assert client.get(shown["links"]["photos"]).json()["items"][0]["lens_id"] == shown["id"]
    assert shown["id"] in lens
    assert "123" not in str(shown["links"]).replace(shown["id"], "")


def test_a_psf_is_a_normalised_centred_kernel(client: TestClient, lens: str) -> None:
    answer, once_round = ask(client, lens), ask(client, lens, phi=0.59 + 2 * math.pi)

    kernel = np.array(answer["psf"]["data"])
    np.testing.assert_allclose(once_round["psf"]["data"], kernel, atol=1e-9)
    assert once_round["query"]["phi"] == pytest.approx(0.59)
    assert list(kernel.shape) == answer["psf"]["shape"] == [55, 55]
    assert kernel.min() >= 0
    assert kernel.sum() == pytest.approx(1, abs=1e-6)
    assert np.abs(centroid(kernel)).max() < 0.05
    assert answer["support"]["effective_samples"] > 0


def test_all_formats_hold_the_same_kernel(client: TestClient, lens: str) -> None:
    query = {"r": 0.5, "phi": 2.2, "aperture": 1.4, "size": 21}
    answers = [client.get(f"{lens}/psf.{form}", params=query) for form in ("json", "npy", "tiff", "png")]
    data, png = np.array(answers[0].json()["psf"]["data"]), answers[3]

    npy = np.load(io.BytesIO(answers[1].content), allow_pickle=False)
    assert npy.dtype == np.float32
    np.testing.assert_allclose(npy, data, atol=1e-7)
    with tifffile.TiffFile(io.BytesIO(answers[2].content)) as file:
        np.testing.assert_array_equal(file.asarray(), npy)
        assert '"version":1' in file.pages.first.tags["ImageDescription"].value
    picture = np.asarray(Image.open(io.BytesIO(png.content)), dtype=np.float64)
    peak = float(png.headers["x-psf-scale"].partition(";")[0].removeprefix("max="))
    np.testing.assert_allclose(picture / 65535 * peak, data, atol=peak / 65535)
    assert [r.headers["content-type"] for r in answers[2:]] == ["image/tiff", "image/png"]


def test_the_format_follows_what_the_caller_likes_best(client: TestClient, lens: str) -> None:
    for accept, form in {
        "application/json": "json",
        "image/tiff;q=0.5, image/png;q=0.2": "tiff",
        "text/html, image/*;q=0.8": "png",
        "application/x-npy": "npy",
        "application/json;q=0, image/png": "png",
    }.items():
        assert accepted(accept) == form

    for accept in ("video/mp4", "image/png;q=0"):
        none = client.get(f"{lens}/psf?r=0.5", headers={"Accept": accept})
        assert refusal(none) == (406, "not_acceptable")


def test_a_psf_is_sent_again_only_when_it_changed(client: TestClient, steps: Steps, lens: str) -> None:
    path = f"{lens}/psf?{PLACE}"
    for asked in (f"{lens}/field.png?aperture=1.4&grid=4x3&size=15", path):
        first = client.get(asked)
        tag = {"If-None-Match": first.headers["etag"]}
        again = client.get(asked, headers=tag)
        assert (again.status_code, again.content) == (304, b"")
    assert client.get(f"{path}&channel=r", headers=tag).status_code == 200

    steps.counted(patches=6, width=4.0)

    changed = client.get(path, headers=tag)  # the photo is in the very next answer
    assert (changed.status_code, changed.json()["version"]) == (200, 2)
    assert changed.headers["etag"] != first.headers["etag"]
    assert np.max(changed.json()["psf"]["data"]) < np.max(first.json()["psf"]["data"])
    assert changed.json()["support"]["photos"] == 2


def test_adding_photos_one_by_one_gives_the_model_of_all_at_once(
    client: TestClient, steps: Steps, store: Store, lens: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask(client, lens)
    steps.counted(patches=6, width=4.0)
    anew = ModelCache(store, max_bytes=1).get(lens.rpartition("/")[2])
    monkeypatch.setattr(model_cache, "_fit", None)  # the first is extended, and then remembered
    grown = [ask(client, lens)["psf"]["data"] for _ in range(2)]

    assert anew.state.version == 2
    answer = anew.model.query(FieldPosition(0.9, 0.59), LensSettings(1.4), size=55)
    np.testing.assert_allclose(grown, [answer.kernel] * 2, atol=1e-6)


def test_versions_stay_available_until_photos_are_removed(
    client: TestClient, steps: Steps, lens: str
) -> None:
    first = ask(client, lens)
    second = steps.counted(patches=6, width=4.0)

    pinned = ask(client, lens, version=1)
    assert (pinned["version"], ask(client, lens)["version"]) == (1, 2)
    np.testing.assert_allclose(pinned["psf"]["data"], first["psf"]["data"], atol=1e-9)

    client.patch(f"/v1/photos/{second.public_id}", json={"excluded": True})
    for version in (1, 99):
        assert refusal(client.get(f"{lens}/psf?r=0.5&version={version}")) == (409, "conflict")
    assert ask(client, lens)["support"]["photos"] == 1


BAD_QUESTIONS = {
    "r": ("-0.01", "1.01", "nan", "inf", ""),
    "phi": ("nan", "1e300"),
    "aperture": ("0.49", "128.5", "nan"),
    "channel": ("x",),
    "size": ("0", "1", "54", "257", "5.5"),
    "focus_distance_m": ("-2", "5e-324"),
    "pixel_pitch_um": ("5e-324",),
    "wavelength": ("540",),
}


def test_a_bad_question_is_answered_with_the_offending_value(client: TestClient, lens: str) -> None:
    asked = [(name, {"r": "0.5", name: value}) for name, values in BAD_QUESTIONS.items() for value in values]
    for name, query in (*asked, ("r", {})):
        answer = client.get(f"{lens}/psf", params=query)

        assert (query, refusal(answer)) == (query, (422, "invalid_parameter"))
        assert name in answer.json()["errors"][0]["field"]
        assert name in answer.json()["detail"]
    for smallest in ({"focus_distance_m": 0.02}, {"pixel_pitch_um": 0.5}):  # of real cameras
        assert PsfQuery.model_validate({"r": 0.5, **smallest})


def test_a_lens_without_samples_says_what_to_do(client: TestClient, steps: Steps) -> None:
    photo = steps.receive()
    steps.inspect(photo)

    for path in ("psf?r=0.5", "psf.png?r=0.5", "field.png", "lateral-colour"):
        answer = client.get(f"/v1/lenses/{steps.lens_id(photo)}/{path}")
        assert refusal(answer) == (409, "no_samples"), path
        assert "upload" in answer.json()["detail"]


def test_a_strict_question_outside_the_samples_is_refused(client: TestClient, lens: str) -> None:
    support = ask(client, lens, aperture=128)["support"]
    assert support["extrapolated"] is True
    strict = client.get(f"{lens}/psf?r=0.9&phi=0.59&aperture=128&strict=true")
    assert refusal(strict) == (422, "outside_support")


def test_the_field_map_has_kernels_and_hatches_what_is_unknown(client: TestClient, lens: str) -> None:
    def drawn(aperture: float) -> np.ndarray:
        answer = client.get(f"{lens}/field.png?aperture={aperture}&grid=4x3&size=15")
        return np.asarray(Image.open(io.BytesIO(answer.content)))

    picture, cell = drawn(1.4), drawn(22)[2:17, 2:17]
    assert picture.shape == (3 * 17 + 2, 4 * 17 + 2)
    assert [picture[2 + 17 * k : 17 + 17 * k].max() for k in range(3)] == [255] * 3
    assert set(cell.ravel()) == {40, 110}
    np.testing.assert_array_equal(cell, cell.T)  # strokes, not a kernel


def test_the_history_has_one_item_for_each_version(client: TestClient, steps: Steps, store: Store) -> None:
    photos = [steps.counted(), steps.counted()]
    path = f"/v1/lenses/{steps.lens_id(photos[0])}/calibrations"
    metrics = {"error": {"corner": 0.21}, "coverage": {"corner": 4}}
    store.lenses.record_metrics(steps.lens_id(photos[0]), 2, metrics)

    items = client.get(path).json()["items"]

    told = [[item[name] for name in ("version", "photo_id", "samples", "error")] for item in items]
    first, second = (photo.public_id for photo in photos)
    assert told == [[1, first, 6, None], [2, second, 12, metrics["error"]]]
    assert items[1]["coverage"] == metrics["coverage"]
    page = client.get(f"{path}?limit=1").json()
    assert client.get(page["next"]).json()["items"][0]["version"] == 2


def test_lateral_colour_is_the_middle_of_what_the_photos_show(client: TestClient, steps: Steps) -> None:
    photos = [steps.counted() for _ in range(4)]
    for photo, shift in zip(photos, (1e-4, 9e-4, 2e-4, 0.0), strict=True):
        points = 50 if shift else 0  # the last could not tell
        red, blue = [0.0, 0.0, shift, 1.0], [0.0, 0.0, -shift, 1.0]
        lateral = {"red": red, "blue": blue, "red_points": points, "blue_points": points}
        steps.store.photos.record_lateral(photo.public_id, photo.epoch, lateral)

    shown = client.get(f"/v1/lenses/{steps.lens_id(photos[0])}/lateral-colour").json()

    assert (shown["red"], shown["blue"]) == ([0.0, 0.0, 2e-4, 1.0], [0.0, 0.0, -2e-4, 1.0])
    assert shown["photos"] == 3


# --- what makes an answer, and pixels of several bodies ----------------------------------------------


def taken(steps: Steps, pitch_um: float = 6.0, width: int = 6000, sigma_px: float = 1.5) -> str:
    """Let a photo of a body count; return the path of its lens."""
    body = {"pixel_pitch_um": pitch_um, "width": width, "height": width * 2 // 3}
    return f"/v1/lenses/{steps.lens_id(steps.counted(patches=6, width=sigma_px**2, size=25, body=body))}"


def test_bodies_of_different_pitch_share_a_lens(client: TestClient, steps: Steps) -> None:
    lens = taken(steps)
    assert taken(steps) == lens
    # the same 9 um of blur on a sensor of that size
    assert taken(steps, pitch_um=4.0, width=9000, sigma_px=2.25) == lens

    pitches: list[dict[str, Any]] = [{"pixel_pitch_um": 6}, {"pixel_pitch_um": 4}, {}]
    coarse, fine, usual = (ask(client, lens, r=0.5, size=15, **at) for at in pitches)

    assert rms_width(np.array(coarse["psf"]["data"])) == pytest.approx(1.5, rel=0.05)
    assert rms_width(np.array(fine["psf"]["data"])) == pytest.approx(2.25, rel=0.05)
    assert [a["units"]["pixel_pitch_um"] for a in (coarse, fine, usual)] == [6.0, 4.0, 6.0]
    assert usual["psf"] == coarse["psf"]
    assert fine["support"]["photos"] == 3
    assert client.get(f"{lens}/psf", params={"r": 0.5, "pixel_pitch_um": -1}).status_code == 422


def test_samples_of_an_old_format_ask_for_calibration(client: TestClient, store: Store, steps: Steps) -> None:
    lens = taken(steps)
    with store.database.writing() as session:
        session.execute(update(SampleRow).values(format_version=1))

    answer = client.get(f"{lens}/psf", params={"r": 0.5})

    assert answer.status_code == 409
    assert "calibrate it again" in answer.json()["detail"]


# --- merged, taken along, reported ------------------------------------------------------------------


def put_profile(client: TestClient, lens: str, content: bytes, **query: bool) -> tuple[dict[str, Any], Any]:
    """Send a profile; return its job once that has ended, and the lens."""
    answer = client.put(f"/v1/lenses/{lens}/profile", content=content, params=query)
    assert answer.status_code == 202, answer.text
    job = {"state": "queued"}
    while job["state"] in {"queued", "running"}:
        job = client.get(answer.headers["location"], params={"wait": 2}).json()
    return job, client.get(f"/v1/lenses/{lens}").json()


@pytest.fixture
def learned(steps: Steps) -> str:
    """A lens that knows its blur at four places."""
    return steps.lens_id(steps.counted(patches=4))


@pytest.fixture
def profile(client: TestClient, learned: str) -> bytes:
    sent = client.get(f"/v1/lenses/{learned}/profile")
    assert sent.headers["content-disposition"].endswith(".lensprofile")
    return sent.content


def changed(profile: bytes, **changes: Any) -> bytes:
    """Return a profile in which something else is written."""
    known = read_profile(io.BytesIO(profile), "The answer")
    out = io.BytesIO()
    write_profile(out, replace(known, **changes))
    return out.getvalue()


@pytest.fixture
def other(steps: Steps) -> str:
    """A lens without photos."""
    return steps.named(LensName(None, None, None, label="Another"))


@pytest.mark.usefixtures("reading")
def test_a_profile_goes_out_and_in_once(client: TestClient, learned: str, other: str, profile: bytes) -> None:
    known = client.get(f"/v1/lenses/{learned}").json()

    job, taken = put_profile(client, other, profile)
    _, again = put_profile(client, other, profile)
    _, itself = put_profile(client, learned, profile)  # its own tells a lens nothing

    assert job["state"] == "succeeded", job
    assert (taken["photos"], taken["samples"], again) == (1, 12, taken)
    assert all(itself[name] == known[name] for name in ("photos", "samples", "version"))
    question = {"r": 0.5, "phi": 0.4, "aperture": 1.4}
    kernels = [client.get(f"/v1/lenses/{key}/psf.json", params=question).json() for key in (learned, other)]
    assert kernels[0]["psf"] == kernels[1]["psf"]
    photo = client.get("/v1/photos", params={"lens_id": other}).json()["items"][0]["id"]
    assert client.post("/v1/corrections", json={"photo_id": photo}).status_code == 409
    bad = client.put(f"/v1/lenses/{other}/profile", content=b"no profile")
    assert refusal(bad) == (400, "malformed_upload")
    assert client.put("/v1/lenses/gone/profile", content=profile).status_code == 404
    listed = client.get("/v1/photos").json()["items"]
    assert {entry["kind"] for entry in listed} == {None}  # photos, and no files of profiles


D750, BODY = Camera("NIKON CORPORATION", "NIKON D750", "1"), Camera("Leica", "M8")


@pytest.mark.usefixtures("reading")
@pytest.mark.parametrize(
    ("lens_is", "cameras", "name"),
    [
        ({"label": "Grandfather's", "maker": "Zeiss", "model": "Biotar"}, (D750,), "Grandfather's"),
        ({"serial": "77"}, (D750, replace(D750, serial="2")), "Nikon D750, 24 mm"),
        ({}, (D750, BODY), "file"),
        ({}, tuple(Camera("Leica", f"M{k}") for k in range(101)), "file"),
        ({"label": "two\nlines"}, (), "file"),
    ],
)
def test_a_lens_made_of_a_profile_alone_is_called_as_that_says_else_as_its_file(
    client: TestClient, profile: bytes, lens_is: dict[str, str], cameras: tuple[Camera, ...], name: str
) -> None:
    sent = changed(profile, names=lens_is, cameras=cameras)

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
def test_a_profile_of_another_model_is_refused(client: TestClient, learned: str, profile: bytes) -> None:
    samples = read_profile(io.BytesIO(profile), "The answer").model.samples
    paper = LensModel.fit(samples, PAPER)

    job, _ = put_profile(client, learned, changed(profile, model=paper))

    assert job["error"]["code"] == "conflict"


@pytest.mark.usefixtures("reading")
def test_a_profile_that_unpacks_to_more_than_a_lens_needs_is_not_unpacked(
    client: TestClient, learned: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    bomb = io.BytesIO()
    with zipfile.ZipFile(bomb, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("profile.json", bytes(1 << 20))
    monkeypatch.setattr("app.jobs.work.MAX_UNPACKED", (1 << 20) - 1)
    read: list[str] = []
    monkeypatch.setattr("app.jobs.tasks.read_profile", lambda *_: read.append("read"))

    job, _ = put_profile(client, learned, bomb.getvalue())

    assert (job["error"]["status"], read) == (413, [])


def test_a_report_comes_in_each_form_and_on_its_page(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted(patches=6))
    assert refusal(client.get(f"/v1/lenses/{lens}/report.json")) == (409, "not_ready")
    store_report(client, lens)

    for form, begins in (("json", b"{"), ("csv", b"quantity,"), ("pdf", b"%PDF-")):
        answer = client.get(f"/v1/lenses/{lens}/report.{form}")
        tag = {"If-None-Match": answer.headers["etag"]}
        assert answer.content.startswith(begins), answer.text
        assert client.get(f"/v1/lenses/{lens}/report.{form}", headers=tag).status_code == 304
    charts = f"/ui/lenses/{lens}/charts"
    assert [client.get(f"{charts}?aperture={wrong}").status_code for wrong in ("..", "x")] == [422, 422]
