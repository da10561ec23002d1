"""Run one task in a confined child process, and report how it ended.

Photos come from anywhere, and the libraries that decode them are large: docs/service.md says what a child may
do. What comes back are files, JSON among them, never a pickle: a child that was taken over by a hostile file
cannot run code in its parent, nor keep it waiting.
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
from collections.abc import Callable, Iterator, Mapping, Sequence
from multiprocessing import forkserver
from multiprocessing.connection import wait
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any, BinaryIO, Final

from app.sandbox import child
from app.sandbox.account import SystemAccount, below
from app.sandbox.child import REPORT, Outcome, TaskLimits, ended, outcome_of
from lensmodel.core.types import ignore_step

TASKS_MODULE = "app.jobs.tasks"  # has `TASKS`; tests replace it
# Bytes of what a task printed that are logged at most (chosen): an honest one says a few lines
MAX_SAID: Final = 64 * 1024
log = logging.getLogger(__name__)
# Seconds between two looks at a child (chosen): each reads a row
POLL_S: Final = 0.25


class Budget:
    """Slots and memory that children share, first come, first served, and quick ones before others."""

    def __init__(self, slots: int, memory_mb: int) -> None:
        self._first, self._quick, self._changed = threading.Lock(), threading.Lock(), threading.Condition()
        self._slots, self._memory, self.memory_mb = slots, memory_mb, memory_mb

    @contextlib.contextmanager
    def share(self, memory_mb: int, wanted: Callable[[], bool], *, quick: bool = False) -> Iterator[bool]:
        """Wait for a slot and memory; yield False if the task is no longer wanted."""
        # A task that needs more memory than the whole budget runs alone
        memory, entered = min(memory_mb, self.memory_mb), False

        def fitting() -> bool:
            return self._slots > 0 and self._memory >= memory and (quick or not self._quick.locked())

        # one of each kind waits until there is enough for it, the others for their turn
        with self._quick if quick else self._first:
            while not entered and wanted():  # without the lock of the budget: it reads a row
                with self._changed:
                    entered = self._changed.wait_for(fitting, POLL_S)
                    self._take(entered, memory)
        try:
            yield entered
        finally:
            self._take(-entered, memory)

    def _take(self, slots: int, memory_mb: int) -> None:
        with self._changed:
            self._slots -= slots
            self._memory -= slots * memory_mb
            self._changed.notify_all()


class Sandbox:
    """Starts child processes, one for each task."""

    def __init__(
        self,
        scratch: Path,
        budget: Budget,
        *,
        cache: Path,
        account: SystemAccount | None = None,
        niceness: int = 10,
    ) -> None:
        self.scratch, self.budget, self.account, self._niceness = scratch, budget, account, niceness
        configured = os.environ.get("NUMBA_CACHE_DIR")
        self.cache = Path(configured).resolve() if configured and self.account is None else cache
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload([child.__name__, TASKS_MODULE])
        self._alone = threading.Lock()  # the exit status of a child can be read only once
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True, mode=0o700)
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
            os.environ.clear()
            os.environ.update(clean, NUMBA_CACHE_DIR=str(self.cache))
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
        with self.budget.share(limits.memory_mb, wanted, quick=limits.quick) as entered:
            if not entered:
                return ended("cancelled")
            reads = [*reads, self.cache]
            (folder / child.PROGRESS).write_bytes(child.STEPS.pack(0, 0))
            shutil.rmtree(folder / REPORT, ignore_errors=True)  # of a try before, which may be a folder
            (folder / REPORT).unlink(missing_ok=True)
            if self.account is not None:
                self.account.may_change(folder)
                for path in reads:
                    self.account.may_read(path)
            order = child.Order(
                TASKS_MODULE,
                task,
                json.dumps(dict(arguments)),
                folder.resolve(),
                limits,
                self._niceness,
                tuple(path.resolve() for path in reads),
                self.account,
            )
            process = self._context.Process(target=child.main, args=(order,), daemon=True)
            self._serve()
            killed = _killed_for_memory()
            with (folder / child.PROGRESS).open("rb", buffering=0) as steps:
                with self._alone:
                    process.start()
                try:
                    outcome = self._watched(process, order, steps, wanted, on_progress)
                finally:
                    status = self._end(process)
            _leave_plain_files(folder)
            out_of_memory = _killed_for_memory() != killed
            outcome = outcome or outcome_of(status, folder, limits, out_of_memory=out_of_memory)
            (folder / child.PROGRESS).unlink(missing_ok=True)
            _log_printed(task, folder / child.PRINTED, crashed=outcome.ending == "crashed")
            return outcome

    def _watched(
        self,
        process: ForkServerProcess,
        order: child.Order,
        steps: BinaryIO,
        wanted: Callable[[], bool],
        on_progress: child.ProgressHook,
    ) -> Outcome | None:
        """Wait until the child has ended; return the outcome of one that must be killed."""
        limits, last = order.limits, child.STEPS.pack(0, 0)
        deadline = time.monotonic() + limits.wall_s
        while True:
            ready = wait([process.sentinel], min(POLL_S, max(0.0, deadline - time.monotonic())))
            now = os.pread(steps.fileno(), child.STEPS.size, 0)
            if now != last and len(now) == child.STEPS.size:
                on_progress(*(max(0, count) for count in child.STEPS.unpack(now)))
                last = now
            if ready:
                return None
            if not wanted():
                return ended("cancelled")
            if _overflows(order.folder, limits):
                text = f"wrote more than {limits.scratch_mb} MiB or {limits.files} files"
                return Outcome("error", code="memory_limit", detail=f"{text}; give a smaller photo")
            if time.monotonic() > deadline:
                text = f"stopped after {limits.wall_s:g} s; give a smaller photo or raise the time limit"
                return ended("time_limit", text)

    def _end(self, process: ForkServerProcess) -> int:
        """Kill the child and all processes that it started, if they still run; return its exit status."""
        assert process.pid is not None
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(process.pid, signal.SIGKILL)
        with self._alone:
            if process.is_alive():
                process.kill()
            process.join()
            status = process.exitcode or 0
            process.close()
        return status


def _overflows(written: Path, limits: TaskLimits) -> bool:
    """Say whether a task has written more to its folder than it may, or hides what it wrote."""
    blocks, hidden = 0, list[OSError]()
    for files, path in enumerate(below(written, hidden.append), start=1):
        with contextlib.suppress(OSError):  # gone meanwhile
            blocks += path.lstat().st_blocks
        if files > limits.files or blocks * 512 > limits.scratch_mb << 20:
            return True
    return any(isinstance(error, PermissionError) for error in hidden)


def _leave_plain_files(folder: Path) -> None:
    """Remove all but plain files of a child: by a link we would read what the child could not."""
    for path in below(folder):
        status = path.lstat()
        plain = stat.S_ISREG(status.st_mode) and status.st_nlink == 1
        if not plain and not stat.S_ISDIR(status.st_mode):
            path.unlink()


def _log_printed(task: str, path: Path, *, crashed: bool) -> None:
    """Log the end of what a task printed as one record: the formatter lets no line look like another."""
    with contextlib.suppress(OSError):  # it died before it could print
        with path.open("rb") as file:
            file.seek(max(0, path.stat().st_size - MAX_SAID))
            text = file.read(MAX_SAID).decode("utf-8", "backslashreplace").strip("\n")
        if text:
            log.log(logging.ERROR if crashed else logging.INFO, "task %s printed:\n%s", task, text)
        path.unlink()


def _killed_for_memory() -> str:
    """Return how many processes the kernel has killed for want of memory; nothing where it does not count."""
    with contextlib.suppress(OSError):
        counts = Path("/proc/vmstat").read_text(encoding="ascii")
        return counts.partition("oom_kill ")[2].partition("\n")[0]
    return ""


def _lives(pid: int) -> bool:
    """Say whether a child process still runs, without reaping it."""
    try:
        return os.waitid(os.P_PID, pid, os.WEXITED | os.WNOHANG | os.WNOWAIT) is None
    except ChildProcessError:
        return False
