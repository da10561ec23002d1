"""Progress as plain lines, where no terminal shows bars: in logs of cron jobs, pipes and build machines."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Final

import typer
from rich.progress import Progress, Task, TaskID

EVERY_S: Final = 10.0
"""At most one line in so many seconds (chosen): a night's log stays readable, and quick commands silent."""


class ProgressLines(Progress):
    """Stands in for bars: keeps count of tasks as they do, and prints a line now and then."""

    def __init__(self, say: Callable[[str], None] | None = None, *, every_s: float = EVERY_S) -> None:
        super().__init__(disable=True)
        self._say = say or _to_standard_error
        self._every_s = every_s
        self._began = self._last = self._stage_began = time.monotonic()

    def update(self, task_id: TaskID, **changes: Any) -> None:  # noqa: ANN401 - as there
        """Change a task as `Progress.update` does; tell it if it is time."""
        before = self._tasks[task_id].completed, self._tasks[task_id].total
        super().update(task_id, **changes)
        now, task = time.monotonic(), self._tasks[task_id]
        if task.completed < before[0] or task.total != before[1]:
            self._stage_began = now  # what came before does not tell how fast this goes
        if now - self._last >= self._every_s:
            self._last = now
            self._say(line(task, now - self._began, now - self._stage_began))


def line(task: Task, seconds: float, of_stage: float | None = None) -> str:
    """Say how far a task is: time since the start, share, what is in work, time left if it can be told.

    `of_stage` are the seconds since its count began, those since the start unless told.
    """
    done = f" {task.percentage:3.0f} %" if task.total else ""
    left, of_stage = "", seconds if of_stage is None else of_stage
    if task.total and 0 < task.completed < task.total:
        left = f", about {clock(of_stage * (task.total - task.completed) / task.completed)} left"
    return f"[{clock(seconds)}]{done} {task.description or 'working'}{left}"


def clock(seconds: float) -> str:
    """Write a time as 4:07, or 1:04:07 from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def _to_standard_error(text: str) -> None:
    typer.echo(text, err=True)
