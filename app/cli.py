"""The command `lensmodel`."""

from __future__ import annotations

import os
import signal
import sys
from typing import Annotated

# Before NumPy is imported: the work is parallel over processes, and linear algebra libraries that
# start threads of their own in each of them only get in one another's way.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer

from app.commands import checking, demonstration, keys, measurement, photos, report, service, upkeep
from app.commands.console import display, extras, interrupt
from app.commands.console.failure import InterruptedByUser, UsageError
from app.lab import benchmarks, reproduce
from lensmodel.core.errors import LensModelError

interrupt.workers_ignore_it()

app = typer.Typer(
    name="lensmodel",
    help="Learn the blur of one copy of a lens from ordinary photos, and remove it.",
    epilog="""Start with: lensmodel calibrate PHOTO... --profile my-lens.lensprofile

Exit status: 0 done, 1 something failed, 2 called wrongly, 130 stopped by Ctrl-C, 143 by SIGTERM.""",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(photos.calibrate)
app.command()(photos.correct)
app.command()(checking.check)
app.command()(photos.psf)
app.command()(measurement.measure)
app.command()(measurement.target)
app.command()(report.report)
app.command(name="export")(report.export_psfs)
app.command()(service.serve)
app.command(hidden=True)(service.api)
app.command(hidden=True)(service.worker)
app.command()(service.config)
app.command()(upkeep.doctor)
app.command()(upkeep.backup)
app.command()(upkeep.restore)
app.command()(upkeep.migrate)
app.command()(demonstration.demo)
app.command()(reproduce.reproduce)
app.add_typer(keys.keys, name="keys")
app.add_typer(benchmarks.bench, name="bench")


def _show_version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version  # noqa: PLC0415 - costs 20 ms that no other call should pay

        typer.echo(f"lensmodel {version('lensmodel')}")
        raise typer.Exit


@app.callback()
def configure(
    context: typer.Context,
    verbose: Annotated[
        int, typer.Option("-v", "--verbose", count=True, help="More log lines; twice: all.")
    ] = 0,
    quiet: Annotated[bool, typer.Option("-q", "--quiet", help="No progress, only errors.")] = False,
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Learn the blur of one copy of a lens from ordinary photos, and remove it."""
    del version
    shown = display.Display(quiet, verbose)
    shown.configure()
    context.obj = shown


def main() -> None:
    """Run the command; exit 0 done, 1 something failed, 2 wrong usage, 128 + signal interrupted."""
    interrupt.install()
    try:
        app(prog_name="lensmodel")  # also where `python -m lensmodel` runs it
    except LensModelError as error:
        typer.echo(f"lensmodel: {error}", err=True)
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except ModuleNotFoundError as error:
        remedy = extras.remedy(error)
        if remedy is None:
            raise
        typer.echo(f"lensmodel: {remedy}", err=True)
        sys.exit(1)
    except OSError as error:
        where = f"{error.filename}: " if error.filename else ""
        typer.echo(
            f"lensmodel: {where}{error.strerror or error}; check the path, its rights and the disk", err=True
        )
        sys.exit(1)
    except InterruptedByUser as stopped:
        name = signal.Signals(stopped.number).name
        typer.echo(
            f"lensmodel: stopped by {name}; finished files are kept, nothing is half-written", err=True
        )
        sys.exit(128 + stopped.number)


if __name__ == "__main__":
    main()
