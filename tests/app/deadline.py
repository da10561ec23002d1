"""Deadlines in seconds of an idle machine: longer, to a limit, where others use its processors too."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Final, TypeVar

MOST: Final = 7.0  # times as long at most (chosen): what hangs is told within half an hour, however busy
Found = TypeVar("Found")


def slowness() -> float:
    """How many processes share a processor, over the last minute; 1 on an idle machine."""
    return min(max(1.0, os.getloadavg()[0] / (os.cpu_count() or 1)), MOST)


def stretched(seconds: float) -> float:
    """Return as many seconds as the machine, busy as it is now, takes for those of an idle one."""
    return seconds * slowness()


class Deadline:
    """Some seconds of an idle machine from now, counted slower while it is busy."""

    def __init__(self, seconds: float) -> None:
        self._left, self._asked = seconds, time.monotonic()

    def passed(self) -> bool:
        """Say whether they are over; to be asked again and again."""
        now = time.monotonic()
        self._left -= (now - self._asked) / slowness()
        self._asked = now
        return self._left <= 0.0


def until(condition: Callable[[], Found], log: Path | None = None, within_s: float = 180.0) -> Found:
    """Wait for something, for some seconds of an idle machine; return it. Else show the end of a log."""
    deadline = Deadline(within_s)
    while not (found := condition()):
        assert not deadline.passed(), "it never happened" if log is None else log.read_text()[-4000:]
        time.sleep(0.05)
    return found
