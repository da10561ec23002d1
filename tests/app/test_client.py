"""The client speaks with the real application, and its own words with its caller."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
from starlette.testclient import TestClient

from app.blobs.storage import Storage
from app.client import Client, JobEndedError, JobPatienceError, ServiceProblemError
from app.main import create_app
from app.runtime.settings import Settings
from app.schemas import JobOut
from app.store import Store
from app.store.lenses import report_key
from app.store.owners import ANY_OWNER
from lab.demo import own_service
from lensmodel.core.codec import to_json
from lensmodel.core.errors import LensModelError
from lensmodel.model import LensModel
from lensmodel.report import lens_report

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
    api.delete(photo)
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


def test_waiting_leaves_a_service_in_peace_that_answers_at_once(
    steps: Steps, settings: Settings, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo = steps.receive()
    monkeypatch.setattr("app.routes.jobs.LONG_POLL_S", 0.0)
    asked: list[httpx2.Request] = []
    with TestClient(create_app(settings)) as http:
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

    assert np.shape(psf.psf.data) == (21, 21)
    assert np.sum(psf.psf.data) == pytest.approx(1.0, abs=1e-6)
    (event,) = api.get(f"/v1/lenses/{lens.id}/calibrations")["items"]
    assert event["photo_id"] == photo.public_id
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
    run = store.jobs.start(correction.id, 1)
    assert run is not None
    store.jobs.finish(
        run, {}, key="corrections/x/result", etag="e", media_type="image/png", bytes=8, name="o.png"
    )

    assert api.wait(correction).links["result"] is not None
    assert api.download(correction.id, target).read_bytes() == b"the file"
    assert api.correction(correction.id).output["format"] == "png16"


def test_lenses_are_named_and_merged(api: Client, steps: Steps) -> None:
    photos = [steps.counted(serial=serial) for serial in ("1", "2", "2")]
    first, second = steps.lens_id(photos[0]), steps.lens_id(photos[1])

    assert api.change_lens(first, label="Old one").label == "Old one"
    assert api.change_lens(first, label=None).label is None
    with pytest.raises(ServiceProblemError, match="other_lens"):
        api.change_lens(first, merge_into=second)
    merged = api.change_lens(first, merge_into=second, any_lens=True)
    assert (merged.id, merged.photos) == (second, 3)
    assert [lens.id for lens in api.lenses()] == [second]


@pytest.mark.usefixtures("reading")
def test_a_profile_is_saved_and_added(api: Client, steps: Steps, tmp_path: Path) -> None:
    one, other = (steps.lens_id(steps.counted(serial=serial)) for serial in "12")

    path = api.save_profile(one, tmp_path / "one.lensprofile")
    with pytest.raises(ServiceProblemError, match="other_lens"):
        api.add_profile(other, path)
    added = api.add_profile(other, path, any_lens=True)

    assert added.photos == 2
    assert added.samples == 2 * api.lens(one).samples
    imported = next(photo for photo in api.photos(lens_id=other) if photo.sha256 and not photo.width)
    api.delete(imported)
    assert api.add_profile(other, path, any_lens=True).photos == 2


def test_a_report_that_is_not_made_yet_is_refused_and_one_that_is_there_saved(
    api: Client, steps: Steps, store: Store, settings: Settings, tmp_path: Path
) -> None:
    lens_id = steps.lens_id(steps.counted(patches=6))
    with pytest.raises(ServiceProblemError, match="not_ready"):
        api.save_report(lens_id, tmp_path / "report.pdf")
    _, stored = store.lenses.samples_of(lens_id)
    model = LensModel.fit(stored)
    test = lens_report(model, "A lens", rows=5, size=15, channels=("g",))
    lens = store.lenses.get(lens_id, ANY_OWNER)
    assert lens is not None
    key = report_key(lens_id, lens.version, lens.rebuild_epoch)
    Storage(settings.storage).put(key, json.dumps(to_json(test)).encode())

    pages = api.save_report(lens_id, tmp_path / "report.pdf").read_bytes()
    table = api.save_report(lens_id, tmp_path / "figures.CSV").read_text(encoding="utf-8")

    assert pages.startswith(b"%PDF-")
    assert "," in table.splitlines()[0]


def test_an_error_page_of_a_proxy_is_told_as_it_is() -> None:
    def proxy(request: httpx2.Request) -> httpx2.Response:
        return httpx2.Response(502, text="<html>bad gateway</html>")

    http = httpx2.Client(base_url="http://test", transport=httpx2.MockTransport(proxy))

    with Client(http=http) as client, pytest.raises(ServiceProblemError, match="bad gateway"):
        client.photo("x")


def test_an_upload_says_how_far_it_is(api: Client, tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    path.write_bytes(b"II*\x00" + bytes(600_000))
    progress: list[tuple[int, int]] = []

    api.upload(path, calibrate=False, on_progress=lambda *far: progress.append(far))

    assert progress == [(600_004, 600_004)]


class Flaky(httpx2.BaseTransport):
    """Answers in turn; an exception is raised."""

    def __init__(self, *answers: httpx2.Response | Exception) -> None:
        self.answers = list(answers)

    def handle_request(self, request: httpx2.Request) -> httpx2.Response:
        answer = self.answers.pop(0)
        if isinstance(answer, Exception):
            raise answer
        return answer


def job_of(state: str) -> httpx2.Response:
    job = JobOut.model_validate(
        {
            **dict.fromkeys(("stage", "eta_seconds", "error", "started_at", "finished_at")),
            "id": "1",
            "kind": "photo",
            "state": state,
            "attempt": 1,
            "created_at": "2026-01-01T00:00:00Z",
            "progress": {"done": 0, "total": 1, "unit": "patches"},
            "links": {"self": "/v1/jobs/1", **dict.fromkeys(("photo", "lens", "correction", "result"))},
        }
    )
    return httpx2.Response(200, content=job.model_dump_json(), headers={"ETag": f'"{state}"'})


def test_waiting_outlasts_a_restart_of_the_service(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("app.client.AWAY_SECONDS", 0.0)
    away = (httpx2.ConnectError("no"), httpx2.Response(502), httpx2.Response(503))
    flaky = Flaky(job_of("running"), *away, job_of("succeeded"))

    with httpx2.Client(transport=flaky, base_url="http://x") as http:
        assert Client(http=http).wait("1").state == "succeeded"


def test_waiting_does_not_begin_where_there_is_no_service() -> None:
    with (
        httpx2.Client(transport=Flaky(httpx2.ConnectError("no")), base_url="http://x") as http,
        pytest.raises(httpx2.ConnectError),
    ):
        Client(http=http).wait("1")
