"""How a command ends when it cannot do what was asked, or is told to stop.

Ctrl-C and SIGTERM become an exception in the main thread, so that each `with` and `finally` on the way
removes what is unfinished. Worker processes are killed first: pools wait for what they began.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from types import FrameType
from typing import Final

from lensmodel.core.errors import InvalidInputError


class UsageError(InvalidInputError):
    """The command was called wrongly: nothing was begun; exit status 2."""


class InterruptedByUser(BaseException):
    """Ctrl-C or SIGTERM. Carries the number of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S: Final = 10.0  # Cleaning up takes far less; after this the process ends all the same


def workers_ignore_it() -> None:
    """In a worker process, leave Ctrl-C to the process of the command, which ends its workers."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def install() -> None:
    """Handle the signals in the process of the command."""
    for number in _SIGNALS:
        signal.signal(number, _stop)


def _stop(number: int, frame: FrameType | None) -> None:
    del frame
    for each in _SIGNALS:
        signal.signal(each, signal.SIG_IGN)  # cleaning up is not to be interrupted
    threading.Thread(target=_end_workers, args=(number,), daemon=True).start()
    raise InterruptedByUser(number)


def _end_workers(number: int) -> None:
    end = time.monotonic() + _PATIENCE_S
    while time.monotonic() < end:
        for child in multiprocessing.active_children():
            child.kill()
        time.sleep(0.05)
    os._exit(128 + number)


def reason(error: Exception) -> str:
    """Say why something could not be done and what helps; the system's errors in words."""
    if isinstance(error, OSError) and error.strerror:
        return f"{error.strerror[:1].lower()}{error.strerror[1:]}; check the path, its rights and the disk"
    return str(error)


def remedy(missing: ModuleNotFoundError) -> str | None:
    """Say what to install for a missing module; None where no extra brings it."""
    top = (missing.name or "").partition(".")[0]
    if top in {"app", "lab"}:
        where = " or in the container image" if top == "app" else ""
        return f"this command is no part of the package: it runs in the source tree{where}"
    extra = "report" if top == "matplotlib" else "service" if "app" in sys.modules else None
    return extra and f"{top} is not installed: pip install 'lensmodel[{extra}]'"
