"""The code of a child process: confine it, run one task, report how it ended; and what its end means.

This module is what a fresh child imports first, so it imports next to nothing itself.
"""

from __future__ import annotations

import contextlib
import errno
import importlib
import json
import math
import multiprocessing
import os
import resource
import shutil
import signal
import struct
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

from app.sandbox import confine
from app.sandbox.account import SystemAccount
from lensmodel.core import files
from lensmodel.core.errors import LensModelError

Ending: TypeAlias = Literal["ok", "error", "memory_limit", "time_limit", "outage", "crashed", "cancelled"]
ProgressHook: TypeAlias = Callable[[int, int], None]
# Called as `task(arguments, folder, progress)`; returns what JSON can write
Task: TypeAlias = Callable[[dict[str, Any], Path, ProgressHook], Any]
REPORT: Final = "result.json"  # file in which a child reports how its task ended, and what it returned
# Bytes of JSON that are read from a task at most (chosen): far more than any returns, arrays are files
MAX_RESULT: Final = 16 * 1024 * 1024
# Characters of an error's code and text at most (chosen): those of the library have a line or two
MAX_CODE: Final = 100
MAX_TEXT: Final = 4000
# Free bytes of a disk that counts as full (chosen): a write of a few MiB may fail where so much is left
LEAST_ROOM: Final = 4 << 20
PRINTED: Final = "printed"  # file of what a task printed
PROGRESS: Final = "progress"  # file of how far it came: `STEPS`, done and all
STEPS: Final = struct.Struct("=ii")
_MAX_OPEN: Final = 1 << 16  # more files than the fork server has open
_MIB: Final = 1024 * 1024  # bytes
_KEPT_ENVIRONMENT: Final = (
    *("LANG", "LC_ALL", "NUMBA_CACHE_DIR"),
    "TMPDIR",  # where the fork server listens; a task has a folder of its own instead
    *("PYTHONPATH", "PYTHONHASHSEED", "PYTHONDONTWRITEBYTECODE", "PYTHONWARNINGS"),
)
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
_FULL: Final = (errno.ENOSPC, errno.EDQUOT)
_TOO_LARGE: Final = (errno.EFBIG, errno.ENOMEM)


@dataclass(frozen=True, slots=True)
class TaskLimits:
    """Resources that one task may use."""

    memory_mb: int  # address space beyond that of the program itself; mapped files count
    wall_s: float
    cpu_s: int = 0  # 0: a little more than `wall_s`
    file_mb: int = 8192  # the largest file
    scratch_mb: int = 8192  # all that lies in its folder
    files: int = 10_000
    open_files: int = 256
    quick: bool = False  # whether it goes before others

    @property
    def processor_s(self) -> int:
        """Seconds of processor time."""
        return self.cpu_s or math.ceil(self.wall_s * 1.25) + 5


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended; `value` is what it returned, `code` and `detail` are for whoever asked for the work.

    `error`: the library refused, with its reason; `outage`: the machine lacked room or memory, which is
    looked up, not what the child says; `crashed`: a signal, or an exception that nobody foresaw.
    """

    ending: Ending
    value: Any = None
    code: str = ""
    detail: str = ""


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
            sys.exit(1)  # the worker looks for itself whether a disk is full
        if number not in _TOO_LARGE:
            traceback.print_exc()
        end = "memory_limit" if number in _TOO_LARGE else "bug"
        _report(order.folder, end=end, code=type(error).__name__)
    finally:
        _print_the_rest()


def _report(folder: Path, **report: object) -> None:
    (folder / REPORT).write_text(json.dumps(report, allow_nan=False), encoding="utf-8")


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


def ended(ending: Ending, detail: str = "the work was cancelled") -> Outcome:
    """Return an outcome whose code is how it ended."""
    return Outcome(ending, code=ending, detail=detail)


def outcome_of(status: int, folder: Path, limits: TaskLimits, *, out_of_memory: bool = False) -> Outcome:
    """Return the outcome of a child from its exit status (or -signal) and the report in its folder."""
    # `out_of_memory`: whether the kernel has killed something for want of it meanwhile
    if -status == signal.SIGXCPU:
        text = f"took more than {limits.processor_s} s of processor time; give a smaller photo"
        return ended("time_limit", text)
    report = {} if status else _read_report(folder / REPORT)
    code, text = _text(report.get("code", ""), MAX_CODE), _text(report.get("text", ""), MAX_TEXT)
    match report.get("end"):
        case "ok":
            return Outcome("ok", value=report.get("value"))
        case "error":
            return Outcome("error", code=code, detail=text)
        case "memory_limit":
            return ended("memory_limit", f"needs more than {limits.memory_mb} MiB: give a smaller photo")
        case _:
            out_of_memory &= -status == signal.SIGKILL
            return _broken_off(status, folder, code or "end", out_of_memory=out_of_memory)


def _broken_off(status: int, folder: Path, code: str, *, out_of_memory: bool) -> Outcome:
    if shutil.disk_usage(folder).free < LEAST_ROOM:
        return ended("outage", "there is no room on the disk for the work")
    if out_of_memory:
        return ended("outage", "the machine has no memory for the work")
    if not status:
        why = f"an unforeseen {code} stopped the work; the log of the worker says where"
        return Outcome("crashed", code="internal_error", detail=why)
    name = next((known.name for known in signal.Signals if known == -status), "unknown")
    how = f"signal {-status} ({name})" if status < 0 else f"exit status {status}"
    return ended("crashed", f"the process that did the work died: {how}")


def _text(value: object, most: int) -> str:
    """Return a text as a database can hold it: without parts of characters, and without zeros."""
    return str(value)[:most].encode(errors="replace").decode().replace("\0", "")


def _read_report(path: Path) -> dict[str, Any]:
    """Read the report of a child as untrusted: nothing where it is no JSON object, or too large."""
    try:
        report = json.loads(path.read_text(encoding="utf-8")) if path.stat().st_size <= MAX_RESULT else None
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}
