"""What a command says: results on standard output, all else on standard error.

Progress is a bar on a terminal and plain lines elsewhere. Words that commands, pages and reports share.
"""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Callable
from functools import partial
from typing import Any, Final

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn
from rich.table import Table

from lensmodel.core.files import to_json

REMARKS = "lensmodel.remarks"  # Logs what was left out of a photo or replaced in it
COMPILING = "lensmodel.correction.whole_photo.first_use"  # Logs when loops are compiled, once on a machine
# At most one line in so many seconds (chosen): a night's log stays readable, and quick commands silent
EVERY_S: Final = 10.0


class _Lines(logging.Handler):
    """Tells records as a command tells all else, above its bar; those for people in the same words, too."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print the line of a record."""
        try:
            for_people = record.name in {REMARKS, COMPILING}
            typer.echo(f"lensmodel: {record.getMessage()}" if for_people else self.format(record), err=True)
        except Exception:  # noqa: BLE001 - as the handlers of the library do it
            self.handleError(record)


class Display:
    """How much a command says, and what is logged meanwhile.

    `quiet` leaves only errors, and results that were asked for as JSON; `verbose` is 0 for warnings, 1 for
    what happens, 2 for all that is logged; `as_json` prints a document instead of results in words.
    """

    def __init__(self, *, quiet: bool = False, verbose: int = 0, as_json: bool = False) -> None:
        self.quiet, self.verbose, self.as_json = quiet, verbose, as_json
        level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
        logging.basicConfig(
            level=logging.ERROR if quiet else level,
            format="%(levelname)s %(name)s: %(message)s",
            handlers=[_Lines()],
            force=True,
        )
        if not quiet and sys.stderr.isatty():  # so long a silence looks like a fault
            logging.getLogger(COMPILING).setLevel(logging.INFO)

    def result(self, shown: str | Table) -> None:
        """Print what was asked for, in words or as a table."""
        if self.quiet or self.as_json:
            return
        if isinstance(shown, str):
            typer.echo(shown)
        else:
            Console().print(shown)

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

    def progress(self, text: str = "", total: float | None = None) -> Bar:
        """One bar with share and time left; plain lines now and then where no terminal can show it."""
        terminal = sys.stderr.isatty()
        return Bar(
            text,
            total,
            say=None if self.quiet or terminal else partial(typer.echo, err=True),
            console=Console(file=sys.stderr),
            disable=self.quiet or not terminal,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # a pipe or file gets its results untouched
        )


class Bar(Progress):
    """The progress of one task, which never goes back; without a terminal, a plain line now and then."""

    def __init__(
        self,
        text: str,
        total: float | None,
        *,
        say: Callable[[str], None] | None = None,
        every_s: float = EVERY_S,
        **given: Any,  # noqa: ANN401 - as `Progress` takes them
    ) -> None:
        words = TextColumn("{task.description}", markup=False)  # names of files may hold brackets
        columns = words, BarColumn(), TaskProgressColumn(), TimeElapsedColumn()
        super().__init__(*columns, TextColumn("{task.fields[left]}"), **given)
        self._say, self._every_s = say, every_s
        self._last = self.get_time()
        self.add_task(text, total=total, left="")
        (self._task,) = self.tasks

    def show(self, **changes: Any) -> None:  # noqa: ANN401 - as `Progress.update` takes them
        """Change what is shown as `Progress.update` does; tell it if it is time.

        What was done of a photo that is then passed over stays done.
        """
        task = self._task
        if "completed" in changes:
            changes["completed"] = max(changes["completed"], task.completed)
        self.update(task.id, **changes)
        # photos that an earlier run has done are passed in no time, which says nothing of the others
        early = (task.elapsed or 0.0) < 2.0 * self.speed_estimate_period
        left = "" if early or task.time_remaining is None else clock(task.time_remaining)
        task.fields["left"] = left and f"ETA {left}"
        if self._say is not None and self.get_time() - self._last >= self._every_s:
            self._last = self.get_time()
            done = f" {task.percentage:3.0f} %" if task.total else ""
            ahead = left and f", about {left} left"
            self._say(f"[{clock(task.elapsed or 0.0)}]{done} {task.description or 'working'}{ahead}")

    def part(self, number: int, done: int, total: int, **changes: Any) -> None:  # noqa: ANN401 - as `show` takes them
        """Show that photo `number` is done as far as `done` of `total`."""
        self.show(completed=number + done / max(total, 1), **changes)


def clock(seconds: float) -> str:
    """Write a time as 4:07, or 1:04:07 from an hour on."""
    minutes, rest = divmod(int(seconds), 60)
    hours, minutes = divmod(minutes, 60)
    return f"{hours}:{minutes:02d}:{rest:02d}" if hours else f"{minutes}:{rest:02d}"


def gain_words(gain: float | None) -> str:
    """Say what gain is expected, in decibels; None is not known."""
    if gain is None:
        return "not known"
    return f"{gain:+.1f} dB" if abs(gain) >= 0.05 else "no change"
