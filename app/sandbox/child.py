"""The code of a child process: confine it, run one task, report how it ended.

This module is what a fresh child imports first, so it imports next to nothing itself.
"""

from __future__ import annotations

import contextlib
import ctypes
import errno
import importlib
import json
import os
import resource
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import forkserver
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeAlias

from app.sandbox import confine
from app.sandbox.account import SystemAccount
from lensmodel.core import files
from lensmodel.core.errors import LensModelError

ProgressHook: TypeAlias = Callable[[int, int], None]
# Called as `task(arguments, folder, progress)`; returns what JSON can write
Task: TypeAlias = Callable[[dict[str, Any], Path, ProgressHook], Any]
RESULT: Final = "result.json"
# Characters of an error text at most (chosen): a traceback in less than `runner.MAX_MESSAGE` bytes
MAX_TEXT: Final = 4000
_MIB: Final = 1024 * 1024  # bytes
# Default niceness of tasks above that of the worker (chosen): a tenth of the weight of one at 0, see sched(7)
NICENESS: Final = 10
# Seconds between two messages of progress (chosen): a bar that moves, and hardly any work for the parent
_PROGRESS_S: Final = 0.1
_PR_SET_PDEATHSIG: Final = 1  # of linux/prctl.h
_KEPT_ENVIRONMENT: Final = (
    *("LANG", "LC_ALL", "NUMBA_CACHE_DIR", "SYSTEMROOT"),
    "TMPDIR",  # where the fork server listens; a task has a folder of its own instead
    *("PYTHONPATH", "PYTHONHASHSEED", "PYTHONDONTWRITEBYTECODE", "PYTHONWARNINGS"),
)
_ONE_THREAD: Final = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")


def main(order: dict[str, Any], line: Connection, said: Connection) -> None:
    """Run one order: `module`, `task`, `arguments` (JSON), `folder`, `limits`, `niceness`, permissions."""
    # `reads` are files and folders that it may read; None leaves the file system, the network and other
    # programs open to it. `account` is the uid and gid that it changes to, if any. What it prints goes to
    # `said`.
    for stream in (1, 2):
        os.dup2(said.fileno(), stream)
    said.close()
    folder = Path(order["folder"])
    tasks = importlib.import_module(order["module"])  # our own code, not readable after this
    _save_nothing_compiled()
    _write_in_place()
    contain(folder, order["limits"], order["niceness"])
    if order["reads"] is not None:
        _confine(folder, order)
    # no thread before this line: it would keep the permissions that the others gave up
    threading.Thread(target=_end_with_parent, args=(line,), daemon=True).start()
    last = 0.0

    def progress(done: int, total: int) -> None:
        nonlocal last
        if done >= total or time.monotonic() - last > _PROGRESS_S:
            last = time.monotonic()
            _tell(line, done=int(done), total=int(total))

    function: Task = tasks.TASKS[order["task"]]
    _report(line, folder, lambda: function(json.loads(order["arguments"]), folder, progress))


def _report(line: Connection, folder: Path, work: Callable[[], Any]) -> None:
    """Do the work, write what it returns to a file, and tell how it ended."""
    try:
        (folder / RESULT).write_text(json.dumps(work(), allow_nan=False), encoding="utf-8")
        _tell(line, end="ok")
    except LensModelError as error:
        _tell(line, end="error", code=error.code, text=str(error))
    except MemoryError:
        _tell(line, end="memory_limit")
    except OSError as error:
        if error.errno in {errno.ENOSPC, errno.EDQUOT}:
            _tell(line, end="no_room")
        elif error.errno in {errno.EFBIG, errno.ENOMEM}:
            _tell(line, end="memory_limit")
        else:
            _tell(line, end="bug", code=type(error).__name__, text=_last_lines())
    except Exception as error:  # noqa: BLE001 - the parent must learn of any failure
        _tell(line, end="bug", code=type(error).__name__, text=_last_lines())
    finally:
        sys.stdout.flush()
        sys.stderr.flush()


def _write_in_place() -> None:
    """Let the library write files in place: a task may rename nothing, and its folder is read at its end."""

    @contextlib.contextmanager
    def in_place(path: Path) -> Iterator[Path]:
        yield path

    vars(files)["replacing"] = in_place


def _save_nothing_compiled() -> None:
    """Let Numba load compiled code and save none: a task writes to nothing but its own folder."""
    with contextlib.suppress(ImportError):
        caching = importlib.import_module("numba.core.caching")
        # Numba has no public way: the one tries to write, the other writes
        caching._CacheLocator.ensure_cache_path = lambda _: None  # noqa: SLF001
        caching.FunctionCache.save_overload = lambda *_: None


def _confine(folder: Path, order: dict[str, Any]) -> None:
    account = SystemAccount(*order["account"]) if order["account"] else None
    if account is not None:
        os.umask(0o007)  # the worker reads its files as a member of its group
    confine.confine(folder, map(Path, order["reads"]), account)
    _die_with_parent()  # again: the kernel clears it when credentials change


def clean_environment() -> dict[str, str]:
    """Return the part of the environment that a child needs: no address, no password, no key."""
    kept = {name: os.environ[name] for name in _KEPT_ENVIRONMENT if name in os.environ}
    return {**kept, "PATH": os.defpath, **dict.fromkeys(_ONE_THREAD, "1")}


def contain(folder: Path, limits: dict[str, int], niceness: int) -> None:
    """Give up for good what a task does not need."""
    # The memory limit counts from the address space that the process has already: libraries and thread stacks
    # of the program are not the task's
    _close_fork_server_line()
    with contextlib.suppress(OSError):
        os.setsid()  # Ctrl-C at the terminal reaches only the parent; a kill reaches the whole group
    give_way(niceness)
    _die_with_parent()
    os.umask(0o077)
    os.chdir(folder)
    kept = clean_environment()
    os.environ.clear()
    os.environ.update(kept, HOME=str(folder), TMPDIR=str(folder))
    _limit(resource.RLIMIT_CORE, 0)
    _limit(resource.RLIMIT_NOFILE, limits["open_files"])
    _limit(resource.RLIMIT_FSIZE, limits["file_mb"] * _MIB)
    _limit(resource.RLIMIT_CPU, limits["cpu_s"], slack=2)
    if sys.platform != "darwin":  # which accepts the limit and ignores it
        _limit(resource.RLIMIT_AS, _address_space() + limits["memory_mb"] * _MIB)


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


def _close_fork_server_line() -> None:
    """Close the pipe by which the fork server notices that its parent has ended."""
    # Every child inherits it, so that the server would outlive a killed parent for as long as one child runs.
    # Closed here, the server ends with the parent, and its end kills the children.
    server = getattr(forkserver, "_forkserver", None)
    inherited = getattr(server, "_forkserver_alive_fd", None)
    if server is not None and inherited is not None:
        server._forkserver_alive_fd = None  # noqa: SLF001 - there is no public way
        os.close(inherited)


def _die_with_parent() -> None:
    if sys.platform == "linux":
        parent = os.getppid()
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        if os.getppid() != parent:
            os._exit(70)  # the parent died before prctl took effect


def _end_with_parent(line: Connection) -> None:
    """Exit when the parent's end of the connection closes: portable, unlike PR_SET_PDEATHSIG."""
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


def _last_lines() -> str:
    return traceback.format_exc()[-MAX_TEXT:]
