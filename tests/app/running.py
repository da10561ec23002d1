"""A real service in processes of its own, and small photos to feed it."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any

import httpx2
import numpy as np
import uvicorn
from deadline import Deadline, stretched, until
from numpy.typing import NDArray
from scipy import ndimage

from app.main import create_app
from app.runtime import supervisor
from app.runtime.settings import Settings
from lab.kernels import gaussian
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.lens import Lens
from lensmodel.model import LensModel
from lensmodel.photo.values import LensIdentity, PhotoMetadata
from lensmodel.photo.writing import write_bayer_dng
from lensmodel.simulate import demo_scene

PATIENCE_S = 120.0
"""Of an idle machine, see `deadline`."""

SETTINGS = {
    "LENS_ESTIMATOR": "default",
    "LENS_PATCHES": "3",
    "LENS_WORKER_SLOTS": "2",
    "LENS_MIN_FREE_MB": "0",
    "LENS_SANDBOX": "try",  # whatever this machine has
    "LENS_TASK_SECONDS": f"{stretched(3600.0):.0f}",
    "LENS_TASK_NICENESS": "0",  # tests wait for photos too: beside other programs they would starve
}
PROGRAM = [sys.executable, "-m", "lensmodel"]
OWN_ACCOUNT = {"LENS_TASK_USER": "none"}
"""Tasks with the account of the tests find the loops that were compiled before: each other service that is
started by root compiles them anew, half a minute of it, into a folder of its own."""
STAND_IN = [sys.executable, str(Path(__file__).with_name("stand_ins") / "service.py")]
LIGHT = [*STAND_IN, "light_tasks"]
"""The same whose workers estimate nothing."""
BRIEF = [*STAND_IN, "brief_tasks"]
"""The same whose workers report on lenses in brief."""
FINAL = {"succeeded", "failed", "cancelled"}
SHAPE, SMALL = (320, 448), (224, 320)
"""Of photos, in pixels; of a small one all is done in half the time, but nothing is said of its corners."""


class Service:
    """The whole service as `lensmodel serve` runs it, on a free port."""

    def __init__(self, data: Path, program: Sequence[str] = PROGRAM, **settings: str) -> None:
        self.data, self._program = data, program
        self.log = data.parent / f"{data.name}.log"
        others = {name: value for name, value in os.environ.items() if not name.startswith("LENS_")}
        self._environment = {**others, **SETTINGS, **settings}
        self.process: subprocess.Popen[str] | None = None
        self.http = httpx2.Client(timeout=stretched(60.0))

    def start(self) -> None:
        """Start, or start again, and wait until it is ready."""
        if self.process is not None:
            self.process.stdout.close()  # of a service that ended by itself
        with self.log.open("a") as log:
            self.process = subprocess.Popen(
                [*self._program, "serve", "--port", "0", "--data", str(self.data)],
                env=self._environment,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
            )
        said = self.process.stdout.readline()
        assert "runs at" in said, self.log.read_text()[-4000:]
        self.http.base_url = httpx2.URL(self.info()["url"])
        until(lambda: self.http.get("/readyz").status_code == 200, self.log, PATIENCE_S)

    def stop(self) -> int:
        """Stop as Ctrl-C does; return the exit status."""
        self.process.send_signal(signal.SIGTERM)
        status = self.process.wait(stretched(30))
        self.process.stdout.close()
        return status

    def close(self) -> None:
        """Leave nothing behind."""
        self.http.close()
        if self.process is not None:
            self.process.kill()
            self.process.wait()
            self.process.stdout.close()

    def info(self) -> dict[str, Any]:
        """Return the address and the processes."""
        return json.loads((self.data / "service.json").read_text())

    def get(self, path: str, status: int = 200, **options: Any) -> Any:
        """Return the JSON of an address."""
        answer = self.http.get(path, **options)
        assert answer.status_code == status, answer.text
        return answer.json()

    def upload(self, path: Path, status: int = 202, **fields: str) -> dict[str, Any]:
        """Send a photo; return its description."""
        with path.open("rb") as file:
            answer = self.http.post("/v1/photos", files={"file": (path.name, file)}, data=fields)
        assert answer.status_code == status, answer.text
        return answer.json()

    def job(self, job_id: str, until: Callable[[dict[str, Any]], object] | None = None) -> dict[str, Any]:
        """Return a job once it ended, or once `until` holds, which it must before the end."""
        deadline = Deadline(PATIENCE_S)
        while True:
            job: dict[str, Any] = self.get(f"/v1/jobs/{job_id}")
            if job["state"] in FINAL if until is None else until(job):
                return job
            assert job["state"] not in FINAL, f"ended before what was awaited: {job}"
            assert not deadline.passed(), f"{job}\n{self.log.read_text()[-4000:]}"
            time.sleep(0.1)

    def calibrated(self, path: Path, **fields: str) -> dict[str, Any]:
        """Send a photo and wait until it counts; return it."""
        photo = self.upload(path, 202, **fields)
        job = self.job(photo["id"])
        assert job["state"] == "succeeded", job
        return self.get(f"/v1/photos/{photo['id']}")


@contextmanager
def running(data: Path, program: Sequence[str] = PROGRAM, **settings: str) -> Iterator[Service]:
    """Give a service that runs, and end it afterwards."""
    service = Service(data, program, **settings)
    try:
        service.start()
        yield service
        assert service.stop() == 0, service.log.read_text()[-4000:]
    finally:
        service.close()


@contextmanager
def served(settings: Settings) -> Iterator[int]:
    """Serve on a real port, in a thread: slow clients need a real connection."""
    listener = supervisor.listen("127.0.0.1", 0)
    config = uvicorn.Config(create_app(settings), access_log=False, log_config=None)
    running = uvicorn.Server(config)
    thread = threading.Thread(target=running.run, kwargs={"sockets": [listener]})
    thread.start()
    try:
        yield listener.getsockname()[1]
    finally:
        running.should_exit = True
        thread.join()
        listener.close()


@cache
def scene(seed: int, height: int = SHAPE[0], width: int = SHAPE[1]) -> NDArray[np.float64]:
    """A photograph of half the size, which is sharper than itself; not to be changed."""
    top = 100 + 16 * (seed // 2)
    whole = demo_scene(("tea-gardens", "city")[seed % 2])[1, top : top + 2 * height, 300 : 300 + 2 * width]
    return np.asarray(whole.reshape(height, 2, width, 2).mean(axis=(1, 3)), dtype=np.float64)


def write_photo(
    path: Path,
    seed: int,
    *,
    sigma: float = 1.3,
    serial: str = "L-42",
    aperture: float | None = 2.8,
    shape: tuple[int, int] = SHAPE,
    blank: int = 0,
) -> Path:
    """Write a raw photo of a real scene in grey, taken through a round Gaussian blur.

    Each seed has noise of its own, but there are two scenes only: to read one takes a tenth of a second.
    The last `blank` columns show nothing.
    """
    light = ndimage.gaussian_filter(scene(seed % 2, *shape), sigma)
    light[:, shape[1] - blank :] = 0.4
    return write_light(path, light, seed, serial=serial, aperture=aperture)


def lens_of_one_blur() -> Lens:
    """The profile of the lens of `write_photo`, which blurs alike everywhere, learned from another photo."""
    samples = [
        PsfSample(gaussian(15, np.eye(2) * 1.7), FieldPosition(r, phi), LensSettings(2.8, 35.0), photo="x")
        for r in (0.1, 0.5, 0.9)
        for phi in (-2.0, 0.5, 2.5)
    ]
    names = {"maker": "Test Optics", "model": "Test 35mm f/1.8", "serial": "L-42"}
    return Lens(LensModel.fit(samples), names, {"0123456789abcdef": "x.dng"})


def write_light(
    path: Path, light: NDArray[np.float64], seed: int, *, serial: str = "L-42", aperture: float | None = 2.8
) -> Path:
    """Write a raw photo of such light, of 20,000 electrons where it is 1."""
    rng = np.random.default_rng(seed)
    electrons = rng.poisson(light * 20000.0)
    mosaic = np.clip(512 + electrons / 20000.0 * 15000.0, 0, 16383).round().astype(np.uint16)
    lens = LensIdentity("Test Optics", "Test 35mm f/1.8", serial or None, "exif" if serial else "none")
    seen: dict[str, Any] = {"lens": lens, "aperture": aperture, "focal_mm": 35.0}
    metadata = PhotoMetadata(camera_maker="Test", camera_model="T-1", **seen)
    write_bayer_dng(path, mosaic, black=512, white=15512, metadata=metadata)
    return path
