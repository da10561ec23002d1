"""A lens that has seen little leans on other copies of its model: whose, how much, and until when."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from starlette.testclient import TestClient

from app.main import create_app
from app.runtime.settings import Settings
from app.store import LensName, Store
from lensmodel.core.psf import rms_width

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
NARROW, WIDE = 1.0, 4.0


@pytest.fixture
def young(steps: Steps) -> str:
    """Return the path of a lens that was seen at two places, with narrow kernels."""
    return f"/v1/lenses/{steps.lens_id(steps.counted(serial='young', width=NARROW))}"


def ask(client: TestClient, lens: str, **query: Any) -> dict[str, Any]:
    answer = client.get(f"{lens}/psf", params={"r": 0.9, "phi": 0.59, "aperture": 1.4, **query})
    assert answer.status_code == 200, answer.text
    return {**answer.json(), "etag": answer.headers["etag"]}


def width(answer: dict[str, Any]) -> float:
    return rms_width(np.array(answer["psf"]["data"]))


def test_alone_it_leans_on_nobody(client: TestClient, young: str) -> None:
    assert ask(client, young)["support"]["family"] is None


def test_another_copy_widens_what_was_not_seen_and_can_be_switched_off(
    client: TestClient, steps: Steps, young: str
) -> None:
    alone = ask(client, young)
    steps.counted(serial="old", patches=6, width=WIDE)

    leaning, without = ask(client, young), ask(client, young, family=False)

    assert leaning["support"]["family"]["lenses"] == 1
    assert 0.1 < leaning["support"]["family"]["weight"] <= 1.0
    assert width(leaning) > 1.2 * width(alone)
    assert without["support"]["family"] is None
    assert without["psf"] == alone["psf"]
    assert len({alone["etag"], leaning["etag"], without["etag"]}) == 3


def test_own_photos_take_the_weight_from_the_family(client: TestClient, steps: Steps, young: str) -> None:
    steps.counted(serial="old", patches=6, width=WIDE)
    before = ask(client, young)["support"]["family"]["weight"]

    for _ in range(3):
        steps.counted(serial="young", patches=6, width=NARROW)

    assert ask(client, young)["support"]["family"]["weight"] < 0.7 * before


def test_a_version_that_is_named_is_answered_by_its_own_photos(
    client: TestClient, steps: Steps, young: str
) -> None:
    alone = ask(client, young, version=1)
    steps.counted(serial="old", patches=6, width=WIDE)

    again = ask(client, young, version=1)

    assert again["psf"] == alone["psf"]
    assert again["etag"] == alone["etag"]
    assert again["support"]["family"] is None


def test_what_a_copy_learns_and_forgets_is_in_the_next_answer(
    client: TestClient, steps: Steps, young: str
) -> None:
    alone = ask(client, young)
    photo = steps.counted(serial="old", patches=6, width=WIDE)
    first = ask(client, young)
    steps.counted(serial="old", patches=6, width=WIDE)
    second = ask(client, young)
    assert second["etag"] != first["etag"]

    for public_id in (photo.public_id, client.get("/v1/photos").json()["items"][0]["id"]):
        assert client.patch(f"/v1/photos/{public_id}", json={"excluded": True}).status_code == 200

    assert ask(client, young)["psf"] == alone["psf"]
    client.patch(f"/v1/photos/{photo.public_id}", json={"excluded": False})
    assert ask(client, young)["support"]["family"]["lenses"] == 1
    assert client.delete(f"/v1/photos/{photo.public_id}").status_code == 204
    assert ask(client, young)["support"]["family"] is None


def test_lenses_of_another_owner_and_of_another_model_say_nothing(
    client: TestClient, steps: Steps, store: Store, young: str
) -> None:
    stranger = type(steps)(store, "somebody-else")
    photo = stranger.receive()
    stranger.inspect(photo, serial="theirs")
    stranger.plan(photo, 6)
    stranger.estimate(photo, tuple(range(6)), width=WIDE)
    store.photos.finish(photo.public_id, photo.epoch)
    other = stranger.named(LensName("Canon", "EF35mm f/2", None, label="x"))

    assert store.samples.family_of(other) == ()
    assert ask(client, young)["support"]["family"] is None


def test_the_name_of_the_model_may_be_written_in_another_way(store: Store, steps: Steps, young: str) -> None:
    steps.counted(serial="young")
    named = steps.named(LensName("CANON", "EF 24mm F1.4L", None, label="mine"))

    found = store.samples.family_of(named)

    assert [one.lens_id for one in found] == [young.rpartition("/")[2]]


def test_the_whole_service_can_do_without(settings: Settings, store: Store, steps: Steps, young: str) -> None:
    steps.counted(serial="old", patches=6, width=WIDE)
    with TestClient(create_app(settings.model_copy(update={"family": False}))) as client:
        assert ask(client, young)["support"]["family"] is None


def test_a_map_of_the_field_leans_too(client: TestClient, steps: Steps, young: str) -> None:
    steps.counted(serial="old", patches=6, width=WIDE)
    pictures = [client.get(f"{young}/field.png", params={"family": on}) for on in (True, False)]

    assert pictures[0].content != pictures[1].content
    assert pictures[0].headers["etag"] != pictures[1].headers["etag"]


def test_a_correction_is_another_one_once_the_family_has_learned(
    client: TestClient, steps: Steps, young: str
) -> None:
    photo = client.get(f"/v1/photos?lens_id={young.rpartition('/')[2]}").json()["items"][0]["id"]

    def wish(**more: Any) -> str:
        answer = client.post("/v1/corrections", json={"photo_id": photo, **more})
        assert answer.status_code == 202, answer.text
        return str(answer.json()["id"])

    alone = wish()
    steps.counted(serial="old", patches=6, width=WIDE)
    leaning = wish()

    assert leaning != alone
    assert wish() == leaning
    assert wish(family=False) == wish(lens_version=1) == alone
