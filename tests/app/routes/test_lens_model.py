"""The model of a lens over HTTP: asked for with a photo, changed, named by every answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from app.client import Client
from app.http.model_cache import ModelCache
from app.runtime.settings import Settings
from app.store import Store
from app.store.access.owners import ANY_OWNER
from app.ways import configured_way
from lensmodel.workflow.sampling import PRESETS

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
TIFF = b"II*\x00" + bytes(3_000)
ASKED = {"r": 0.5, "phi": 0.4, "aperture": 1.4, "size": 15}


def send(client: TestClient, data: bytes = TIFF, **query: str) -> Any:
    headers = {"Content-Type": "application/octet-stream"}
    return client.post("/v1/photos", content=data, params={"filename": "a.tif", **query}, headers=headers)


def learn(steps: Steps, photo: Any, **options: Any) -> None:
    """Do what a worker does with a photo that was received."""
    fresh = steps.fresh(photo)
    steps.inspect(fresh, **options)
    steps.plan(fresh, 6)
    steps.estimate(fresh, tuple(range(6)), width=2.0)
    steps.store.photos.finish(fresh.public_id, fresh.epoch)


def support(client: TestClient, lens: str, **more: Any) -> dict[str, Any]:
    answer = client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, **more})
    assert answer.status_code == 200, answer.text
    return dict(answer.json()["support"])


def lens_of(client: TestClient, lens: str) -> tuple[str, str]:
    shown = client.get(f"/v1/lenses/{lens}").json()
    return shown["psf_model"], shown["answering_model"]


def change(client: TestClient, lens: str, model: Any) -> Any:
    return client.patch(f"/v1/lenses/{lens}", json={"model": model})


def test_every_answer_names_the_model_that_gave_it(client: TestClient, steps: Steps) -> None:
    photo = steps.counted(patches=6)
    lens = steps.lens_id(photo)
    before = support(client, lens)
    tag = client.get(f"/v1/lenses/{lens}/psf", params=ASKED).headers["etag"]

    changed = change(client, lens, "paper")

    assert changed.status_code == 200, changed.text
    assert (changed.json()["model"], changed.json()["psf_model"]) == ("EF24mm f/1.4L", "paper")
    assert (changed.json()["answering_model"], changed.json()["apertures"]) == ("default", [1.4])
    assert support(client, lens) == before
    assert client.get(f"/v1/photos/{photo.public_id}").json()["state"] == "received"
    learn(steps, photo)
    after = support(client, lens)
    assert ((before["model"], before["answered_by"]), (after["model"], after["answered_by"])) == (
        ("default", "regression"),
        ("paper", "paper"),
    )
    assert lens_of(client, lens) == ("paper", "paper")
    assert client.get(f"/v1/lenses/{lens}/psf", params=ASKED).headers["etag"] != tag
    history = client.get(f"/v1/lenses/{lens}/calibrations").json()["items"]
    assert [(one["kind"], one["model"]) for one in history] == [
        ("photo_added", "default"),
        ("model_changed", "paper"),
    ]
    gone = client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, "version": 1})
    assert (gone.status_code, gone.json()["code"]) == (409, "conflict")


def test_a_model_in_memory_does_not_survive_a_change(store: Store, steps: Steps) -> None:
    photo = steps.counted(patches=6)
    lens = steps.lens_id(photo)
    cache = ModelCache(store, 1 << 30)
    assert cache.get(lens).way == "default"

    store.lens_changes.choose_way(lens, "local", "paper")
    assert cache.get(lens).way == "default"
    learn(steps, photo)

    fitted = cache.get(lens)
    assert (fitted.way, fitted.model.settings.mode) == ("paper", "paper")
    assert {sample.kernel.shape for sample in fitted.model.samples} == {(15, 15)}
    assert len(fitted.model.samples) == 18  # and none of before


def test_the_settings_of_the_service_decide_for_the_default_model_only(settings: Settings) -> None:
    chosen = settings.model_copy(update={"estimator": "michaeli-irani", "kernel_size": 21})

    default = configured_way(chosen, "default")
    assert (default.estimator, default.kernel_size) == ("michaeli-irani", 21)
    assert configured_way(chosen, "paper") == replace(PRESETS["paper"], patches=chosen.patches)


def test_photos_of_the_paper_are_corrected_its_way_unless_asked_otherwise(
    client: TestClient, steps: Steps
) -> None:
    photo = steps.receive(model="paper")
    learn(steps, photo)

    made = client.post("/v1/corrections", json={"photo_id": photo.public_id})
    named = client.post("/v1/corrections", json={"photo_id": photo.public_id, "method": "paper"})
    other = client.post("/v1/corrections", json={"photo_id": photo.public_id, "method": "fast"})

    assert made.json()["method"] == "paper"
    assert named.json()["id"] == made.json()["id"]  # the same wish
    assert other.json()["method"] == "fast"


@pytest.mark.parametrize("bad", ["evidence", "", None, 3])
def test_a_lens_has_no_other_model(client: TestClient, steps: Steps, bad: Any) -> None:
    lens = steps.lens_id(steps.counted())

    answer = change(client, lens, bad)

    assert (answer.status_code, answer.json()["code"]) == (422, "invalid_parameter")
    assert lens_of(client, lens) == ("default", "default")
    both = client.patch(f"/v1/lenses/{lens}", json={"model": "paper", "label": "Mine"})
    assert both.status_code == 422
    assert change(client, "nowhere", "paper").status_code == 404


def test_a_photo_asks_for_a_model(client: TestClient, steps: Steps, store: Store) -> None:
    sent = send(client, model="paper", lens_serial="77", lens_model="New")
    assert sent.status_code == 202, sent.text
    photo = store.photos.get(sent.json()["id"], ANY_OWNER)
    learn(steps, photo)
    lens = steps.lens_id(photo)
    assert lens_of(client, lens) == ("paper", "paper")

    for given in ({"lens_id": lens, "model": "default"}, {"model": "default"}):
        refused = send(client, TIFF + (b"other" if "lens_id" in given else b""), **given)
        assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
        assert f"PATCH /v1/lenses/{lens}" in refused.json()["detail"]
    assert len(client.get("/v1/photos").json()["items"]) == 1
    assert send(client, model="paper").status_code == send(client, model="").status_code == 200
    assert send(client, TIFF + b"other", lens_id=lens, model="paper").status_code == 202
    assert send(client, TIFF + b"third", model="evidence").status_code == 422


def test_a_form_asks_for_a_model_too(client: TestClient, store: Store) -> None:
    sent = client.post("/v1/photos", files={"file": ("a.tif", TIFF)}, data={"model": "paper"})

    photo = store.photos.get(sent.json()["id"], ANY_OWNER)
    assert photo is not None
    assert photo.given == {"model": "paper"}


def test_photos_without_files_keep_a_lens_from_changing(
    client: TestClient, steps: Steps, store: Store
) -> None:
    photo = steps.counted()
    lens = steps.lens_id(photo)
    store.photos.give_up_file(photo.public_id, ())

    refused = change(client, lens, "paper")

    assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
    assert "1 of the photos" in refused.json()["detail"]
    client.patch(f"/v1/photos/{photo.public_id}", json={"excluded": True})
    assert change(client, lens, "paper").status_code == 200
    back = client.patch(f"/v1/photos/{photo.public_id}", json={"excluded": False})
    assert back.status_code == 409
    assert "send the same file again" in back.json()["detail"]


def test_a_lens_that_changes_neither_merges_nor_goes_back(client: TestClient, steps: Steps) -> None:
    photos = [steps.counted(serial="1") for _ in range(2)]
    first, second = steps.lens_id(photos[0]), steps.lens_id(steps.counted(serial="2"))
    change(client, first, "paper")

    for wish in ({"merge_into": second}, {"back_to": 1}):
        refused = client.patch(f"/v1/lenses/{first}", json=wish)
        assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
        assert "wait" in refused.json()["detail"]
    assert change(client, first, "default").json()["answering_model"] == "default"
    assert client.patch(f"/v1/lenses/{first}", json={"back_to": 1}).json()["photos"] == 1


def test_a_profile_joins_only_a_lens_of_its_model(client: TestClient, steps: Steps) -> None:
    photo, other = steps.receive(model="paper"), steps.counted(serial="2", patches=6)
    learn(steps, photo)
    papers, plain = steps.lens_id(photo), steps.lens_id(other)
    profile = client.get(f"/v1/lenses/{papers}/profile").content

    refused = client.put(f"/v1/lenses/{plain}/profile", content=profile)

    assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
    change(client, plain, "paper")
    assert client.put(f"/v1/lenses/{plain}/profile", content=profile).status_code == 409  # not yet
    learn(steps, other, serial="2")
    taken = client.put(f"/v1/lenses/{plain}/profile", content=profile)
    assert (taken.status_code, taken.json()["photos"]) == (200, 2)
    assert support(client, plain)["model"] == "paper"


def test_the_client_asks_for_a_model(client: TestClient, steps: Steps, store: Store, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(TIFF)
    api = Client(http=client)
    sent = api.upload(path, model="paper")
    learn(steps, store.photos.get(sent.id, ANY_OWNER))
    (lens,) = api.lenses()
    assert (lens.psf_model, lens.answering_model, lens.model) == ("paper", "paper", "EF24mm f/1.4L")

    changed = api.choose_model(lens.id, "default")

    assert (changed.psf_model, changed.answering_model) == ("default", "paper")
    assert api.psf(lens.id, r=0.5, aperture=1.4, size=15).support.model == "paper"
    assert api.choose_model(lens.id, "paper") == lens
    assert api.calibrations(lens.id)[0].model == "paper"
    assert api.correct(sent.id).method == "paper"
