"""Tasks that take as long as they are told and need no photo: for tests of the workers."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import numpy as np

from app.jobs.sample_files import write_samples
from app.sandbox.child import ProgressHook
from lab.kernels import gaussian
from lensmodel.core.files import save_array
from lensmodel.core.psf import PsfSample
from lensmodel.core.types import CHANNELS, FieldPosition, LensSettings

CELLS = 8
SECONDS = 0.3
LENS = {"maker": "Quick", "model": "Quick 50mm", "serial": "Q-1", "serial_source": "exif"}
METADATA = {
    "lens": LENS,
    "aperture": 2.8,
    "focal_mm": 50.0,
    "orientation": 1,
    **dict.fromkeys(("camera_maker", "camera_model", "focus_m", "pixel_pitch_um")),
}


def locate(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    return {"location": "none"}


def inspect(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    return {"kind": "dng", "width": 64, "height": 48, "metadata": METADATA}


def develop(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    with (folder / "planes.npy").open("wb") as file:
        save_array(file, np.zeros((3, 48, 64), np.float32))
    return {}


def select(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    window = {"row": 0, "size": 8, "score": 1.0}
    patches = [
        {**window, "col": 8 * k, "r": k / CELLS, "phi": turn, "cell": k}
        for k, turn in enumerate(np.linspace(-3.0, 3.0, CELLS).tolist())
    ]
    return {"patches": patches, "rejected": [], "lateral": None}


def estimate(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> list[int]:
    time.sleep(SECONDS)
    kernel, place = gaussian(5, np.eye(2)), FieldPosition(0.0, 0.0)
    about = {"estimator": f"quick-{os.getppid()}", "error": 0.1}  # its fork server: one of each worker
    samples = [PsfSample(kernel, place, LensSettings(channel=name), **about) for name in CHANNELS]
    write_samples(folder, samples)
    return [arguments["numbers"][0] for _ in samples]


def measure(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    return {"error": {}, "coverage": {}}


TASKS = {f.__name__: f for f in (locate, inspect, develop, select, estimate, measure)}
