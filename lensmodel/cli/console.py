"""What a command says: results on standard output, all else on standard error.

Progress as a bar or as plain lines, and when a time left can be told; tables of plain text; words that
commands, pages and reports share.
"""

from __future__ import annotations

import json
import logging
import sys
import time
from bisect import bisect_right
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import zip_longest
from typing import Any, Final

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn

from lensmodel.core.codec import to_json

REMARKS = "lensmodel.remarks"  # Logs what was left out of a photo or replaced in it
COMPILING = "lensmodel.correction.whole_photo.first_use"  # Logs when loops are compiled, once on a machine


class _Lines(logging.Handler):
    """Tells records as a command tells all else, above its bar; those for people in the same words, too."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print the line of a record."""
        try:
            for_people = record.name in {REMARKS, COMPILING}
            typer.echo(f"lensmodel: {record.getMessage()}" if for_people else self.format(record), err=True)
        except Exception:  # noqa: BLE001 - as the handlers of the library do it
            self.handleError(record)


@dataclass(frozen=True, slots=True)
class Display:
    """How much is said."""

    quiet: bool = False  # only errors; and results where they were asked for as JSON
    verbose: int = 0  # 0 warnings, 1 what happens, 2 all that is logged
    as_json: bool = False  # a document instead of results in words

    @classmethod
    def of(
        cls, context: typer.Context, *, quiet: bool = False, verbose: int = 0, as_json: bool = False
    ) -> Display:
        """Return the display of a subcommand, whose options add to those of the program."""
        base = context.find_object(Display) or Display()
        display = Display(base.quiet or quiet, max(base.verbose, verbose), as_json)
        display.configure()
        return display

    def configure(self) -> None:
        """Let the log lines of this process through to standard error."""
        level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(self.verbose, 2)]
        logging.basicConfig(
            level=logging.ERROR if self.quiet else level,
            format="%(levelname)s %(name)s: %(message)s",
            handlers=[_Lines()],
            force=True,
        )
        if not self.quiet and sys.stderr.isatty():  # so long a silence looks like a fault
            logging.getLogger(COMPILING).setLevel(logging.INFO)

    def result(self, text: str) -> None:
        """Print what was asked for, in words."""
        if not self.quiet and not self.as_json:
            typer.echo(text)

    def document(self, value: Any) -> None:  # noqa: ANN401 - any value that the codec knows
        """Print what was asked for as JSON, then the only thing on standard output."""
        if self.as_json:
            typer.echo(json.dumps(to_json(value), indent=2))

    def note(self, text: str) -> None:
        """Tell what a person may want to know."""
        if not self.quiet:
            self.error(text)

    def detail(self, text: str) -> None:
        """Tell what only who asks for more with -v wants to know."""
        if self.verbose:
            self.note(text)

    def progress_line(self, text: str, seconds: float) -> None:
        """Tell a step of long work, with the time since its start, on standard error."""
        if not self.quiet:
            typer.echo(f"[{clock(seconds):>5}] {text}", err=True)

    def error(self, text: str) -> None:
        """Tell what went wrong."""
        typer.echo(f"lensmodel: {text}", err=True)

    def progress(self, text: str = "", total: float | None = None) -> PacedProgress:
        """One bar with share and time left; plain lines now and then where no terminal can show it."""
        terminal = sys.stderr.isatty()
        return PacedProgress(
            text,
            total,
            say=None if self.quiet or terminal else partial(typer.echo, err=True),
            console=Console(file=sys.stderr),
            disable=self.quiet or not terminal,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # a pipe or file gets its results untouched
        )


# At most one line in so many seconds (chosen): a night's log stays readable, and quick commands silent
EVERY_S: Final = 10.0
SURE_AFTER_S: Final = 4.0  # of work (chosen): before, what is read and compiled once hides the pace
# Ratio of the paces of the earlier and the later half of the time from which on nothing is told: one of them
# is wrong by as much
AGREE: Final = 2.0
# Of a task, whichever comes first, before its pace is believed (chosen): of one photo what comes before its
# tiles, of many the first ones
LEAST_SHARE, LEAST_COUNT = 0.05, 3.0


class Pace:
    """What the past of a task tells of its time left."""

    def __init__(self) -> None:
        self._times: list[float] = []
        self._done: list[float] = []
        self._total: float | None = None

    def mark(self, now: float, done: float, total: float | None) -> None:
        """Take note of how far a task is; a new count begins where its total changes."""
        if total != self._total:
            self._times, self._done, self._total = [], [], total
        if not self._done or done > self._done[-1]:
            self._times.append(now)
            self._done.append(done)

    def left(self, now: float) -> float | None:
        """Seconds left; None before both halves of the time agree on the pace within a factor of two."""
        if not self._total or not self._times or now - self._times[0] < SURE_AFTER_S:
            return None
        start, end, first, last = self._times[0], self._times[-1], self._done[0], self._done[-1]
        middle = self._done[bisect_right(self._times, (start + end) / 2.0) - 1]
        earlier, later = sorted((middle - first, last - middle))
        if last < min(LEAST_SHARE * self._total, LEAST_COUNT) or earlier <= 0.0 or later > AGREE * earlier:
            return None
        return max((end - start) * (self._total - last) / (last - first) - (now - end), 0.0)


class PacedProgress(Progress):
    """A bar that never goes back and knows the time left; without a terminal, a plain line now and then."""

    def __init__(
        self,
        text: str,
        total: float | None,
        *,
        say: Callable[[str], None] | None = None,
        every_s: float = EVERY_S,
        **given: Any,  # noqa: ANN401 - as `Progress` takes them
    ) -> None:
        columns = TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
        super().__init__(*columns, TextColumn("{task.fields[left]}"), **given)
        self._say, self._every_s = say, every_s
        self._began = self._last = time.monotonic()
        self._pace = Pace()
        self.add_task(text, total=total, left="")
        (self._task,) = self.tasks

    def show(self, *, more: bool = False, **changes: Any) -> None:  # noqa: ANN401 - as `Progress.update` takes them
        """Change what is shown as `Progress.update` does; tell it if it is time.

        What was done of a photo that is then passed over stays done. While there is `more` work of another
        kind ahead, whose pace nobody knows, no time left is told.
        """
        now, task = time.monotonic(), self._task
        if "completed" in changes:
            changes["completed"] = max(changes["completed"], task.completed)
        self.update(task.id, **changes)
        if more:
            self._pace = Pace()
        else:
            self._pace.mark(now, task.completed, task.total)
        left = self._pace.left(now)
        task.fields["left"] = "" if left is None else f"ETA {clock(left)}"
        if self._say is not None and now - self._last >= self._every_s:
            self._last = now
            done = f" {task.percentage:3.0f} %" if task.total else ""
            ahead = "" if left is None else f", about {clock(left)} left"
            self._say(f"[{clock(now - self._began)}]{done} {task.description or 'working'}{ahead}")

    def part(self, number: int, done: int, total: int, **changes: Any) -> None:  # noqa: ANN401 - as `show` takes them
        """Show that photo `number` is done as far as `done` of `total`."""
        self.show(completed=number + done / max(total, 1), **changes)


def clock(seconds: float) -> str:
    """Write a time as 4:07, or 1:04:07 from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def aligned(head: Sequence[str], rows: Sequence[Sequence[str]], *, numbers: Container[int] = ()) -> str:
    """Write rows under a head, columns two blanks apart; those in `numbers` are set to the right.

    A cell may have several lines.
    """
    cells = [[cell.split("\n") for cell in row] for row in (head, *rows)]
    widths = [max(len(line) for row in cells for line in row[i]) for i in range(len(head))]
    cells.insert(1, [["-" * width] for width in widths])
    return "\n".join(
        "  ".join(
            cell.rjust(width) if i in numbers else cell.ljust(width)
            for i, (cell, width) in enumerate(zip(line, widths, strict=True))
        ).rstrip()
        for row in cells
        for line in zip_longest(*row, fillvalue="")
    )


NYQUIST: Final = 0.5  # Cycles/pixel: the Nyquist frequency, the finest detail that a grid of pixels can hold


def mtf50_words(frequency: float) -> str:
    """Write an MTF50 in cycles/pixel: a lower bound where contrast has not halved at the pixels' limit."""
    return f"at least {NYQUIST:g}" if frequency >= NYQUIST else f"{frequency:.3f}"


def gain_words(gain: float | None) -> str:
    """Say what gain is expected, in decibels; None is not known."""
    if gain is None:
        return "not known"
    return f"{gain:+.1f} dB" if abs(gain) >= 0.05 else "no change"
