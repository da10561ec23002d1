"""Tasks that misbehave, for the tests of the sandbox."""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import itertools
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import FunctionType
from typing import Any

import numpy as np

from app.sandbox.child import ProgressHook
from lensmodel.core.errors import NoUsablePatchesError


def add(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    np.save(folder / "sum.npy", np.array(arguments["a"]) + np.array(arguments["b"]))
    progress(1, 2)
    progress(2, 2)
    return {"environment": dict(os.environ), "folder": str(Path.cwd()), "pid": os.getpid()}


def weight(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, Any]:
    session = Path("/proc/self/autogroup")
    return {
        "nice": os.getpriority(os.PRIO_PROCESS, 0),
        "session": session.read_text() if session.exists() else "",
    }


def refuse(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    raise NoUsablePatchesError(
        "nothing sharp in this photo; use another one" + "x" * arguments.get("more", 0)
    )


def sleep(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    (folder / "pid").write_text(str(os.getpid()))
    progress(0, 1)
    time.sleep(60)


def spawn(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    process = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    (folder / "own").write_text(str(os.getpid()))
    (folder / "pid").write_text(str(process.pid))
    time.sleep(60)


def open_files(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> int:
    held = []
    with contextlib.suppress(OSError):
        while True:
            held.append((folder / "a").open("w"))
    return len(held)


def probe(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, str]:
    """Try what a task that a hostile file took over would try; say how far each came."""

    def fork() -> None:
        pid = os.fork()
        if pid == 0:
            os._exit(0)
        os.waitpid(pid, 0)

    def trace() -> None:
        if ctypes.CDLL(None, use_errno=True).ptrace(16, arguments["parent"], 0, 0) < 0:
            raise OSError(ctypes.get_errno(), "ptrace")

    parent, service = Path(f"/proc/{arguments['parent']}"), ("127.0.0.1", arguments["port"])
    database, other = Path(arguments["database"]), Path(arguments["other"])
    tries: dict[str, Callable[[], object]] = {
        "own environment": lambda: Path("/proc/self/environ").read_text(),
        "environment of the service": (parent / "environ").read_text,
        "memory of the service": lambda: (parent / "mem").open("rb").close(),
        "files of the service": lambda: list((parent / "fd").iterdir()),
        "database": database.read_bytes,
        "photo of another": other.read_bytes,
        "list of photos": lambda: list(other.parent.iterdir()),
        "accounts of the machine": Path("/etc/passwd").read_text,
        "write to the data": lambda: database.write_bytes(b"gone"),
        "make a file": database.with_name("planted").touch,
        "change the cache": (Path(arguments["cache"]) / "planted").touch,
        "remove a photo": other.unlink,
        "connect": lambda: socket.create_connection(service, timeout=5).close(),
        "send a datagram": lambda: socket.socket(type=socket.SOCK_DGRAM).sendto(b"x", service),
        "fork": fork,
        "run a program": lambda: subprocess.run(["/bin/true"], check=True).returncode,
        "become another program": lambda: os.execv("/bin/true", ["/bin/true"]),
        "trace the service": trace,
        "signal the service": lambda: os.kill(arguments["parent"], 0),
        # what it must be able to do
        "own photo": Path(arguments["own"]).read_text,
        "own folder": lambda: (folder / "made").write_text("made"),
        "thread": lambda: ThreadPoolExecutor(1).submit(str).result(),
        "import": lambda: importlib.import_module("scipy.interpolate").__name__,
    }
    found = {}
    for name in tries.keys() - set(arguments.get("but", ())):
        attempt = tries[name]
        try:
            found[name] = f"done: {attempt()}"[:4000]
        except OSError as error:
            found[name] = f"refused: {type(error).__name__}"
    return found


def sabotage(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> dict[str, str]:
    """Try to end, slow down or limit other processes; say how far each try came."""
    libc, others = ctypes.CDLL(None, use_errno=True), arguments["pid"]
    calls = {"tkill": (200, 130), "tgkill": (234, 131), "sigqueue": (129, 138), "prlimit": (302, 261)}
    number = {name: both[os.uname().machine != "x86_64"] for name, both in calls.items()}
    space = ctypes.create_string_buffer(256)
    tries: dict[str, Callable[[], int]] = {
        "kill": lambda: libc.kill(others, 0),
        "kill all": lambda: libc.kill(-1, 0),
        "kill the group": lambda: libc.kill(0, 0),
        "tkill": lambda: libc.syscall(number["tkill"], others, 0),
        "tgkill": lambda: libc.syscall(number["tgkill"], others, others, 0),
        "sigqueue": lambda: libc.syscall(number["sigqueue"], others, 0, space),
        "prlimit": lambda: libc.syscall(number["prlimit"], others, 7, None, space),
        "own limits": lambda: libc.syscall(number["prlimit"], 0, 7, None, space),
        "own signal": lambda: libc.kill(os.getpid(), 0),
    }
    return {
        name: "done" if attempt() == 0 else errno.errorcode[ctypes.get_errno()]
        for name, attempt in tries.items()
    }


def litter(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    for number in range(arguments["files"]):
        (folder / str(number)).write_bytes(bytes(arguments["bytes"]))
    time.sleep(60)


def hoard(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> list[str]:
    """Fill the disk by files that no folder names; say how far each way came."""
    libc = ctypes.CDLL(None, use_errno=True)
    path, other = folder / "hoarded", folder / "other"

    def removed() -> int:
        number = os.open(path, os.O_CREAT | os.O_RDWR)
        path.unlink()
        return number

    def replaced() -> int:
        number = os.open(path, os.O_CREAT | os.O_RDWR)
        other.touch()
        other.rename(path)
        return number

    def unnamed() -> int:
        return os.open(folder, os.O_TMPFILE | os.O_RDWR)

    def in_memory() -> int:
        number = libc.memfd_create(b"", 0)
        if number < 0:
            raise OSError(ctypes.get_errno(), "memfd_create")
        return number

    done = []
    for way in (removed, replaced, unnamed, in_memory):
        with contextlib.suppress(OSError):
            os.write(way(), bytes(arguments["bytes"]))
            done.append(way.__name__)
    return done


def stutter(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    """Write the beginning of a message wherever one can be sent."""
    _send(struct.pack("!i", 1000))
    time.sleep(60)


def mislead(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    """End well, with a report that is not one's own, or none that can be read."""
    report, done = folder / "result.json", b'{"end": "ok"}'
    how = {
        "link": lambda: report.symlink_to(arguments["other"]),
        "pipe": lambda: os.mkfifo(report),
        "nest": lambda: report.write_text("[" * 100_000),
        "list": lambda: report.write_text("[]"),
        "void": report.touch,
        "folder": report.mkdir,
    }
    how[arguments["how"]]()
    _send(struct.pack("!i", len(done)) + done)
    os._exit(0)


def _send(message: bytes) -> None:
    for number in range(3, 100):
        with contextlib.suppress(OSError):
            os.write(number, message)


def forge(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    """Print what looks like a record of the service."""
    os.write(2, b"harmless\n2026-01-01 00:00:00,000 CRITICAL worker app.jobs.worker: all is lost\n\x1b[2J")
    os.write(1, b"x" * arguments.get("bytes", 0))


def compile_one(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> list[str]:
    from lensmodel.core.numerics import jit  # noqa: PLC0415 - others need it not

    twice = jit(_twice)
    twice(1)
    found, cache = [], Path(arguments["cache"])
    with contextlib.suppress(OSError):
        list(cache.iterdir())
        found.append("reads")
    with contextlib.suppress(OSError):
        (cache / "x").touch()
        found.append("plants")
    loaded = "loaded" if twice.stats.cache_hits else "compiled"  # type: ignore[attr-defined]  # a dispatcher
    return [loaded, *found]


def _twice(number: int) -> int:
    return 2 * number


def link(arguments: dict[str, Any], folder: Path, progress: ProgressHook) -> None:
    """Leave links where the worker expects what the task made."""
    (folder / "preview.jpg").symlink_to(arguments["database"])
    (folder / "inner").mkdir()
    (folder / "inner" / "more").symlink_to(Path(arguments["database"]).parent)
    (folder / "inner" / "made").write_text("made")


TASKS = {name: each for name, each in globals().items() if isinstance(each, FunctionType) and name[0] != "_"}
TASKS |= {
    "blunder": lambda *_: {}["nobody thought of this"],
    "crash": lambda *_: ctypes.string_at(0),
    "die": lambda *_: os.kill(os.getpid(), signal.SIGKILL),
    "spin": lambda *_: all(itertools.repeat(True)),
    "swell": lambda arguments, *_: int(np.ones(arguments["mb"] << 17).sum()),
}
