"""Limits of a child process, and its outcome from the way it ended."""

from __future__ import annotations

import json
import logging
import math
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

log = logging.getLogger(__name__)

Ending: TypeAlias = Literal["ok", "error", "memory_limit", "time_limit", "outage", "crashed", "cancelled"]
RESULT: Final = "result.json"  # file of what a task returned
# Bytes of JSON that are read from a task at most (chosen): far more than any returns, arrays are files
MAX_RESULT: Final = 16 * 1024 * 1024


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

    @property
    def processor_s(self) -> int:
        """Seconds of processor time."""
        return self.cpu_s or math.ceil(self.wall_s * 1.25) + 5


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended; `value` is what it returned, `code` and `detail` are for whoever asked for the work.

    `error`: the library refused, with its reason; `outage`: the machine had no room, or killed it; `crashed`:
    another signal, or an exception that nobody foresaw.
    """

    ending: Ending
    value: Any = None
    code: str = ""
    detail: str = ""


def outcome_of(message: dict[str, Any], status: int, folder: Path, limits: TaskLimits) -> Outcome:
    """Return the outcome from the last message of a child, if any, and its exit status (or -signal)."""
    code, text = (str(message.get(key, "")) for key in ("code", "text"))
    match message.get("end"):
        case "ok" if status == 0:
            outcome = _result(folder / RESULT)
        case "error":
            outcome = Outcome("error", code=code, detail=text)
        case "memory_limit":
            outcome = ended("memory_limit", f"needs more than {limits.memory_mb} MiB: give a smaller photo")
        case "no_room":
            outcome = ended("outage", "there is no room on the disk for the work")
        case "bug":
            log.error("unforeseen %s in a task:\n%s", code, text)
            why = f"an unforeseen {code} stopped the work; the log of the worker says where"
            outcome = Outcome("crashed", code="internal_error", detail=why)
        case _:
            outcome = _died(status, limits)
    return outcome


def _died(status: int, limits: TaskLimits) -> Outcome:
    """Return the outcome of a child that could not say how it ended."""
    if -status == signal.SIGXCPU:
        text = f"took more than {limits.processor_s} s of processor time; give a smaller photo"
        return ended("time_limit", text)
    name = next((known.name for known in signal.Signals if known == -status), "unknown")
    how = f"signal {-status} ({name})" if status < 0 else f"exit status {status}"
    # SIGKILL comes not from the task nor from us, but from the kernel, out of memory
    died: Ending = "outage" if -status == signal.SIGKILL else "crashed"
    return ended(died, f"the process that did the work died: {how}")


def ended(ending: Ending, detail: str = "the work was cancelled") -> Outcome:
    """Return an outcome whose code is how it ended."""
    return Outcome(ending, code=ending, detail=detail)


def _result(path: Path) -> Outcome:
    if path.stat().st_size > MAX_RESULT:
        return Outcome("crashed", code="internal_error", detail="the task returned more than may be read")
    return Outcome("ok", value=json.loads(path.read_text(encoding="utf-8")))
