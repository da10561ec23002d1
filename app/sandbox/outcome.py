"""Limits of a child process, and its outcome from the way it ended."""

from __future__ import annotations

import json
import logging
import signal
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, Literal, TypeAlias

from app.sandbox import child

log = logging.getLogger(__name__)

Ending: TypeAlias = Literal["ok", "error", "memory_limit", "time_limit", "outage", "crashed", "cancelled"]

MAX_RESULT: Final = 16 * 1024 * 1024
"""Bytes of JSON that are read from a task at most (chosen): far more than any returns, arrays are files."""


@dataclass(frozen=True, slots=True)
class TaskLimits:
    """Resources that one task may use.

    Parameters
    ----------
    memory_mb : int
        Address space in MiB beyond that of the program itself; mapped files count.
    wall_s : float
        Seconds until it is killed.
    cpu_s : int or None
        Seconds of processor time; by default a little more than `wall_s`.
    file_mb : int
        Largest file it may write, in MiB.
    scratch_mb : int
        All that lies in its folder, in MiB.
    files : int
        Files in its folder.
    open_files : int
        Files it may have open at once.
    """

    memory_mb: int
    wall_s: float
    cpu_s: int | None = None
    file_mb: int = 8192
    scratch_mb: int = 8192
    files: int = 10_000
    open_files: int = 256

    def with_memory(self, memory_mb: int) -> TaskLimits:
        """Return the same limits with another memory."""
        return replace(self, memory_mb=memory_mb)


@dataclass(frozen=True, slots=True)
class Outcome:
    """How a task ended.

    Parameters
    ----------
    ending : str
        `ok`, `error` (the library refused, with its reason), `memory_limit`, `time_limit`,
        `outage` (the machine had no room, or killed it), `crashed` (another signal, or an
        exception that nobody foresaw) or `cancelled`.
    value : object
        What the task returned.
    code, detail : str
        The fixed word and the sentence for whoever asked for the work.
    """

    ending: Ending
    value: Any = None
    code: str = ""
    detail: str = ""


def outcome_of(message: dict[str, Any] | None, status: int, folder: Path, limits: TaskLimits) -> Outcome:
    """Return the outcome from the last message of a child, if any, and its exit status (or -signal)."""
    ending = None if message is None else message.get("end")
    if ending == "ok" and status == 0:
        return _result(folder / child.RESULT)
    if ending in _OUTCOMES:
        code, text = (str((message or {}).get(key, "")) for key in ("code", "text"))
        return _OUTCOMES[ending](code, text, limits)
    if -status == signal.SIGXCPU:
        detail = f"took more than {limits.cpu_s or limits.wall_s:g} s of processor time; give a smaller photo"
        return Outcome("time_limit", code="time_limit", detail=detail)
    why = f"signal {-status} ({_signal_name(-status)})" if status < 0 else f"exit status {status}"
    detail = f"the process that did the work died: {why}"
    if -status == signal.SIGKILL:  # not by itself nor by us: by the kernel, out of memory
        return Outcome("outage", code="outage", detail=detail)
    return Outcome("crashed", code="crashed", detail=detail)


def _refused(code: str, text: str, limits: TaskLimits) -> Outcome:
    del limits
    return Outcome("error", code=code, detail=text)


def _swollen(code: str, text: str, limits: TaskLimits) -> Outcome:
    del code, text
    detail = f"needs more than the {limits.memory_mb} MiB it may take; give a smaller photo"
    return Outcome("memory_limit", code="memory_limit", detail=detail)


def _no_room(code: str, text: str, limits: TaskLimits) -> Outcome:
    del code, text, limits
    return Outcome("outage", code="outage", detail="there is no room on the disk for the work")


def _bug(code: str, text: str, limits: TaskLimits) -> Outcome:
    del limits
    log.error("unforeseen %s in a task:\n%s", code, text)
    why = f"an unforeseen {code} stopped the work; the log of the worker says where"
    return Outcome("crashed", code="internal_error", detail=why)


_OUTCOMES: Final[Mapping[object, Callable[[str, str, TaskLimits], Outcome]]] = {
    "error": _refused,
    "memory_limit": _swollen,
    "no_room": _no_room,
    "bug": _bug,
}
"""Outcomes by the `end` of the last message of a child."""


def _result(path: Path) -> Outcome:
    if path.stat().st_size > MAX_RESULT:
        return Outcome("crashed", code="internal_error", detail="the task returned more than may be read")
    return Outcome("ok", value=json.loads(path.read_text(encoding="utf-8")))


def _signal_name(number: int) -> str:
    try:
        return signal.Signals(number).name
    except ValueError:
        return "unknown"


def cancelled() -> Outcome:
    """Return the outcome of a task whose result is no longer wanted."""
    return Outcome("cancelled", code="cancelled", detail="the work was cancelled")
