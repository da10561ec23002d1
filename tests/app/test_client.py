"""The client speaks with the real application, and its own words with its caller."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.client import Client, JobEndedError, JobPatienceError, ServiceProblemError
from app.demo.own_service import own_service
from app.main import create_app
from app.runtime.settings import Settings
from app.schemas import JobOut
from app.store import Store
from app.store.corrections import Result
from lensmodel.core.errors import LensModelError

Steps = Any  # the fixture `steps` of conftest.py; test modules do not import each other


@pytest.fixture
def api(client: TestClient) -> Client:
    return Client(http=client)


@pytest.fixture
def photo_file(tmp_path: Path) -> Path:
    path = tmp_path / "Größe p1.tif"
    path.write_bytes(b"II*\x00" + bytes(3_000))
    return path


def test_an_upload_comes_back_as_a_photo(api: Client, photo_file: Path) -> None:
    photo = api.upload(photo_file, aperture=2.8, calibrate=False)

    assert (photo.filename, photo.aperture, photo.calibrate) == ("Größe p1.tif", 2.8, False)
    assert api.photo(photo.id) == photo
    assert api.upload(photo_file).id == photo.id
    assert api.photos() == [api.photo(photo.id)]
    api.delete_photo(photo.id)
    assert api.photos() == []


def test_a_refusal_carries_the_problem(api: Client, tmp_path: Path) -> None:
    path = tmp_path / "x.txt"
    path.write_text("hello")

    with pytest.raises(ServiceProblemError, match="not_an_image") as caught:
        api.upload(path)
    assert caught.value.problem.status == 415


def test_waiting_ends_when_the_job_does(api: Client, steps: Steps, store: Store) -> None:
    photo = steps.receive()
    steps.inspect(photo)
    steps.plan(photo)
    steps.estimate(photo)
    states: list[str] = []

    def finish_when_seen(seen: JobOut) -> None:
        states.append(seen.state)
        if seen.state == "running":
            store.photos.finish(photo.public_id, 1)

    job = api.wait(photo.public_id, timeout=20, on_change=finish_when_seen)

    assert job.state == "succeeded"
    assert states == ["running", "succeeded"]


def test_waiting_for_a_failed_or_stuck_job_raises_why(api: Client, steps: Steps, store: Store) -> None:
    failed, stuck, slow = steps.receive(), steps.receive(), steps.receive()
    store.photos.fail(failed.public_id, 1, "no_usable_patches", "all is sky")
    steps.inspect(stuck, serial=None)
    store.photos.set_state(stuck.public_id, ("inspecting",), "needs_lens")

    with pytest.raises(JobEndedError, match="all is sky"):
        api.wait(failed.public_id)
    with pytest.raises(JobEndedError, match="waiting"):
        api.wait(stuck.public_id)
    with pytest.raises(JobPatienceError, match=slow.public_id):
        api.wait(slow.public_id, timeout=0.2)
    assert api.cancel(slow.public_id).state == "cancelled"


def test_waiting_leaves_a_service_in_peace_that_answers_at_once(steps: Steps, settings: Settings) -> None:
    photo = steps.receive()
    hasty = settings.model_copy(update={"long_poll_seconds": 0.0})
    asked: list[httpx2.Request] = []
    with TestClient(create_app(hasty)) as http:
        http.event_hooks["request"].append(asked.append)
        with pytest.raises(JobPatienceError):
            Client(http=http).wait(photo.public_id, timeout=3.0)

    assert 2 <= len(asked) <= 40  # without a pause it would be hundreds


def test_a_service_that_does_not_start_is_told_with_its_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.executable", "false")

    with (
        pytest.raises(LensModelError, match=r"ended with status 1; .*service.log says why"),
        own_service(tmp_path / "data", tmp_path / "service.log"),
    ):
        pass


def test_a_lens_is_asked_for_its_psf(api: Client, steps: Steps) -> None:
    photo = steps.counted(patches=6)
    (lens,) = api.lenses(model="EF24mm f/1.4L")

    psf = api.psf(lens.id, r=0.9, phi=0.59, aperture=1.4, size=21)
    kernel = api.kernel(lens.id, r=0.9, phi=0.59, aperture=1.4, size=21)

    assert kernel.shape == (21, 21)
    np.testing.assert_allclose(kernel, psf.psf.data, atol=1e-7)
    assert [event.photo_id for event in api.calibrations(lens.id)] == [photo.public_id]
    assert api.change_photo(photo.public_id, excluded=True).state == "excluded"
    assert api.lens(lens.id).version == 2


def test_all_pages_are_read(api: Client, steps: Steps) -> None:
    for _ in range(53):
        steps.receive()

    assert len(api.photos()) == 53


def test_a_corrected_photo_is_saved_whole_or_not_at_all(
    api: Client, steps: Steps, store: Store, settings: Settings, tmp_path: Path
) -> None:
    correction = api.correct(steps.counted().public_id, method="fast", output={"format": "png16"})
    target = tmp_path / "out.png"
    with pytest.raises(ServiceProblemError, match="not_ready"):
        api.download(correction.id, target)
    assert not list(tmp_path.glob("*.p*"))

    Storage(settings.storage).put("corrections/x/result", b"the file")
    store.corrections.start(correction.id)
    store.corrections.finish(correction.id, Result("corrections/x/result", "e", "image/png", 8, "o.png"), {})

    assert api.wait(correction).links.result is not None
    assert api.download(correction.id, target).read_bytes() == b"the file"
    assert api.correction(correction.id).output["format"] == "png16"


def test_an_error_page_of_a_proxy_is_told_as_it_is() -> None:
    def proxy(request: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(502, text="<html>bad gateway</html>")

    http = httpx2.Client(base_url="http://test", transport=httpx2.MockTransport(proxy))

    with Client(http=http) as client, pytest.raises(ServiceProblemError, match="bad gateway"):
        client.photo("x")
