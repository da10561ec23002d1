"""What the service makes of samples: its models, and pixels of several bodies."""

from __future__ import annotations

import shutil
from typing import Any

import numpy as np
import pytest
from conftest import Steps
from sqlalchemy import event, update
from starlette.testclient import TestClient

from app.store import Store
from app.store.owners import ANY_OWNER
from app.store.tables import SampleRow
from lensmodel.core.psf import rms_width

ASKED = {"r": 0.5, "phi": 0.4, "aperture": 1.4, "size": 15}


def taken(steps: Steps, pitch_um: float = 6.0, width: int = 6000, sigma_px: float = 1.5) -> str:
    """Let a photo of a body count; return the id of its lens."""
    body = {"pixel_pitch_um": pitch_um, "width": width, "height": width * 2 // 3}
    return steps.lens_id(steps.counted(patches=6, width=sigma_px**2, size=25, body=body))


def psf(client: TestClient, lens_id: str, **more: float) -> dict[str, Any]:
    answer = client.get(f"/v1/lenses/{lens_id}/psf", params={**ASKED, **more})
    assert answer.status_code == 200, answer.text
    return answer.json()


def test_an_answer_says_what_made_it_and_what_is_beyond_all_photos(client: TestClient, steps: Steps) -> None:
    lens = taken(steps)
    near, far = psf(client, lens)["support"], psf(client, lens, aperture=16)["support"]

    assert (near["answered_by"], near["weights"], near["beyond"]) == ("regression", "", [])
    assert 0.0 < near["nearest"] < 2.5
    assert far["beyond"] == ["aperture_stops"]


def test_bodies_of_different_pitch_share_a_lens(client: TestClient, steps: Steps) -> None:
    lens = taken(steps)
    assert taken(steps) == lens
    # the same 9 um of blur on a sensor of that size
    assert taken(steps, pitch_um=4.0, width=9000, sigma_px=2.25) == lens

    coarse, fine, usual = (
        psf(client, lens, **at) for at in ({"pixel_pitch_um": 6}, {"pixel_pitch_um": 4}, {})
    )

    assert rms_width(np.array(coarse["psf"]["data"])) == pytest.approx(1.5, rel=0.05)
    assert rms_width(np.array(fine["psf"]["data"])) == pytest.approx(2.25, rel=0.05)
    assert [a["units"]["pixel_pitch_um"] for a in (coarse, fine, usual)] == [6.0, 4.0, 6.0]
    assert usual["psf"] == coarse["psf"]
    assert fine["support"]["photos"] == 3
    assert client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, "pixel_pitch_um": -1}).status_code == 422


def test_warm_answers_cost_one_read_of_the_tables(client: TestClient, steps: Steps) -> None:
    lens = taken(steps)
    services = client.app.state.services
    psf(client, lens)
    services.models.get(lens)
    statements: list[str] = []

    def note(*arguments: Any) -> None:
        statements.append(str(arguments[2]))

    event.listen(services.store.database.reader, "before_cursor_execute", note)
    shutil.rmtree(services.storage.folder)  # it takes no blob, wherever these are
    psf(client, lens, r=0.7)

    assert len([text for text in statements if "SELECT" in text]) == 1


def test_that_read_is_for_the_owner_alone(store: Store, steps: Steps) -> None:
    lens = taken(steps)

    assert store.lenses.state_of(lens, "local") == store.lenses.state_of(lens, ANY_OWNER)
    assert store.lenses.state_of(lens, "somebody else") is None
    assert store.lenses.state_of("none", "local") is None


def test_samples_of_an_earlier_version_ask_for_a_calibration(
    client: TestClient, store: Store, steps: Steps
) -> None:
    lens = taken(steps)
    with store.database.writing() as session:
        session.execute(update(SampleRow).values(format_version=1))

    answer = client.get(f"/v1/lenses/{lens}/psf", params=ASKED)

    assert answer.status_code == 409
    assert "calibrate it again" in answer.json()["detail"]
