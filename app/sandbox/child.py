"""The code of a child process: confine it, run one task, report how it ended.

This module is what a fresh child imports first, so it imports next to nothing itself.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import os
import resource
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeAlias

from app.sandbox import confine
from app.sandbox.account import SystemAccount
from app.sandbox.outcome import RESULT, TaskLimits
from lensmodel.core import files
from lensmodel.core.errors import LensModelError

ProgressHook: TypeAlias = Callable[[int, int], None]
# Called as `task(arguments, folder, progress)`; returns what JSON can write
Task: TypeAlias = Callable[[dict[str, Any], Path, ProgressHook], Any]
PRINTED: Final = "printed"  # file of what a task printed
# Characters of an error text at most (chosen): a traceback in less than `runner.MAX_MESSAGE` bytes
MAX_TEXT: Final = 4000
_MIB: Final = 1024 * 1024  # bytes
# Default niceness of tasks above that of the worker (chosen): a tenth of the weight of one at 0, see sched(7)
NICENESS: Final = 10
# Seconds between two messages of progress (chosen): a bar that moves, and hardly any work for the parent
_PROGRESS_S: Final = 0.1
_KEPT_ENVIRONMENT: Final = (
    *("LANG", "LC_ALL", "NUMBA_CACHE_DIR", "SYSTEMROOT"),
    "TMPDIR",  # where the fork server listens; a task has a folder of its own instead
    *("PYTHONPATH", "PYTHONHASHSEED", "PYTHONDONTWRITEBYTECODE", "PYTHONWARNINGS"),
)
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
# How an OSError ends a task; any other is a bug
_ENDINGS: Final[Mapping[int | None, str]] = {
    errno.ENOSPC: "no_room",
    errno.EDQUOT: "no_room",
    errno.EFBIG: "memory_limit",
    errno.ENOMEM: "memory_limit",
}


@dataclass(frozen=True, slots=True)
class Order:
    """What a child is to do, and what it may do meanwhile."""

    module: str
    task: str
    arguments: str  # JSON
    folder: Path
    limits: TaskLimits
    niceness: int
    reads: tuple[Path, ...] | None  # None: it may also read all else, use the network and start programs
    account: SystemAccount | None


def main(order: Order, line: Connection) -> None:
    """Run one order."""
    _print_to(order.folder / PRINTED)
    tasks = importlib.import_module(order.module)  # our own code, not readable after this
    _save_nothing_compiled()
    vars(files)["replacing"] = _in_place
    _contain(order)
    if order.reads is not None:
        if order.account is not None:
            os.umask(0o007)  # the worker reads its files as a member of its group
        confine.confine(order.folder, order.reads, order.account)
    # no thread before this line: it would keep the permissions that the others gave up
    threading.Thread(target=_end_with_parent, args=(line,), daemon=True).start()
    last = 0.0

    def progress(done: int, total: int) -> None:
        nonlocal last
        if done >= total or time.monotonic() - last > _PROGRESS_S:
            last = time.monotonic()
            _tell(line, done=int(done), total=int(total))

    function: Task = tasks.TASKS[order.task]
    try:
        result = json.dumps(function(json.loads(order.arguments), order.folder, progress), allow_nan=False)
        (order.folder / RESULT).write_text(result, encoding="utf-8")
        _tell(line, end="ok")
    except LensModelError as error:
        _tell(line, end="error", code=error.code, text=str(error))
    except Exception as error:  # noqa: BLE001 - the parent must learn of any failure
        number = errno.ENOMEM if isinstance(error, MemoryError) else getattr(error, "errno", None)
        end = _ENDINGS.get(number, "bug")
        _tell(line, end=end, code=type(error).__name__, text=traceback.format_exc())
    finally:
        with contextlib.suppress(OSError):  # what it printed is not worth an outcome
            sys.stdout.flush()


def _print_to(path: Path) -> None:
    """Lead standard output and error to a file; to nothing where the disk is full."""
    try:
        printed = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    except OSError:
        printed = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(printed, stream)
    os.close(printed)


@contextlib.contextmanager
def _in_place(path: Path) -> Iterator[Path]:
    """Write a file in place: a task may rename nothing, and its folder is read at its end."""
    yield path


def _save_nothing_compiled() -> None:
    """Let Numba load compiled code and save none: a task writes to nothing but its own folder."""
    with contextlib.suppress(ImportError):
        caching = importlib.import_module("numba.core.caching")
        # Numba has no public way: the one tries to write, the other writes
        caching._CacheLocator.ensure_cache_path = lambda _: None  # noqa: SLF001
        caching.FunctionCache.save_overload = lambda *_: None


def clean_environment() -> dict[str, str]:
    """Return the part of the environment that a child needs: no address, no password, no key."""
    kept = {name: os.environ[name] for name in _KEPT_ENVIRONMENT if name in os.environ}
    return {**kept, "PATH": os.defpath, **dict.fromkeys(_ONE_THREAD, "1")}


def _contain(order: Order) -> None:
    """Give up for good what a task does not need."""
    limits, folder = order.limits, str(order.folder)
    with contextlib.suppress(OSError):
        os.setsid()  # Ctrl-C at the terminal reaches only the parent; a kill reaches the whole group
    give_way(order.niceness)
    os.umask(0o077)
    os.chdir(folder)
    kept = clean_environment()
    os.environ.clear()
    os.environ.update(kept, HOME=folder, TMPDIR=folder)
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_NOFILE, limits.open_files)
    _limit(resource.RLIMIT_FSIZE, limits.file_mb * _MIB)
    _limit(resource.RLIMIT_CPU, limits.processor_s, slack=2)
    if sys.platform != "darwin":  # which accepts the limit and ignores it
        # from the address space that the process has already: libraries and thread stacks are not the task's
        _limit(resource.RLIMIT_AS, _address_space() + limits.memory_mb * _MIB)


def give_way(niceness: int) -> None:
    """Lower the priority of a task below that of requests, which take milliseconds rather than minutes."""
    # Where the kernel schedules by sessions (autogroup, sched(7)), a nice value counts only within a session,
    # and a task has a session of its own; so the session gets the same value
    with contextlib.suppress(OSError):
        os.nice(niceness)
        Path("/proc/self/autogroup").write_text(str(niceness), encoding="ascii")


def _limit(which: int, value: int, slack: int = 0) -> None:
    hard = resource.getrlimit(which)[1]
    top = value + slack if hard == resource.RLIM_INFINITY else min(value + slack, hard)
    resource.setrlimit(which, (min(value, top), top))


def _address_space() -> int:
    try:
        pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    except OSError:
        return 1024 * _MIB
    return pages * resource.getpagesize()


def _end_with_parent(line: Connection) -> None:
    """Exit when the parent's end of the connection closes, however the parent ended."""
    with contextlib.suppress(OSError, EOFError):
        line.recv_bytes()
    os._exit(70)


def _tell(line: Connection, **message: object) -> None:
    if "text" in message:
        message["text"] = str(message["text"])[-MAX_TEXT:]
    try:
        line.send_bytes(json.dumps(message).encode())
    except OSError:
        os._exit(70)  # the parent is gone
