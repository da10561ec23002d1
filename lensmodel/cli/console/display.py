"""What a command says: results on standard output, all else on standard error."""

from __future__ import annotations

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import typer
from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    SpinnerColumn,
    TextColumn,
    TimeElapsedColumn,
)

from lensmodel.cli.console.progress_lines import ProgressLines, TimeLeft, clock
from lensmodel.core.codec import to_json

REMARKS = "lensmodel.remarks"
"""Logs what was left out of a photo or replaced in it."""

COMPILING = "lensmodel.correction.engine.first_use"
"""Logs when loops are compiled, once on a machine."""


class _Lines(logging.Formatter):
    """What is told of a photo reads as all that a command tells."""

    def format(self, record: logging.LogRecord) -> str:
        """Return the line of a record."""
        return f"lensmodel: {record.getMessage()}" if record.name == REMARKS else super().format(record)


@dataclass(frozen=True, slots=True)
class Display:
    """How much is said.

    Parameters
    ----------
    quiet : bool
        Only errors; and results where they were asked for as JSON.
    verbose : int
        0 warnings, 1 what happens, 2 all that is logged.
    """

    quiet: bool = False
    verbose: int = 0

    def more(self, *, quiet: bool, verbose: int) -> Display:
        """Return the display after the options of a subcommand; they add to those of the program."""
        display = Display(self.quiet or quiet, max(self.verbose, verbose))
        display.configure()
        return display

    def configure(self) -> None:
        """Let the log lines of this process through to standard error."""
        level = (logging.WARNING, logging.INFO, logging.DEBUG)[min(self.verbose, 2)]
        handler = logging.StreamHandler(sys.stderr)
        handler.setFormatter(_Lines("%(levelname)s %(name)s: %(message)s"))
        logging.basicConfig(level=logging.ERROR if self.quiet else level, handlers=[handler], force=True)
        if not self.quiet and sys.stderr.isatty():  # so long a silence looks like a fault
            logging.getLogger(COMPILING).setLevel(logging.INFO)

    def result(self, text: str) -> None:
        """Print what was asked for."""
        if not self.quiet:
            typer.echo(text)

    def document(self, value: Any) -> None:  # noqa: ANN401 - any value that the codec knows
        """Print a result as JSON, the only thing on standard output."""
        typer.echo(json.dumps(to_json(value), indent=2))

    def note(self, text: str) -> None:
        """Tell what a person may want to know."""
        if not self.quiet:
            self.error(text)

    def detail(self, text: str) -> None:
        """Tell what only who asks for more with -v wants to know."""
        if self.verbose and not self.quiet:
            self.error(text)

    def progress_line(self, text: str, seconds: float, left: float | None = None) -> None:
        """Tell a step of long work, with the time since its start and the time left, on standard error."""
        if not self.quiet:
            ahead = "" if left is None else f", ETA {clock(left)}"
            typer.echo(f"[{clock(seconds):>5}{ahead}] {text}", err=True)

    def error(self, text: str) -> None:
        """Tell what went wrong."""
        typer.echo(f"lensmodel: {text}", err=True)

    @contextmanager
    def progress(self) -> Iterator[Progress]:
        """Bars with counts and the time left; plain lines now and then where no terminal can show them."""
        if not self.quiet and not sys.stderr.isatty():
            with ProgressLines() as lines:
                yield lines
            return
        bars = Progress(
            TextColumn("{task.description}"),
            BarColumn(),
            MofNCompleteColumn(),
            TimeElapsedColumn(),
            TimeLeft(),
            console=Console(file=sys.stderr),
            disable=self.quiet,
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # a pipe or file gets its results untouched
        )
        with bars:
            yield bars

    @contextmanager
    def busy(self, text: str) -> Iterator[None]:
        """Show that something goes on whose end cannot be foretold, with the time since its start."""
        bars = Progress(
            SpinnerColumn(),
            TextColumn("{task.description}"),
            TimeElapsedColumn(),
            console=Console(file=sys.stderr),
            disable=self.quiet or not sys.stderr.isatty(),
            transient=True,
            redirect_stdout=sys.stdout.isatty(),
        )
        with bars:
            bars.add_task(text, total=None)
            yield


def of(context: typer.Context, *, quiet: bool = False, verbose: int = 0) -> Display:
    """Return the display of a subcommand."""
    base = context.find_object(Display) or Display()
    return base.more(quiet=quiet, verbose=verbose)
