"""A service of one's own for as long as the demo needs it, and what it is asked for."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import httpx2
import numpy as np
import tifffile

from app.client import Client
from app.schemas import CorrectionOut, JobOut, PhotoOut
from lensmodel.core.errors import LensModelError
from lensmodel.core.types import Planes

_START_SECONDS = 90.0
_STOP_SECONDS = 40.0
"""Longest waits for the service to start and to stop (chosen): it kills its members after 15 s."""

PATIENCE_SECONDS = 900.0
"""Longest wait for one job (chosen): far longer than one takes, on a slow machine too."""

Say = Callable[[str], None]
"""Takes one line of progress."""


class ServiceDidNotStartError(LensModelError):
    """The service ended, or was not ready in time; the text says where its log is."""


@contextmanager
def own_service(data: Path, log_file: Path, settings: Mapping[str, str] | None = None) -> Iterator[Client]:
    """Start the real service on a free loopback port, wait until it is ready, and stop it at the end."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("LENS_")}
    environment |= settings or {}
    data.mkdir(parents=True, exist_ok=True)
    with log_file.open("wb") as log:
        process = subprocess.Popen(
            [sys.executable, "-m", "lensmodel", "serve", "--port", "0", "--data", str(data)],
            stdout=log,
            stderr=subprocess.STDOUT,
            env=environment,
        )
    try:
        with Client(_ready(process, data, log_file), key="") as client:  # nobody is asked here
            yield client
    finally:
        process.send_signal(signal.SIGTERM)
        try:
            process.wait(_STOP_SECONDS)
        except subprocess.TimeoutExpired:
            process.kill()


def _ready(process: subprocess.Popen[bytes], data: Path, log_file: Path) -> str:
    until = time.monotonic() + _START_SECONDS
    while time.monotonic() < until and process.poll() is None:
        try:
            url = str(json.loads((data / "service.json").read_text(encoding="utf-8"))["url"])
            if httpx2.get(f"{url}/readyz", timeout=5).status_code == httpx2.codes.OK:
                return url
        except (OSError, ValueError, KeyError, httpx2.HTTPError):
            pass  # not there yet: asked again until the time is up
        time.sleep(0.2)
    status = process.poll()
    became = f"was not ready within {_START_SECONDS:g} s" if status is None else f"ended with status {status}"
    raise ServiceDidNotStartError(f"the service {became}; {log_file} says why")


def follow(client: Client, work: PhotoOut | CorrectionOut, say: Say) -> JobOut:
    """Wait until a job is done; say each stage once."""
    last = ""

    def show(job: JobOut) -> None:
        nonlocal last
        if (words := f"  {job.stage or job.state}") != last:
            last = words
            say(words)

    return client.wait(work, timeout=PATIENCE_SECONDS, on_change=show)


def corrected(client: Client, photo: PhotoOut, folder: Path, say: Say, **output: str) -> Path:
    """Have a photo corrected into a 16-bit TIFF and download it; `output` is the rest of what it asks for."""
    correction = client.correct(photo.id, output={"format": "tiff16", **output})
    follow(client, correction, say)
    return client.download(correction.id, folder / f"{correction.id}.tif")


def planes_of(path: Path) -> Planes:
    """Return the planes of a corrected 16-bit TIFF in the camera's linear colours."""
    pixels = tifffile.imread(path)
    return np.ascontiguousarray(np.moveaxis(pixels, -1, 0), dtype=np.float32) / np.float32(65535.0)
