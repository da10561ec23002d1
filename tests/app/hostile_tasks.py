"""Tasks that misbehave, for the tests of the sandbox."""

from __future__ import annotations

import ctypes
import errno
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from app.jobs.child import Progress
from lensmodel.errors import NoUsablePatchesError


def add(arguments: dict[str, Any], folder: Path, progress: Progress) -> dict[str, Any]:
    np.save(folder / "sum.npy", np.array(arguments["a"]) + np.array(arguments["b"]))
    progress(1, 2)
    progress(2, 2)
    return {"environment": dict(os.environ), "folder": str(Path.cwd()), "pid": os.getpid()}


def refuse(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    raise NoUsablePatchesError("nothing sharp in this photo; use another one")


def swell(arguments: dict[str, Any], folder: Path, progress: Progress) -> int:
    return int(np.ones(arguments["mb"] << 17).sum())


def spin(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    while True:
        pass


def sleep(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    Path(arguments["pid_file"]).write_text(str(os.getpid()))
    progress(0, 1)
    time.sleep(60)


def spawn(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    Path(arguments["pid_file"]).write_text(str(process.pid))
    progress(0, 1)
    time.sleep(60)


def crash(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    ctypes.string_at(0)


def die(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def blunder(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    raise KeyError("nobody thought of this")


def write(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    with (folder / "large").open("wb") as file:
        for _ in range(arguments["mb"]):
            file.write(bytes(1 << 20))


def open_files(arguments: dict[str, Any], folder: Path, progress: Progress) -> int:
    held = []
    try:
        while True:
            held.append((folder / "a").open("w"))
    except OSError:
        return len(held)


def fill_the_disk(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def shout(arguments: dict[str, Any], folder: Path, progress: Progress) -> None:
    raise NoUsablePatchesError("x" * 1_000_000)


TASKS = {
    f.__name__: f
    for f in (
        add,
        refuse,
        swell,
        spin,
        sleep,
        spawn,
        crash,
        die,
        blunder,
        write,
        open_files,
        fill_the_disk,
        shout,
    )
}
