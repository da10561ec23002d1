"""The whole service in real processes: what a user does, and what happens when processes die."""

from __future__ import annotations

import contextlib
import io
import os
import shutil
import signal
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import pytest
import tifffile
from deadline import stretched, until
from PIL import Image
from running import BRIEF, OWN_ACCOUNT, PATIENCE_S, PROGRAM, SHAPE, SMALL, Service, running, write_photo
from servers import free_port, ready

import lensmodel
from lensmodel.core.psf import rms_width
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings
from lensmodel.model.profile import read_profile

SIGMA = 1.3


def at_work(job: dict[str, Any]) -> bool:
    """Whether a job is worked on; its last stage lasts no longer than a look at it."""
    return str(job["state"]) == "running"


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Photos of one lens."""
    folder = tmp_path_factory.mktemp("photos")
    for seed, name in {0: "first", 2: "third", 3: "fourth", 4: "fifth"}.items():
        shape = SHAPE if name in {"first", "third"} else SMALL  # what is shown of it, and what is corrected
        write_photo(folder / f"{name}.dng", seed, sigma=SIGMA, shape=shape)
    return folder


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    # of so few patches no wavefront is fitted, for which each version would wait
    made = Service(tmp_path_factory.mktemp("journey") / "data", BRIEF, **OWN_ACCOUNT)
    try:
        made.start()
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def first(service: Service, photos: Path) -> dict[str, Any]:
    return service.calibrated(photos / "first.dng")


def lens_of(service: Service, photo: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = service.get(f"/v1/lenses/{photo['lens_id']}")
    return found


def additions(service: Service, lens_id: str, photo_id: str) -> list[dict[str, Any]]:
    history = service.get(f"/v1/lenses/{lens_id}/calibrations")["items"]
    return [event for event in history if event["photo_id"] == photo_id]


def pids_of(service: Service) -> list[int]:
    return [service.info()[name] for name in ("worker_pid", "pid")]


def alive(pids: list[int]) -> list[int]:
    return [pid for pid in pids if Path(f"/proc/{pid}").exists()]


def test_a_photo_calibrates_its_lens_once(service: Service, first: dict[str, Any], photos: Path) -> None:
    lens, again = lens_of(service, first), service.upload(photos / "first.dng", status=200)
    place: dict[str, str | float] = {"r": 0.4, "phi": 0.3, "aperture": 2.8, "channel": "g", "size": 21}
    kernel = np.array(service.get(f"/v1/lenses/{first['lens_id']}/psf", params=place)["psf"]["data"])

    assert (first["state"], first["width"], first["height"], first["aperture"]) == ("counted", 448, 320, 2.8)
    assert first["patches"]["done"] == first["patches"]["total"] > 0
    assert (lens["serial"], lens["serial_source"], lens["model"]) == ("L-42", "exif", "Test 35mm f/1.8")
    assert lens["samples"] >= first["patches"]["total"]
    assert (again["id"], len(additions(service, first["lens_id"], first["id"]))) == (first["id"], 1)
    assert kernel.sum() == pytest.approx(1.0, abs=1e-4)
    assert rms_width(kernel) == pytest.approx(SIGMA, rel=0.25)


def test_a_stored_photo_is_corrected_sharper(service: Service, first: dict[str, Any], photos: Path) -> None:
    def corrected(**options: Any) -> httpx2.Response:
        made = service.http.post("/v1/corrections", json={"photo_id": stored["id"], **options}).json()
        assert service.job(made["id"])["state"] == "succeeded"
        again = service.http.post("/v1/corrections", json={"photo_id": stored["id"], **options})
        assert (again.status_code, again.json()["id"]) == (200, made["id"])
        zones = set(again.json()["report"]["zones"])
        assert "roi" in options or zones == {"center", "mid", "corner"}
        return service.http.get(again.json()["links"]["result"])

    stored = service.upload(photos / "third.dng", calibrate="false")
    service.job(stored["id"])
    linear = {"format": "tiff16", "color_space": "camera-linear"}
    result, plain = corrected(output=linear), corrected(output=linear, strength=0.0, method="fast")
    roi = {"x": 100, "y": 50, "width": 200, "height": 120}
    region = corrected(output={"format": "jpeg", "color_space": "srgb"}, roi=roi, method="fast")

    assert service.get(f"/v1/photos/{stored['id']}")["state"] == "stored"
    assert result.headers["content-type"] == "image/tiff"
    assert "third-corrected.tif" in result.headers["content-disposition"]
    sharp, soft = (tifffile.imread(io.BytesIO(file.content))[..., 1] for file in (result, plain))
    assert sharp.shape == SHAPE
    assert np.abs(np.diff(sharp.astype(float))).mean() > 1.2 * np.abs(np.diff(soft.astype(float))).mean()
    with Image.open(io.BytesIO(region.content)) as picture:
        assert (picture.format, picture.size) == ("JPEG", (200, 120))


def killed(service: Service, member: str) -> None:
    """Kill one of the processes, see all of them end, and start the service again as systemd does."""
    pids = pids_of(service)
    os.kill(service.info()[member], signal.SIGKILL)
    assert service.process is not None
    assert service.process.wait(stretched(60)) == (1 if member == "worker_pid" else -signal.SIGKILL)
    until(lambda: not alive(pids), service.log, 20)
    service.start()


def test_a_killed_worker_ends_the_service_and_a_photo_counts_once(
    service: Service, first: dict[str, Any], photos: Path
) -> None:
    photo = service.upload(photos / "fourth.dng")
    service.job(photo["id"], until=at_work)

    killed(service, "worker_pid")

    job = service.job(photo["id"])
    (event,) = additions(service, first["lens_id"], photo["id"])

    assert job["state"] == "succeeded", job
    assert event["samples_added"] <= 3 * service.get(f"/v1/photos/{photo['id']}")["patches"]["done"]


def test_a_second_service_on_the_same_data_is_refused_and_the_first_runs_on(service: Service) -> None:
    info, pids = service.info(), pids_of(service)

    second = subprocess.run(
        [*PROGRAM, "serve", "--port", "0", "--data", service.data.name],
        cwd=service.data.parent,
        capture_output=True,
        text=True,
        timeout=stretched(PATIENCE_S),
        check=False,
    )

    assert second.returncode == 2
    assert f"already runs with the data in {service.data.resolve()}:" in second.stderr
    assert "or give another folder by --data" in second.stderr
    assert (service.info(), alive(pids)) == (info, pids)
    assert service.get("/readyz")["status"] == "ready"


@pytest.mark.slow
def test_a_service_whose_data_were_deleted_takes_nothing_from_the_next_one(tmp_path: Path) -> None:
    with contextlib.closing(Service(tmp_path / "data", **OWN_ACCOUNT)) as first:
        first.start()
        assert first.process is not None
        first.process.send_signal(signal.SIGSTOP)  # so that it ends last
        os.kill(first.info()["worker_pid"], signal.SIGKILL)
        shutil.rmtree(first.data)
        with running(first.data, **OWN_ACCOUNT) as second:
            info = second.info()
            first.process.send_signal(signal.SIGCONT)

            assert first.process.wait(stretched(PATIENCE_S)) == 1
            assert second.info() == info


@pytest.mark.slow
def test_the_parts_run_alone_for_installations_on_many_machines(tmp_path: Path) -> None:
    port, data = free_port(), ["--data", str(tmp_path / "data")]
    parts = [
        subprocess.Popen([*PROGRAM, *words, *data], stderr=subprocess.DEVNULL)
        for words in (["worker"], ["api", "--port", str(port)])
    ]
    try:
        with httpx2.Client(base_url=f"http://127.0.0.1:{port}") as client:
            until(lambda: ready(client), within_s=PATIENCE_S)
        for part in parts:
            part.send_signal(signal.SIGTERM)
        assert [part.wait(stretched(30)) for part in parts] == [0, 0]
    finally:
        for part in parts:
            part.kill()
            part.wait()


@pytest.mark.slow
def test_work_that_a_stop_interrupted_goes_on_at_the_next_start(
    service: Service, first: dict[str, Any], photos: Path
) -> None:
    killed(service, "pid")
    assert lens_of(service, first)["serial"] == "L-42"
    photo = service.upload(photos / "fifth.dng")
    service.job(photo["id"], until=at_work)
    pids = pids_of(service)
    status = service.stop()
    left = alive(pids)
    file_left = (service.data / "service.json").exists()

    service.start()
    job = service.job(photo["id"])
    lens_id = service.get(f"/v1/photos/{photo['id']}")["lens_id"]
    events = additions(service, lens_id, photo["id"])

    assert status == 0, service.log.read_text()[-4000:]
    assert (left, file_left) == ([], False)
    assert (job["state"], len(events)) == ("succeeded", 1), job


@pytest.mark.slow
@pytest.mark.parametrize("blank", [0, 60])
def test_page_and_terminal_learn_one_lens_from_one_file(blank: int, tmp_path: Path) -> None:
    photo = write_photo(tmp_path / "first.dng", 0, blank=blank)
    with running(tmp_path / "data", LENS_PATCHES="0", **OWN_ACCOUNT) as alone:
        address = f"/v1/lenses/{alone.calibrated(photo)['lens_id']}/profile"
        page = read_profile(io.BytesIO(alone.http.get(address).content), "the profile of the page").model

    terminal = lensmodel.calibrate([photo], workers=1).model

    learned = [[(s.position, s.estimator) for s in model.samples] for model in (page, terminal)]
    assert learned[0] == learned[1]
    places = [FieldPosition(r, phi) for r in (0.0, 0.5, 0.9) for phi in (0.3, 2.6, -1.9)]
    for channel in CHANNELS:
        of = places, LensSettings(2.8, channel=channel), 31
        apart = np.subtract(list(page.kernels(*of)), list(terminal.kernels(*of)))
        assert np.abs(apart).sum(axis=(-2, -1)).max() < 1e-4  # L1 of kernels of sum 1
