"""What programs of ours ask of a running service: follow a job, have a photo corrected, read the result."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import tifffile

from app.client import Client
from app.schemas import CorrectionOut, JobOut, PhotoOut
from lensmodel.core.types import Planes

Say = Callable[[str], None]
"""Takes one line of progress."""

OnJob = Callable[[str, JobOut], None]
"""Takes the same line, and the job that it tells of."""

PATIENCE_SECONDS = 900.0
"""Longest wait for one job (chosen): far longer than one takes, on a slow machine too."""


def follow(
    client: Client,
    work: PhotoOut | CorrectionOut,
    say: Say | None = None,
    *,
    on_job: OnJob | None = None,
    patience: float = PATIENCE_SECONDS,
) -> JobOut:
    """Wait until a job is done; say each change of its progress once."""
    last = ""

    def show(job: JobOut) -> None:
        nonlocal last
        words = f"  {job.stage or job.state}"
        if job.progress.total:
            words += f" {job.progress.done} of {job.progress.total} {job.progress.unit}"
        if job.eta_seconds:
            words += f", about {job.eta_seconds:.0f} s left"
        if words != last:
            last = words
            if say is not None:
                say(words)
            if on_job is not None:
                on_job(words, job)

    return client.wait(work, timeout=patience, on_change=show)


def corrected(
    client: Client,
    photo: PhotoOut,
    folder: Path,
    say: Say | None = None,
    *,
    on_job: OnJob | None = None,
    output: dict[str, str] | None = None,
    **options: object,
) -> Path:
    """Have a photo corrected into a 16-bit TIFF and download it; `options` are the rest of `CorrectionIn`."""
    correction = client.correct(photo.id, output={"format": "tiff16", **(output or {})}, **options)
    follow(client, correction, say, on_job=on_job)
    return client.download(correction.id, folder / f"{correction.id}.tif")


def planes_of(path: Path) -> Planes:
    """Return the planes of a corrected 16-bit TIFF in the camera's linear colours."""
    pixels = tifffile.imread(path)
    return np.ascontiguousarray(np.moveaxis(pixels, -1, 0), dtype=np.float32) / np.float32(65535.0)
