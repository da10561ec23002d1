"""Lenses and their PSFs over HTTP: always current, in every format, cheap to ask again."""

from __future__ import annotations

import io
import math
from typing import Any

import numpy as np
import pytest
import tifffile
from PIL import Image
from starlette.testclient import TestClient
from states import Steps, refusal

from app.http import model_cache
from app.http.model_cache import ModelCache
from app.routes.psf import accepted
from app.schemas import PsfQuery
from app.store import Store
from lensmodel.core.psf import centroid
from lensmodel.core.types import FieldPosition, LensSettings

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

    told = {
        "maker": "Canon",
        "model": "EF24mm f/1.4L",
        "serial": "123",
        "serial_source": "exif",
        "version": 1,
    }
    known = {"photos": 1, "samples": 18, "apertures": [1.4], "focal_lengths_mm": [24.0]}
    assert shown.items() >= (told | known).items()
    assert client.get(shown["links"]["photos"]).json()["items"][0]["lens_id"] == shown["id"]
    assert shown["id"] in lens
    assert "123" not in str(shown["links"]).replace(shown["id"], "")


def test_lenses_are_found_by_model_and_serial(client: TestClient, steps: Steps) -> None:
    first, second = (steps.lens_id(steps.counted(serial=serial)) for serial in "12")

    for query, found in {
        "model=ef24MM f/1.4l": [second, first],
        "model=EF24mm f/1.4L&serial=2": [second],
        "serial=3": [],
        "model=&serial=": [second, first],  # blank asks for all
    }.items():
        assert [lens["id"] for lens in client.get(f"/v1/lenses?{query}").json()["items"]] == found, query


def test_a_psf_is_a_normalised_centred_kernel(client: TestClient, lens: str) -> None:
    answer, once_round = ask(client, lens), ask(client, lens, phi=0.59 + 2 * math.pi)

    kernel = np.array(answer["psf"]["data"])
    np.testing.assert_allclose(once_round["psf"]["data"], kernel, atol=1e-9)
    assert once_round["query"]["phi"] == pytest.approx(0.59)
    assert list(kernel.shape) == answer["psf"]["shape"] == [55, 55]
    assert kernel.min() >= 0
    assert kernel.sum() == pytest.approx(1, abs=1e-6)
    assert np.abs(centroid(kernel)).max() < 0.05
    asked = {"r": 0.9, "phi": 0.59, "aperture": 1.4, "channel": "g", "size": 55}
    assert asked.items() <= answer["query"].items()
    assert (answer["version"], answer["support"]["photos"]) == (1, 1)
    assert answer["support"]["effective_samples"] > 0
    assert set(answer["bandwidth"]) >= {"r", "phi"}
    assert answer["units"] == {"r": "half-diagonal", "phi": "radian", "pixel_pitch_um": 6.0}


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
    assert 'filename="psf-v1-r0.500-phi2.200-f1.4-g.png"' in png.headers["content-disposition"]


def test_the_format_follows_what_the_caller_likes_best(client: TestClient, lens: str) -> None:
    for accept, form in {
        "*/*": "json",
        "application/json": "json",
        "image/png": "png",
        "image/tiff;q=0.5, image/png;q=0.2": "tiff",
        "text/html, image/*;q=0.8": "png",
        "application/x-npy": "npy",
        "application/json;q=0, image/png": "png",
    }.items():
        assert accepted(accept) == form

    for accept in ("video/mp4", "image/png;q=0"):
        none = client.get(f"{lens}/psf?r=0.5", headers={"Accept": accept})
        assert refusal(none) == (406, "not_acceptable")


def test_an_unchanged_psf_is_not_sent_again_and_a_changed_one_is(
    client: TestClient, steps: Steps, lens: str
) -> None:
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


def test_an_earlier_version_stays_available_until_photos_are_removed(
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
    "focal_length_mm": ("0",),
    "focus_distance_m": ("-2", "5e-324"),
    "pixel_pitch_um": ("5e-324",),
    "version": ("0",),
    "strict": ("maybe",),
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
    assert ask(client, lens, aperture=128)["support"]["extrapolated"]
    strict = client.get(f"{lens}/psf?r=0.9&phi=0.59&aperture=128&strict=true")
    assert refusal(strict) == (422, "outside_support")


def test_the_field_map_has_a_kernel_for_each_cell_and_hatches_what_is_not_known(
    client: TestClient, lens: str
) -> None:
    def drawn(aperture: float) -> np.ndarray:
        answer = client.get(f"{lens}/field.png?aperture={aperture}&grid=4x3&size=15")
        return np.asarray(Image.open(io.BytesIO(answer.content)))

    picture, cell = drawn(1.4), drawn(22)[2:17, 2:17]
    assert picture.shape == (3 * 17 + 2, 4 * 17 + 2)
    assert [picture[2 + 17 * k : 17 + 17 * k].max() for k in range(3)] == [255] * 3
    assert set(cell.ravel()) == {40, 110}
    np.testing.assert_array_equal(cell, cell.T)  # strokes, not a kernel
    assert (cell[0, :2] == 110).all()


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


def test_lateral_colour_is_the_middle_of_what_the_photos_show(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photos = [steps.counted() for _ in range(4)]
    for photo, shift in zip(photos, (1e-4, 9e-4, 2e-4, 0.0), strict=True):
        points = 50 if shift else 0  # the last could not tell
        red, blue = [0.0, 0.0, shift, 1.0], [0.0, 0.0, -shift, 1.0]
        lateral = {"red": red, "blue": blue, "red_points": points, "blue_points": points}
        store.photos.record_lateral(photo.public_id, photo.epoch, lateral)

    shown = client.get(f"/v1/lenses/{steps.lens_id(photos[0])}/lateral-colour").json()

    assert (shown["red"], shown["blue"]) == ([0.0, 0.0, 2e-4, 1.0], [0.0, 0.0, -2e-4, 1.0])
    assert shown["photos"] == 3
