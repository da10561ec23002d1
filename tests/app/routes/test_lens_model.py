"""The model of a lens over HTTP: asked for with its first photo, named by every answer."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from starlette.testclient import TestClient

from app.client import Client
from app.presets import configured_preset
from app.runtime.settings import Settings
from app.store import Store
from app.store.owners import ANY_OWNER
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


def model_of(client: TestClient, lens: str) -> Any:
    return client.get(f"/v1/lenses/{lens}").json()["psf_model"]


def test_every_answer_names_the_model_that_gave_it(client: TestClient, steps: Steps) -> None:
    photo = steps.receive(model="paper")
    learn(steps, photo, serial="2")

    plain = support(client, steps.lens_id(steps.counted(patches=6)))
    paper = support(client, steps.lens_id(photo))

    assert ((plain["model"], plain["answered_by"]), (paper["model"], paper["answered_by"])) == (
        ("default", "regression"),
        ("paper", "paper"),
    )


def test_the_model_of_a_lens_is_never_changed(client: TestClient, steps: Steps) -> None:
    lens = steps.lens_id(steps.counted())

    refused = client.patch(f"/v1/lenses/{lens}", json={"model": "paper"})

    assert (refused.status_code, refused.json()["code"]) == (422, "invalid_parameter")
    assert model_of(client, lens) == "default"


def test_the_settings_of_the_service_decide_for_the_default_model_only(settings: Settings) -> None:
    chosen = settings.model_copy(update={"estimator": "michaeli-irani"})

    default = configured_preset(chosen, "default")
    assert default.estimator == "michaeli-irani"
    assert configured_preset(chosen, "paper") == replace(PRESETS["paper"], patches=chosen.patches)


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


def test_a_photo_asks_for_a_model(client: TestClient, steps: Steps, store: Store) -> None:
    sent = send(client, model="paper", lens_serial="77", lens_model="New")
    assert sent.status_code == 202, sent.text
    photo = store.photos.get(sent.json()["id"], ANY_OWNER)
    learn(steps, photo)
    lens = steps.lens_id(photo)
    assert model_of(client, lens) == "paper"

    for given in ({"lens_id": lens, "model": "default"}, {"model": "default"}):
        refused = send(client, TIFF + (b"other" if "lens_id" in given else b""), **given)
        assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
        assert f"lens {lens} has the model paper" in refused.json()["detail"]
    assert len(client.get("/v1/photos").json()["items"]) == 1
    assert send(client, model="paper").status_code == send(client, model="").status_code == 200
    assert send(client, TIFF + b"other", lens_id=lens, model="paper").status_code == 202
    assert send(client, TIFF + b"third", model="evidence").status_code == 422


def test_a_form_asks_for_a_model_too(client: TestClient, store: Store) -> None:
    sent = client.post("/v1/photos", files={"file": ("a.tif", TIFF)}, data={"model": "paper"})

    photo = store.photos.get(sent.json()["id"], ANY_OWNER)
    assert photo is not None
    assert photo.given == {"model": "paper"}


@pytest.mark.usefixtures("reading")
def test_a_profile_joins_only_a_lens_of_its_model(client: TestClient, steps: Steps) -> None:
    photo, second = steps.receive(model="paper"), steps.receive(model="paper")
    learn(steps, photo)
    learn(steps, second, serial="3")
    papers, other = steps.lens_id(photo), steps.lens_id(second)
    plain = steps.lens_id(steps.counted(serial="2", patches=6))
    profile = client.get(f"/v1/lenses/{papers}/profile").content

    refused = client.put(f"/v1/lenses/{plain}/profile", content=profile)
    taken = client.put(f"/v1/lenses/{other}/profile", content=profile, params={"any_lens": True})

    assert (refused.status_code, refused.json()["code"]) == (409, "conflict")
    assert (taken.status_code, taken.json()["photos"]) == (200, 2)
    assert support(client, other)["model"] == "paper"


def test_the_client_asks_for_a_model(client: TestClient, steps: Steps, store: Store, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(TIFF)
    api = Client(http=client)
    sent = api.upload(path, model="paper")
    learn(steps, store.photos.get(sent.id, ANY_OWNER))
    (lens,) = api.lenses()
    assert (lens.psf_model, lens.model) == ("paper", "EF24mm f/1.4L")
    assert api.psf(lens.id, r=0.5, aperture=1.4, size=15).support.model == "paper"
    assert api.correct(sent.id).method == "paper"
