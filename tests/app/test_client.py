"""The client speaks with the real application, and its own words with its caller."""

from __future__ import annotations

from pathlib import Path
from unittest import mock

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient
from states import Steps, finish, store_report

from app.client import Client, JobEndedError, JobPatienceError, ServiceProblemError
from app.main import create_app
from app.runtime.settings import Settings
from app.schemas import JobOut
from app.store import Store
from lab.demo import own_service
from lensmodel.core.errors import LensModelError


@pytest.fixture
def api(client: TestClient) -> Client:
    return Client(http=client)


def test_an_upload_comes_back_as_a_photo(api: Client, tmp_path: Path) -> None:
    path, far = tmp_path / "Größe p1.tif", list[tuple[int, int]]()
    path.write_bytes(b"II*\x00" + bytes(600_000))

    photo = api.upload(path, aperture=2.8, calibrate=False, on_progress=lambda *now: far.append(now))

    assert (photo.filename, photo.aperture, photo.calibrate) == ("Größe p1.tif", 2.8, False)
    assert far == [(600_004, 600_004)]
    assert api.photo(photo.id) == photo
    assert api.upload(path).id == photo.id
    assert api.photos() == [api.photo(photo.id)]
    api.delete(photo)
    assert api.photos() == []


def test_waiting_for_a_failed_or_stuck_job_raises_why(api: Client, steps: Steps, store: Store) -> None:
    failed, stuck, slow = steps.receive(), steps.waiting(), steps.receive()
    store.photos.fail(failed.public_id, 1, "no_usable_patches", "all is sky")

    with pytest.raises(JobEndedError, match="all is sky"):
        api.wait(failed.public_id)
    with pytest.raises(JobEndedError, match="waiting"):
        api.wait(stuck.public_id)
    with pytest.raises(JobPatienceError, match=slow.public_id):
        api.wait(slow.public_id, timeout=0.2)
    assert api.cancel(slow.public_id).state == "cancelled"


def test_waiting_leaves_a_service_in_peace_that_answers_at_once(
    steps: Steps, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = steps.receive()
    monkeypatch.setattr("app.routes.jobs.LONG_POLL_S", 0.0)
    asked: list[httpx2.Request] = []
    with TestClient(create_app(settings)) as http:
        http.event_hooks["request"].append(asked.append)
        with pytest.raises(JobPatienceError):
            Client(http=http).wait(photo.public_id, timeout=1.0)

    assert 2 <= len(asked) <= 20  # without a pause it would be hundreds


def test_a_service_that_fails_is_told_with_its_log(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.executable", "false")

    with (
        pytest.raises(LensModelError, match=r"ended with status 1; .*service.log says why"),
        own_service(tmp_path / "data", tmp_path / "service.log"),
    ):
        pass


def test_all_pages_are_read(api: Client, steps: Steps) -> None:
    for _ in range(53):
        steps.receive()

    assert len(api.photos()) == 53


def test_a_result_is_saved_whole_or_not(
    client: TestClient, api: Client, steps: Steps, tmp_path: Path
) -> None:
    correction = api.correct(steps.counted().public_id, method="fast", output={"format": "png16"})
    target = tmp_path / "out.png"
    with pytest.raises(ServiceProblemError, match="not_ready"):
        api.download(correction.id, target)
    assert not list(tmp_path.glob("*.p*"))

    finish(client, correction.id, b"the file")

    assert api.wait(correction).links["result"] is not None
    assert api.download(correction.id, target).read_bytes() == b"the file"
    assert api.correction(correction.id).output["format"] == "png16"


@pytest.mark.usefixtures("reading")
def test_a_lens_is_asked_named_merged_and_sent_on(
    client: TestClient, api: Client, steps: Steps, store: Store, tmp_path: Path
) -> None:
    photo = steps.counted(serial="1", patches=6)
    one, other = steps.lens_id(photo), steps.lens_id(steps.counted(serial="2"))

    (lens,) = api.lenses(model="EF24mm f/1.4L", serial="1")
    psf = np.array(api.psf(lens.id, r=0.9, phi=0.59, aperture=1.4, size=21).psf.data)
    assert (lens.id, psf.shape) == (one, (21, 21))
    assert psf.sum() == pytest.approx(1.0, abs=1e-6)
    (event,) = api.get(f"/v1/lenses/{one}/calibrations")["items"]
    assert event["photo_id"] == photo.public_id
    assert [api.change_lens(one, label=label).label for label in ("Old one", None)] == ["Old one", None]

    path = api.save_profile(one, tmp_path / "one.lensprofile")
    with pytest.raises(ServiceProblemError, match=r"number is 1, that of the lens 2.*other_lens, status 409"):
        api.add_profile(other, path)
    assert api.lens(other).photos == 1
    added = api.add_profile(other, path, any_lens=True)
    assert (added.photos, added.samples) == (2, 6 + api.lens(one).samples)
    imported = next(each for each in api.photos(lens_id=other) if each.sha256 and not each.width)
    api.delete(imported)
    assert api.add_profile(other, path, any_lens=True).photos == 2

    with pytest.raises(ServiceProblemError, match="not_ready"):
        api.save_report(one, tmp_path / "report.pdf")
    store_report(client, one)
    assert api.save_report(one, tmp_path / "report.pdf").read_bytes().startswith(b"%PDF-")
    assert "," in api.save_report(one, tmp_path / "figures.CSV").read_text(encoding="utf-8")

    assert api.change_photo(photo.public_id, excluded=True).state == "excluded"
    assert api.lens(one).version == 2
    with pytest.raises(ServiceProblemError, match="other_lens"):
        api.change_lens(one, merge_into=other)
    busy = steps.receive()
    steps.inspect(busy, serial="3")
    with pytest.raises(ServiceProblemError, match="conflict"):
        api.change_lens(steps.lens_id(busy), merge_into=other, any_lens=True)
    store.photos.delete(busy.public_id, "local")
    assert api.change_lens(one, merge_into=other, any_lens=True).id == other
    assert [each.id for each in api.lenses()] == [other]


def test_an_error_page_of_a_proxy_is_told_as_it_is() -> None:
    proxy = httpx2.MockTransport(lambda _: httpx2.Response(502, text="<html>bad gateway</html>"))
    http = httpx2.Client(base_url="http://test", transport=proxy)

    with Client(http=http) as client, pytest.raises(ServiceProblemError, match="bad gateway"):
        client.photo("x")


def job_of(state: str) -> httpx2.Response:
    job = {
        **dict.fromkeys(("stage", "eta_seconds", "error", "started_at", "finished_at")),
        "id": "1",
        "kind": "photo",
        "state": state,
        "attempt": 1,
        "created_at": "2026-01-01T00:00:00Z",
        "progress": {"done": 0, "total": 1, "unit": "patches"},
        "links": {"self": "/v1/jobs/1", **dict.fromkeys(("photo", "lens", "correction", "result"))},
    }
    return httpx2.Response(200, json=job, headers={"ETag": f'"{state}"'})


def test_waiting_outlasts_a_restart_of_a_service_that_was_there(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.client.AWAY_SECONDS", 0.0)
    away = httpx2.ConnectError("no")
    answers = [job_of("running"), away, *map(httpx2.Response, (502, 503)), job_of("succeeded"), away]
    flaky, seen = httpx2.MockTransport(mock.Mock(side_effect=answers)), list[JobOut]()
    with httpx2.Client(transport=flaky, base_url="http://x") as http:
        assert Client(http=http).wait("1", on_change=seen.append).state == "succeeded"
        assert [job.state for job in seen] == ["running", "succeeded"]
        with pytest.raises(httpx2.ConnectError):
            Client(http=http).wait("1")
