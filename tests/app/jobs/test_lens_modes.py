"""What the service makes of samples: its models, and pixels of several bodies."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from sqlalchemy import event, update
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.http.model_cache import ModelCache
from app.jobs import tasks
from app.jobs.sample_files import write_samples
from app.jobs.task_files import LEARNED
from app.main import create_app
from app.runtime.settings import Settings
from app.store import LensName, NewPatch, NewSample, Store
from app.store.tables import SampleRow
from app.store.versions import learned_key
from app.ways import of_models
from lensmodel.core.psf import PsfSample, gaussian, rms_width
from lensmodel.core.types import FieldPosition, LensSettings, ignore_step
from lensmodel.model import ModelSettings

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other
SIDE, SUPPORT = 64, 11
ASKED = {"r": 0.5, "phi": 0.4, "aperture": 1.4, "size": 15}
PLACE, SETTINGS = FieldPosition(0.5, 0.4), LensSettings(1.4)


@pytest.fixture
def storage(settings: Settings) -> Storage:
    return Storage(settings.storage)


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


def test_what_a_worker_learned_is_served_for_that_model_alone(
    settings: Settings, client: TestClient, store: Store, storage: Storage, lens: str, tmp_path: Path
) -> None:
    state, stored = store.samples.of_lens(lens)
    folder = tmp_path / "task"
    folder.mkdir()
    write_samples(folder, [entry.sample for entry in stored])

    tasks.measure({"model": of_models(settings, "default")}, folder, ignore_step)
    storage.put(learned_key(lens, state.version, state.rebuild_epoch), (folder / LEARNED).read_bytes())

    assert "-l-" in client.get(f"/v1/lenses/{lens}/psf", params=ASKED).headers["etag"]
    assert ModelCache(store, 1 << 30, storage).get(lens).learned
    of_paper = ModelSettings(**of_models(settings, "paper"))
    assert not ModelCache(store, 1 << 30, storage, settings=of_paper).get(lens).learned


def test_an_answer_says_what_made_it_and_why(client: TestClient, lens: str) -> None:
    support = psf(client, lens)["support"]

    assert (support["model"], support["answered_by"]) == ("default", "regression")
    assert support["reason"] == "no patch has a spectrum"


def test_the_setting_of_modes_is_refused_with_the_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LENS_MODEL_MODE", "kernels")

    with pytest.raises(ValueError, match=r"is gone: leave it out; .* --model paper"):
        Settings()


def test_what_an_earlier_version_kept_of_patches_goes_with_its_photo(
    store: Store, storage: Storage, steps: Steps
) -> None:
    photo = steps.counted(patches=6)
    key = f"photos/{photo.public_id}/statistics/e1/0-g.npz"
    storage.put(key, b"of an earlier version")
    with store.database.writing() as session:
        session.execute(update(SampleRow).where(SampleRow.photo_id == photo.id).values(statistics_key=key))
    assert len(store.samples.of_lens(str(steps.lens_id(photo)))[1]) == 18

    assert store.photos.delete(photo.public_id, "local")

    due = datetime.now(UTC) + timedelta(days=30)
    assert any(key.startswith(prefix) for prefix in store.workers.garbage(at=due))


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
        store.photos.assign_lens(photo.public_id)
        store.photos.set_state(photo.public_id, ("inspecting",), "selecting")
        places = [(0.1 + 0.15 * k, 1.1 * k - 3.0) for k in range(6)]
        patches = [NewPatch(k, 0, 0, 64, r, phi, cell=k, score=1.0) for k, (r, phi) in enumerate(places)]
        store.patches.add(photo.public_id, photo.epoch, patches)
        store.photos.set_state(photo.public_id, ("selecting",), "estimating")
        kernel = gaussian(25, sigma_px**2 * np.eye(2))
        samples = [
            NewSample(k, PsfSample(kernel, FieldPosition(*place), weight=0.5, estimator="default/1"))
            for k, place in enumerate(places)
        ]
        store.patches.finish(photo.public_id, photo.epoch, samples)
        assert store.photos.finish(photo.public_id, photo.epoch) is not None
        return str(steps.lens_id(photo))

    return take


def test_bodies_of_different_pitch_share_a_lens(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    assert taken(6.0, (6000, 4000), 1.5) == lens
    assert taken(4.0, (6000, 4000), 2.25) == lens  # the same 9 um of blur

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


def test_sizes_of_one_sensor_share_a_lens_in_half_diagonals(
    settings: Settings, taken: Callable[..., str]
) -> None:
    lens = taken(None, (6000, 4000), 2.0)
    assert taken(None, (6000, 4000), 2.0) == lens
    assert taken(None, (3600, 2400), 1.2) == lens
    chosen = settings.model_copy(update={"model_unit": "half-diagonal"})
    with TestClient(create_app(chosen), raise_server_exceptions=False) as client:
        large = psf(client, lens, half_diagonal_px=float(np.hypot(6000, 4000)) / 2)
        small = psf(client, lens, half_diagonal_px=float(np.hypot(3600, 2400)) / 2)

    assert width(large) == pytest.approx(2.0, rel=0.05)
    assert width(small) == pytest.approx(1.2, rel=0.05)


def test_warm_answers_cost_one_read_of_the_tables(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    services = client.app.state.services  # type: ignore[attr-defined] # Starlette's own attribute
    psf(client, lens)
    services.models.get(lens)
    statements: list[str] = []

    def note(*arguments: Any) -> None:
        statements.append(str(arguments[2]))

    event.listen(services.store.database.reader, "before_cursor_execute", note)
    psf(client, lens, r=0.7)

    assert len([text for text in statements if "SELECT" in text]) == 1


def test_that_read_tells_what_two_others_do(store: Store, steps: Steps, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    alone = store.samples.known_of(lens, "local")
    steps.counted(serial="other copy", patches=6)

    both = store.samples.known_of(lens, "local")

    assert alone == (store.samples.state_of(lens), ())
    assert both == (store.samples.state_of(lens), store.samples.family_of(lens))
    assert both is not None
    assert len(both[1]) == 1
    assert store.samples.known_of(lens, "somebody else") is None
    assert store.samples.known_of("none", "local") is None


def test_every_pixel_of_an_answer_has_a_standard_error(client: TestClient, taken: Callable[..., str]) -> None:
    lens = taken(6.0, (6000, 4000), 1.5)
    taken(6.0, (6000, 4000), 1.9)

    plain, more = psf(client, lens, r=0.98), psf(client, lens, r=0.98, std=True, pixel_pitch_um=4)

    assert plain["std"] is None
    error, kernel = np.array(more["std"]), np.array(more["psf"]["data"])
    assert error.shape == kernel.shape == (15, 15)
    assert 0.005 * kernel.max() < error.max() < 0.5 * kernel.max()
    assert (error >= 0).all()
    assert client.get(f"/v1/lenses/{lens}/psf", params={**ASKED, "aperture": 16}).json()["support"][
        "beyond"
    ] == ["aperture_stops"]
