"""What the service makes of samples: its models, and pixels of several bodies."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, update
from starlette.testclient import TestClient

from app.store import LensName, Store
from app.store.owners import ANY_OWNER
from app.store.tables import SampleRow
from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample, rms_width
from lensmodel.core.types import FieldPosition

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
SIDE, SUPPORT = 64, 11
ASKED = {"r": 0.5, "phi": 0.4, "aperture": 1.4, "size": 15}


@pytest.fixture
def lens(steps: Steps) -> str:
    """Return the id of a lens with a photo of six green patches."""
    return str(steps.lens_id(steps.counted(patches=6)))


def psf(client: TestClient, lens_id: str, **more: float) -> dict[str, Any]:
    answer = client.get(f"/v1/lenses/{lens_id}/psf", params={**ASKED, **more})
    assert answer.status_code == 200, answer.text
    return dict(answer.json())


def width(answer: dict[str, Any]) -> float:
    return rms_width(np.array(answer["psf"]["data"]))


def test_an_answer_says_what_made_it(client: TestClient, lens: str) -> None:
    support = psf(client, lens)["support"]

    assert (support["answered_by"], support["weights"]) == ("regression", "")
    assert 0.0 < support["nearest"] < 2.5


@pytest.fixture
def taken(steps: Steps, store: Store) -> Callable[..., str]:
    """Let a photo of a body count; return the id of its lens."""

    def take(pitch_um: float | None, size: Sequence[int], sigma_px: float) -> str:
        photo = steps.receive()
        store.photos.set_state(photo.public_id, ("received",), "inspecting")
        store.photos.record_inspection(
            photo.public_id,
            width=size[0],
            height=size[1],
            identity=LensName("Canon", "EF24mm f/1.4L", "123", "exif"),
            aperture=1.4,
            focal_mm=24.0,
            focus_m=None,
            pixel_pitch_um=pitch_um,
        )
        store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
        places = [(0.1 + 0.15 * k, 1.1 * k - 3.0) for k in range(6)]
        corner = {"row": 0, "col": 0, "size": 64, "score": 1.0}
        patches = [{**corner, "r": r, "phi": phi, "cell": k} for k, (r, phi) in enumerate(places)]
        store.photos.plan_patches(photo.public_id, photo.epoch, patches, [])
        store.photos.set_state(photo.public_id, ("selecting",), "estimating")
        kernel = gaussian(25, sigma_px**2 * np.eye(2))
        samples = [
            (k, PsfSample(kernel, FieldPosition(*place), weight=0.5, estimator="default/1"))
            for k, place in enumerate(places)
        ]
        store.photos.add_samples(photo.public_id, photo.epoch, samples)
        assert store.photos.finish(photo.public_id, photo.epoch) is not None
        return str(steps.lens_id(photo))

    return take


def test_bodies_of_different_pitch_share_a_lens(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    assert taken(6.0, (6000, 4000), 1.5) == lens
    assert taken(4.0, (9000, 6000), 2.25) == lens  # the same 9 um of blur on a sensor of that size

    coarse, fine, usual = (
        psf(client, lens, pixel_pitch_um=6),
        psf(client, lens, pixel_pitch_um=4),
        psf(client, lens),
    )

    assert width(coarse) == pytest.approx(1.5, rel=0.05)
    assert width(fine) == pytest.approx(2.25, rel=0.05)
    assert [a["units"]["pixel_pitch_um"] for a in (coarse, fine, usual)] == [6.0, 4.0, 6.0]
    assert usual["psf"] == coarse["psf"]
    assert fine["support"]["photos"] == 3
    assert client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, "pixel_pitch_um": -1}).status_code == 422


def test_warm_answers_cost_one_read_of_the_tables(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute
    psf(client, lens)
    services.models.get(lens)
    statements: list[str] = []

    def note(*arguments: Any) -> None:
        statements.append(str(arguments[2]))

    event.listen(services.store.database.reader, "before_cursor_execute", note)
    shutil.rmtree(services.storage.folder)  # it takes no blob, wherever these are
    psf(client, lens, r=0.7)

    assert len([text for text in statements if "SELECT" in text]) == 1


def test_that_read_is_for_the_owner_alone(store: Store, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)

    assert store.lenses.state_of(lens, "local") == store.lenses.state_of(lens, ANY_OWNER)
    assert store.lenses.state_of(lens, "somebody else") is None
    assert store.lenses.state_of("none", "local") is None


def test_an_aperture_far_from_all_photos_is_said_to_be_beyond(
    client: TestClient, taken: Callable[..., str]
) -> None:
    support = psf(client, taken(6.0, (6000, 4000), 1.5), aperture=16)["support"]

    assert support["beyond"] == ["aperture_stops"]


def test_samples_of_an_earlier_version_ask_for_a_calibration(
    client: TestClient, store: Store, lens: str
) -> None:
    with store.database.writing() as session:
        session.execute(update(SampleRow).values(format_version=1))

    answer = client.get(f"/v1/lenses/{lens}/psf", params=ASKED)

    assert answer.status_code == 409
    assert "calibrate it again" in answer.json()["detail"]
