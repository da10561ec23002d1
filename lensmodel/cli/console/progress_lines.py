"""Progress as bars and as plain lines, and when a time left can be told."""

from __future__ import annotations

import time
from bisect import bisect_right
from collections.abc import Callable
from typing import Any, Final

import typer
from rich.progress import Progress, ProgressColumn, Task, TaskID
from rich.text import Text

EVERY_S: Final = 10.0
"""At most one line in so many seconds (chosen): a night's log stays readable, and quick commands silent."""

SURE_AFTER_S: Final = 4.0  # of work (chosen): before, what is read and compiled once hides the pace
AGREE: Final = 2.0
"""Ratio of the paces of the earlier and the later half of the time from which on nothing is told: one of them
is wrong by as much."""

LEAST_SHARE, LEAST_COUNT = 0.05, 3.0
"""Of a task, whichever comes first, before its pace is believed (chosen): of one photo what comes before its
tiles, of many the first ones."""

_MARKS: Final = 512  # of a task's past (chosen): enough to halve any time


class Pace:
    """What the past of a task tells of its time left."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._done: list[float] = []
        self._total: float | None = None

    def mark(self, now: float, done: float, total: float | None) -> None:
        """Take note of how far a task is; a new count begins where it falls, or its total changes."""
        if self._done and (done < self._done[-1] or total != self._total):
            self._times.clear()
            self._done.clear()
        self._total = total
        if self._done and done == self._done[-1]:
            return
        self._times.append(now)
        self._done.append(done)
        if len(self._times) > _MARKS:
            del self._times[1:-1:2], self._done[1:-1:2]

    def left(self, now: float) -> float | None:
        """Seconds left; None before both halves of the time agree on the pace within a factor of two."""
        if not self._total or not self._times or now - self._times[0] < SURE_AFTER_S:
            return None
        start, end, first, last = self._times[0], self._times[-1], self._done[0], self._done[-1]
        middle = self._done[bisect_right(self._times, (start + end) / 2.0) - 1]
        earlier, later = middle - first, last - middle
        if last < min(LEAST_SHARE * self._total, LEAST_COUNT) or min(earlier, later) <= 0.0:
            return None
        if max(earlier, later) > AGREE * min(earlier, later):
            return None
        return max((end - start) * (self._total - last) / (last - first) - (now - end), 0.0)


class TimeLeft(ProgressColumn):
    """Column of a bar: the time left, once it can be told."""

    max_refresh = 0.5

    def __init__(self) -> None:
        super().__init__()
        self._paces: dict[TaskID, Pace] = {}

    def render(self, task: Task) -> Text:
        """Return the text of a task."""
        pace, now = self._paces.setdefault(task.id, Pace()), task.get_time()
        pace.mark(now, task.completed, task.total)
        left = pace.left(now)
        return Text("" if left is None else f"ETA {clock(left)}")


class ProgressLines(Progress):
    """Stands in for bars: keeps count of tasks as they do, and prints a line now and then."""

    def __init__(self, say: Callable[[str], None] | None = None, *, every_s: float = EVERY_S) -> None:
        super().__init__(disable=True)
        self._say = say or _to_standard_error
        self._every_s = every_s
        self._began = self._last = time.monotonic()
        self._paces: dict[TaskID, Pace] = {}

    def update(self, task_id: TaskID, **changes: Any) -> None:  # noqa: ANN401 - as there
        """Change a task as `Progress.update` does; tell it if it is time."""
        super().update(task_id, **changes)
        now, task = time.monotonic(), self._tasks[task_id]
        pace = self._paces.setdefault(task_id, Pace())
        pace.mark(now, task.completed, task.total)
        if now - self._last >= self._every_s:
            self._last = now
            self._say(line(task, now - self._began, pace.left(now)))


def line(task: Task, seconds: float, left: float | None) -> str:
    """Say how far a task is: time since the start, share, what is in work, time left if it can be told."""
    done = f" {task.percentage:3.0f} %" if task.total else ""
    ahead = "" if left is None else f", about {clock(left)} left"
    return f"[{clock(seconds)}]{done} {task.description or 'working'}{ahead}"


def clock(seconds: float) -> str:
    """Write a time as 4:07, or 1:04:07 from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _to_standard_error(text: str) -> None:
    typer.echo(text, err=True)
