"""What all commands share: what they say, how they end, and their options.

Results go to standard output, all else to standard error; progress is a bar on a terminal and plain lines
elsewhere.
"""

from __future__ import annotations

import json
import logging
import math
import multiprocessing
import os
import signal
import sys
import threading
import time
from datetime import timedelta
from pathlib import Path
from types import FrameType
from typing import Annotated, Any, Final

import typer
from rich.console import Console
from rich.progress import Progress, TextColumn

from lensmodel.core import types
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.files import to_json

# A line in so many seconds (chosen): a night's log stays readable, and quick commands silent
EVERY_S: Final = 10.0
COMPILING = "lensmodel.correction.whole_photo.first_use"  # Logs when loops are compiled, once on a machine


class _Lines(logging.Handler):
    """Prints records as a command tells all else, above its bar."""

    def emit(self, record: logging.LogRecord) -> None:
        """Print the line of a record."""
        try:
            typer.echo(self.format(record), err=True)
        except Exception:  # noqa: BLE001 - as the handlers of the library do it
            self.handleError(record)


class Display:
    """How much a command says, and what is logged meanwhile.

    `quiet` leaves only errors, and results that were asked for as JSON; `verbose` is 0 for warnings, 1 for
    what happens, 2 for all that is logged; `as_json` prints a document instead of results in words.
    """

    def __init__(self, *, quiet: bool = False, verbose: int = 0, as_json: bool = False) -> None:
        self.quiet, self.verbose, self.as_json = quiet, verbose, as_json
        level = logging.ERROR if quiet else (logging.WARNING, logging.INFO, logging.DEBUG)[min(verbose, 2)]
        logging.basicConfig(level=level, format="lensmodel: %(message)s", handlers=[_Lines()], force=True)
        if not quiet and sys.stderr.isatty():  # so long a silence looks like a fault
            logging.getLogger(COMPILING).setLevel(logging.INFO)

    def result(self, text: str) -> None:
        """Print what was asked for, in words."""
        if not (self.quiet or self.as_json):
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

    def error(self, text: str) -> None:
        """Tell what went wrong."""
        typer.echo(f"lensmodel: {text}", err=True)

    def progress(self, text: str = "", total: float | None = None) -> Bar:
        """One bar with share and time left; plain lines now and then where no terminal can show it."""
        bar = Bar(
            TextColumn("{task.description}", markup=False),  # names of files may hold brackets
            *Progress.get_default_columns()[1:],
            console=Console(file=sys.stderr),
            disable=self.quiet or not sys.stderr.isatty(),
            transient=True,
            redirect_stdout=sys.stdout.isatty(),  # a pipe or file gets its results untouched
        )
        bar.add_task(text, total=total)
        bar.last, bar.every_s = bar.get_time(), math.inf if self.quiet or not bar.disable else EVERY_S
        return bar


class Bar(Progress):
    """The progress of one task."""

    every_s = math.inf  # seconds between lines where no terminal shows the bar, and when there was one
    last = 0.0

    def show(self, completed: float = 0.0, **changes: Any) -> None:  # noqa: ANN401 - as `Progress.update` takes them
        """Change what is shown; what was done of a photo that is then passed over stays done."""
        (task,) = self.tasks
        self.update(task.id, completed=max(completed, task.completed), **changes)
        if self.get_time() - self.last >= self.every_s:
            self.last = self.get_time()
            share = f"{task.percentage:3.0f} % " if task.total else ""
            typer.echo(f"[{clock(task.elapsed or 0.0)}] {share}{task.description or 'working'}", err=True)

    def part(self, number: int, done: int, total: int, description: str | None = None) -> None:
        """Show that photo `number` is done as far as `done` of `total`."""
        self.show(number + done / max(total, 1), description=description)


def clock(seconds: float) -> str:
    """Write a time as 0:04:07."""
    return str(timedelta(seconds=int(seconds)))


def gain_words(gain: float | None) -> str:
    """Say what gain is expected, in decibels; None is not known."""
    if gain is None:
        return "not known"
    return f"{gain:+.1f} dB" if abs(gain) >= 0.05 else "no change"


# --- how a command ends ------------------------------------------------------------------------


class UsageError(InvalidInputError):
    """The command was called wrongly: nothing was begun; exit status 2."""


class InterruptedByUser(BaseException):
    """Ctrl-C or SIGTERM. Carries the number of the signal."""

    def __init__(self, number: int) -> None:
        super().__init__(number)
        self.number = number


_SIGNALS: Final = (signal.SIGINT, signal.SIGTERM)
_PATIENCE_S: Final = 10.0  # Cleaning up takes far less; after this the process ends all the same


def leave_interrupts_to_the_command() -> None:
    """In a worker process, leave Ctrl-C to the process of the command, which ends its workers."""
    if multiprocessing.parent_process() is not None:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def handle_signals() -> None:
    """Turn Ctrl-C and SIGTERM into `InterruptedByUser`: each `with` and `finally` removes what is begun."""
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


# --- options that several commands share, with one wording each ---------------------------------


def f_number(text: str) -> float:
    """Read an aperture as people write it: 2.8, f/2.8 or F2.8."""
    number = str(text).strip().lower().removeprefix("f").removeprefix("/")
    try:
        return float(number)
    except ValueError as error:
        raise UsageError(f"--aperture must be an f-number such as 2.8 or f/2.8, got {text!r}") from error


def odd(side: int) -> int:
    """Refuse a kernel without a middle pixel."""
    if side % 2 == 0:
        raise UsageError(f"--size must be odd, got {side}; a PSF has one middle pixel")
    return side


def aperture(words: str) -> Any:  # noqa: ANN401 - what `typer.Option` returns
    """Return the option of the f-number."""
    return typer.Option("--aperture", "-a", metavar="N", parser=f_number, help=words)


def output(words: str) -> Any:  # noqa: ANN401 - what `typer.Option` returns
    """Return the option of what to write."""
    return typer.Option("--output", "-o", metavar="DIR|FILE", help=words)


Photos = Annotated[list[Path], typer.Argument(metavar="PHOTO", help="Photos, or folders of them.")]
Profile = Annotated[Path, typer.Option("--profile", "-p", help="The lens profile to write or add to.")]
ProfileFile = Annotated[Path, typer.Argument(metavar="FILE", help="The lens profile.")]
Aperture = Annotated[float | None, aperture("f-number, for photos that do not record their own.")]
AnyLens = Annotated[
    bool, typer.Option("--any-lens", help="Also accept photos that seem to be of a different lens.")
]
Channel = Annotated[types.Channel, typer.Option(help="Colour channel.")]
Size = Annotated[int, typer.Option(min=3, max=255, callback=odd, help="Side in pixels, an odd number.")]
Workers = Annotated[int | None, typer.Option("--workers", "-j", min=1, help="Cores to use; default: all.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Only errors: no progress and no notes.")]
Verbose = Annotated[
    int, typer.Option("--verbose", "-v", count=True, metavar="", show_default=False, help="More; -vv: all.")
]
