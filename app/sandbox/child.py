"""The code of a child process: confine it, run one task, report how it ended.

This module is what a fresh child imports first, so it imports next to nothing itself.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import multiprocessing
import os
import resource
import struct
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, TypeAlias

from app.sandbox import confine
from app.sandbox.account import SystemAccount
from app.sandbox.outcome import MAX_TEXT, NO_ROOM, REPORT, TaskLimits
from lensmodel.core import files
from lensmodel.core.errors import LensModelError

ProgressHook: TypeAlias = Callable[[int, int], None]
# Called as `task(arguments, folder, progress)`; returns what JSON can write
Task: TypeAlias = Callable[[dict[str, Any], Path, ProgressHook], Any]
PRINTED: Final = "printed"  # file of what a task printed
PROGRESS: Final = "progress"  # file of how far it came: `STEPS`, done and all
STEPS: Final = struct.Struct("=ii")
_MAX_OPEN: Final = 1 << 16  # more files than the fork server has open
_MIB: Final = 1024 * 1024  # bytes
# Default niceness of tasks above that of the worker (chosen): a tenth of the weight of one at 0, see sched(7)
NICENESS: Final = 10
_KEPT_ENVIRONMENT: Final = (
    *("LANG", "LC_ALL", "NUMBA_CACHE_DIR"),
    "TMPDIR",  # where the fork server listens; a task has a folder of its own instead
    *("PYTHONPATH", "PYTHONHASHSEED", "PYTHONDONTWRITEBYTECODE", "PYTHONWARNINGS"),
)
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_TOO_LARGE: Final = (errno.EFBIG, errno.ENOMEM)


@dataclass(frozen=True, slots=True)
class Order:
    """What a child is to do, and what it may do meanwhile."""

    module: str
    task: str
    arguments: str  # JSON
    folder: Path
    limits: TaskLimits
    niceness: int
    reads: tuple[Path, ...]
    account: SystemAccount | None


def main(order: Order) -> None:
    """Run one order."""
    _close_others()
    _print_to(order.folder / PRINTED)
    tasks: Mapping[str, Task] = importlib.import_module(order.module).TASKS  # not readable after this
    _save_nothing_compiled()
    vars(files)["replacing"] = _in_place
    steps = os.open(order.folder / PROGRESS, os.O_WRONLY)
    _contain(order)
    if order.account is not None:
        os.umask(0o007)  # the worker reads its files as a member of its group
    confine.confine(order.folder, order.reads, order.account)
    # no thread before this line: it would keep the permissions that the others gave up
    threading.Thread(target=_end_with_parent, daemon=True).start()

    def progress(done: int, total: int) -> None:
        os.pwrite(steps, STEPS.pack(done, total), 0)

    try:
        value = tasks[order.task](json.loads(order.arguments), order.folder, progress)
        _report(order.folder, end="ok", value=value)
    except LensModelError as error:
        _report(order.folder, end="error", code=error.code, text=str(error)[-MAX_TEXT:])
    except Exception as error:  # noqa: BLE001 - the parent must learn of any failure
        number = errno.ENOMEM if isinstance(error, MemoryError) else getattr(error, "errno", None)
        if number in _FULL:
            sys.exit(NO_ROOM)
        if number not in _TOO_LARGE:
            traceback.print_exc()
        end = "memory_limit" if number in _TOO_LARGE else "bug"
        _report(order.folder, end=end, code=type(error).__name__)
    finally:
        _print_the_rest()


def _report(folder: Path, **report: object) -> None:
    """Report how a task ended; by the exit status where even that does not fit."""
    text = json.dumps(report, allow_nan=False)
    try:
        (folder / REPORT).write_text(text, encoding="utf-8")
    except OSError:
        sys.exit(NO_ROOM)


def _close_others() -> None:
    """Close what it has from the fork server but the pipe that ends with the parent: others depend on it."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    for first, end in ((3, parent.sentinel), (parent.sentinel + 1, _MAX_OPEN)):
        os.closerange(first, end)


def _print_to(path: Path) -> None:
    """Lead standard output and error to a file; to nothing where the disk is full."""
    try:
        printed = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600)
    except OSError:
        printed = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):
        os.dup2(printed, stream)
    os.close(printed)


def _print_the_rest() -> None:
    """Write what a task printed; where that does not fit it is dropped, since it is not worth an outcome."""
    for name in ("stdout", "stderr"):
        try:
            getattr(sys, name).flush()
        except OSError:
            setattr(sys, name, None)  # else `multiprocessing` would try again, and fail


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


def _end_with_parent() -> None:
    """Exit when the parent ends, in whatever way."""
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(os.EX_SOFTWARE)
