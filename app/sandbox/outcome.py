"""Limits of a child process, and its outcome from the way it ended."""

from __future__ import annotations

import json
import math
import os
import signal
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

Ending: TypeAlias = Literal["ok", "error", "memory_limit", "time_limit", "outage", "crashed", "cancelled"]
REPORT: Final = "result.json"  # file in which a child reports how its task ended, and what it returned
# Bytes of JSON that are read from a task at most (chosen): far more than any returns, arrays are files
MAX_RESULT: Final = 16 * 1024 * 1024
# Characters of an error's code and text at most (chosen): those of the library have a line or two
MAX_CODE: Final = 100
MAX_TEXT: Final = 4000
NO_ROOM: Final = os.EX_TEMPFAIL  # exit status of a child that could not write, its report included


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


def ended(ending: Ending, detail: str = "the work was cancelled") -> Outcome:
    """Return an outcome whose code is how it ended."""
    return Outcome(ending, code=ending, detail=detail)


def outcome_of(status: int, folder: Path, limits: TaskLimits) -> Outcome:
    """Return the outcome of a child from its exit status (or -signal) and the report in its folder."""
    if status:
        return _died(status, limits)
    report = _report(folder / REPORT)
    code, text = _text(report.get("code", ""), MAX_CODE), _text(report.get("text", ""), MAX_TEXT)
    match report.get("end"):
        case "ok":
            return Outcome("ok", value=report.get("value"))
        case "error":
            return Outcome("error", code=code, detail=text)
        case "memory_limit":
            return ended("memory_limit", f"needs more than {limits.memory_mb} MiB: give a smaller photo")
        case _:
            why = f"an unforeseen {code or 'end'} stopped the work; the log of the worker says where"
            return Outcome("crashed", code="internal_error", detail=why)


def _died(status: int, limits: TaskLimits) -> Outcome:
    """Return the outcome of a child that could not report."""
    if status == NO_ROOM:
        return ended("outage", "there is no room on the disk for the work")
    if -status == signal.SIGXCPU:
        text = f"took more than {limits.processor_s} s of processor time; give a smaller photo"
        return ended("time_limit", text)
    name = next((known.name for known in signal.Signals if known == -status), "unknown")
    how = f"signal {-status} ({name})" if status < 0 else f"exit status {status}"
    # SIGKILL comes not from the task nor from us, but from the kernel, out of memory
    killed = -status == signal.SIGKILL
    return ended("outage" if killed else "crashed", f"the process that did the work died: {how}")


def _text(value: object, most: int) -> str:
    """Return a text as a database can hold it: without parts of characters, and without zeros."""
    return str(value)[:most].encode(errors="replace").decode().replace("\0", "")


def _report(path: Path) -> dict[str, Any]:
    """Read the report of a child as untrusted: nothing where it is no JSON object, or too large."""
    try:
        report = json.loads(path.read_text(encoding="utf-8")) if path.stat().st_size <= MAX_RESULT else None
    except (OSError, ValueError, RecursionError):
        return {}
    return report if isinstance(report, dict) else {}
