"""Run one task in a confined child process, and report how it ended.

Photos come from anywhere, and the libraries that decode them are large. So each piece of work
runs in a child of a fork server: limited in memory, processor time, wall time, file size and
open files, without the service's environment, killed when the result is no longer wanted
or the parent is gone. What comes back is JSON and files, never a pickle: a child that was
taken over by a hostile file cannot run code in its parent; nor, where the kernel has the means of
`app.sandbox.confine`, read what is not its task's, reach a network, or start a program.
"""

from __future__ import annotations

import contextlib
import json
import logging
import multiprocessing
import os
import shutil
import signal
import stat
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import forkserver
from multiprocessing.connection import Connection, wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, Final

from app.sandbox import child
from app.sandbox.account import SystemAccount
from app.sandbox.outcome import Outcome, TaskLimits, ended, outcome_of
from lensmodel.core.types import ignore_step

# Bytes of one message from a child at most (chosen): `child.MAX_TEXT` characters fit, escaped or not
MAX_MESSAGE: Final = 64 * 1024
MAX_NUMBER: Final = 2**31 - 1  # of an INTEGER column

TASKS_MODULE = "app.jobs.tasks"  # default module of the tasks; tests of the workers replace it
# Bytes of what a task printed that are logged at most (chosen): an honest one says a few lines
MAX_SAID: Final = 64 * 1024
log = logging.getLogger(__name__)


# Seconds between two questions whether a task is still wanted (chosen): each reads a row
POLL_S: Final = 0.25


class Budget:
    """Slots and memory that children share, first come, first served."""

    def __init__(self, slots: int, memory_mb: int) -> None:
        self._changed = threading.Condition()
        self._queue: deque[object] = deque()
        self._slots, self._memory = slots, memory_mb
        self.memory_mb = memory_mb

    @contextlib.contextmanager
    def share(self, memory_mb: int, wanted: Callable[[], bool]) -> Iterator[bool]:
        """Wait for a slot and memory; yield False if the task is no longer wanted."""
        # A task that needs more memory than the whole budget runs alone
        memory, ticket, entered = min(memory_mb, self.memory_mb), object(), False

        def is_next() -> bool:
            return self._queue[0] is ticket and self._slots > 0 and self._memory >= memory

        with self._changed:
            self._queue.append(ticket)
        try:
            while not entered and wanted():  # without the lock: it reads a row
                with self._changed:
                    entered = self._changed.wait_for(is_next, POLL_S)
                    self._slots -= entered
                    self._memory -= memory * entered
        finally:
            with self._changed:
                self._queue.remove(ticket)
                self._changed.notify_all()
        try:
            yield entered
        finally:
            with self._changed:
                self._slots += entered
                self._memory += memory * entered
                self._changed.notify_all()


class Sandbox:
    """Starts child processes, one for each task."""

    def __init__(
        self,
        scratch: Path,
        budget: Budget,
        *,
        module: str | None = None,
        preload: Sequence[str] | None = None,
        cache: Path | None = None,
        account: SystemAccount | None = None,
        niceness: int = child.NICENESS,
    ) -> None:
        self._niceness = niceness
        self.scratch, self.budget, self.account = scratch, budget, account
        self._confined = True
        configured = os.environ.get("NUMBA_CACHE_DIR")
        self.cache = Path(configured).resolve() if configured and self.account is None else cache
        self._module = module or TASKS_MODULE
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(["numpy", self._module] if preload is None else list(preload))
        self._alone = threading.Lock()  # the exit status of a child can be read only once
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True, mode=0o700)
        if self.cache is not None:
            self.cache.mkdir(parents=True, exist_ok=True)
        if self.account is not None:
            self.account.lets_through(scratch)
        self._serve()

    def _serve(self) -> None:
        """Start the fork server unless it runs: children inherit its environment, which holds no secret."""
        # The environment of the whole process changes meanwhile. So this is done once, before there are
        # threads, and again only after the server died.
        with self._alone:
            server = getattr(forkserver._forkserver, "_forkserver_pid", None)  # noqa: SLF001 - no public way
            if server is not None and _lives(server):
                return
            before, clean = dict(os.environ), child.clean_environment()
            if self.cache is not None:
                clean["NUMBA_CACHE_DIR"] = str(self.cache)
            os.environ.clear()
            os.environ.update(clean)
            try:
                forkserver.ensure_running()
            finally:
                os.environ.clear()
                os.environ.update(before)

    @contextlib.contextmanager
    def folder(self) -> Iterator[Path]:
        """Provide an empty folder for one task, removed afterwards."""
        path = Path(tempfile.mkdtemp(dir=self.scratch))
        if self.account is not None:
            self.account.lets_through(path)
        try:
            yield path
        finally:
            shutil.rmtree(path, ignore_errors=True)

    def run(
        self,
        task: str,
        arguments: Mapping[str, Any],
        *,
        folder: Path,
        limits: TaskLimits,
        reads: Sequence[Path] = (),
        wanted: Callable[[], bool] = lambda: True,
        on_progress: child.ProgressHook = ignore_step,
    ) -> Outcome:
        """Run one task to its end."""
        with self.budget.share(limits.memory_mb, wanted) as entered:
            if not entered:
                return ended("cancelled")
            reads = [*reads, *([] if self.cache is None else [self.cache])]
            if self.account is not None:
                self.account.may_change(folder)
                for path in reads:
                    self.account.may_read(path)
            order = child.Order(
                self._module,
                task,
                json.dumps(dict(arguments)),
                folder.resolve(),
                limits,
                self._niceness,
                tuple(path.resolve() for path in reads) if self._confined else None,
                self.account,
            )
            line, far_end = self._context.Pipe(duplex=True)
            process = self._context.Process(target=child.main, args=(order, far_end), daemon=True)
            self._serve()
            with line:
                with far_end, self._alone:
                    process.start()
                try:
                    outcome = self._watched(process, line, folder, limits, wanted, on_progress)
                finally:
                    self._end(process)
            _leave_plain_files(folder)
            _log_printed(task, folder / child.PRINTED)
            return outcome

    def _watched(
        self,
        process: ForkServerProcess,
        line: Connection,
        folder: Path,
        limits: TaskLimits,
        wanted: Callable[[], bool],
        on_progress: child.ProgressHook,
    ) -> Outcome:
        """Read messages until the child has ended, or must be killed."""
        last: dict[str, Any] = {}
        waiting: list[Any] = [line, process.sentinel]
        deadline, next_look = time.monotonic() + limits.wall_s, 0.0
        while True:
            ready = wait(waiting, timeout=POLL_S)
            if line in ready:
                message = _read(line)
                if message is None:
                    waiting.remove(line)
                elif "end" in message:
                    last = message
                else:
                    on_progress(_number(message.get("done")), _number(message.get("total")))
            elif ready:  # it has ended, and all messages are read
                with self._alone:
                    process.join()
                return outcome_of(last, process.exitcode or 0, folder, limits)
            if time.monotonic() > next_look:
                next_look = time.monotonic() + POLL_S
                if not wanted():
                    return ended("cancelled")
                if _overflows(folder, limits):
                    text = f"wrote more than {limits.scratch_mb} MiB or {limits.files} files"
                    return Outcome("error", code="memory_limit", detail=f"{text}; give a smaller photo")
            if time.monotonic() > deadline:
                text = f"stopped after {limits.wall_s:g} s; give a smaller photo or raise the time limit"
                return ended("time_limit", text)

    def _end(self, process: ForkServerProcess) -> None:
        """Kill the child and all processes that it started, if they still run."""
        assert process.pid is not None
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        with self._alone:
            if process.is_alive():
                process.kill()
            process.join()
            process.close()


def _number(value: object) -> int:
    """Return a number of a progress message as a column can hold it."""
    return min(max(value, 0), MAX_NUMBER) if isinstance(value, int) else 0


def _overflows(written: Path, limits: TaskLimits) -> bool:
    """Say whether a task has written more to its folder than it may, or hides what it wrote."""
    files = blocks = 0
    hidden: list[OSError] = []
    for place, folders, names in os.walk(written, onerror=hidden.append):
        for name in [*folders, *names]:
            with contextlib.suppress(OSError):  # gone meanwhile
                blocks += Path(place, name).lstat().st_blocks
            files += 1
            if files > limits.files or blocks * 512 > limits.scratch_mb << 20:
                return True
    return any(isinstance(error, PermissionError) for error in hidden)


def _leave_plain_files(folder: Path) -> None:
    """Remove all but plain files of a child: by a link we would read what the child could not."""
    for place, folders, files in os.walk(folder):
        for name in [*folders, *files]:
            path = Path(place, name)
            status = path.lstat()
            if stat.S_ISREG(status.st_mode) and status.st_nlink == 1:
                continue
            if not stat.S_ISDIR(status.st_mode):
                path.unlink()


def _log_printed(task: str, path: Path) -> None:
    """Log what a task printed line by line: the formatter lets no line look like a record of ours."""
    with contextlib.suppress(OSError):  # it died before it could print
        with path.open("rb") as file:
            text = file.read(MAX_SAID).decode("utf-8", "backslashreplace")
        for said in filter(None, text.split("\n")):
            log.info("task %s: %s", task, said)
        path.unlink()


def _lives(pid: int) -> bool:
    """Say whether a child process still runs, without reaping it."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
    except ChildProcessError:
        return False


def _read(line: Connection) -> dict[str, Any] | None:
    """Return the next message; None at the end of the connection, or if the message is invalid."""
    try:
        message = json.loads(line.recv_bytes(MAX_MESSAGE))
    except (EOFError, OSError, ValueError):
        return None
    return message if isinstance(message, dict) else None
