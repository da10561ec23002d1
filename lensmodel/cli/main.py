"""The command `lensmodel`."""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Mapping
from importlib import import_module
from typing import Annotated, Any, Final

# Before NumPy is imported: the work is parallel over processes, and linear algebra libraries that
# start threads of their own in each of them only get in one another's way.
for _name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
    os.environ.setdefault(_name, "1")

import typer
from typer.core import TyperCommand, TyperGroup

from lensmodel.cli import ending
from lensmodel.cli.console import Display
from lensmodel.cli.ending import InterruptedByUser, UsageError
from lensmodel.core.errors import LensModelError

ending.workers_ignore_it()

RESEARCH: Final = "Research"
ADMINISTRATION: Final = "Administration"  # Panels of what few people need, after the commands of everyone

COMMANDS: Final[Mapping[str, tuple[str, str, str | None]]] = {
    "correct": ("lensmodel.cli.correct:correct", "Remove the blur of the lens from photos.", None),
    "calibrate": (
        "lensmodel.cli.calibrate:calibrate",
        "Learn the blur of one lens from photos and write it to a profile.",
        None,
    ),
    "report": (
        "lensmodel.cli.report:report",
        "Say how sharp a lens is, whether it is centred, and which photo would help most.",
        None,
    ),
    "measure": (
        "lensmodel.cli.measure:measure",
        "Measure the blur of a lens from photos made for the purpose.",
        None,
    ),
    "serve": ("app.commands.service:serve", "Run the whole service: the API and a worker.", None),
    "target": (
        "lensmodel.cli.measure:target",
        "Write the page to print for `lensmodel measure target`.",
        RESEARCH,
    ),
    "psf": (
        "lensmodel.cli.psf:psf",
        "Show what the lens makes of a point of light at one place in the picture.",
        RESEARCH,
    ),
    "export": (
        "lensmodel.cli.report:export_psfs",
        "Write PSFs for other programs: a grid over the picture, or a single place with --r and --phi.",
        RESEARCH,
    ),
    "demo": (
        "lab.demo.command:demo",
        "Run the whole process on a simulated lens whose true blur is known.",
        RESEARCH,
    ),
    "reproduce": (
        "lab.commands.reproduce:reproduce",
        "Make the paper's figures and its Table 1 on simulated lenses that nothing was tuned on.",
        RESEARCH,
    ),
    "bench": ("lab.commands.benchmarks:bench", "Measure quality and speed.", RESEARCH),
    "api": (
        "app.commands.service:api",
        "Run only the API process, for installations on many machines.",
        ADMINISTRATION,
    ),
    "worker": (
        "app.commands.service:worker",
        "Run only a worker process, for installations on many machines.",
        ADMINISTRATION,
    ),
    "config": (
        "app.commands.service:config",
        "Print the effective settings as environment variables; secrets are masked.",
        ADMINISTRATION,
    ),
    "doctor": (
        "app.commands.upkeep:doctor",
        "Check an installation, running or not: tables, blobs, and whether a worker is running.",
        ADMINISTRATION,
    ),
    "backup": (
        "app.commands.upkeep:backup",
        "Copy all rows and blobs of an installation into a folder, even while it runs.",
        ADMINISTRATION,
    ),
    "keys": (
        "app.commands.keys:keys",
        "Make, list and revoke the keys of a service that others can reach.",
        ADMINISTRATION,
    ),
}
"""Home, the first sentence of its help, and panel of each command in the order of the list."""


class OnDemand(TyperGroup):
    """`COMMANDS`, each imported when it is called: neither `--help` nor `config` waits for SciPy.

    The home of one is its function, or the `typer.Typer` of a command with commands of its own.
    """

    def __init__(self, **given: Any) -> None:  # noqa: ANN401 - what Typer passes
        super().__init__(**given)
        for name, (_, summary, panel) in COMMANDS.items():
            self.add_command(TyperCommand(name, help=summary, rich_help_panel=panel))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:  # noqa: ANN401 - Typer's own
        """Import the command that the words name."""
        name, stand_in, words = super().resolve_command(ctx, args)
        return name, stand_in if name is None else self.imported(name), words

    def imported(self, name: str) -> Any:  # noqa: ANN401 - a command or a group of Typer's
        """Import a command and return it as Typer builds it from its signature."""
        module, _, attribute = COMMANDS[name][0].partition(":")
        value = getattr(import_module(module), attribute)
        alone = typer.Typer(rich_markup_mode=self.rich_markup_mode, add_completion=False)
        if isinstance(value, typer.Typer):
            alone.add_typer(value, name=name)
        else:
            alone.command(name)(value)
        return typer.main.get_group(alone).commands[name]


app = typer.Typer(
    cls=OnDemand,
    name="lensmodel",
    help="Learn the blur of one copy of a lens from ordinary photos, and remove it.",
    epilog="""Start with: lensmodel correct FOLDER --lens auto

Exit status: 0 done, 1 something failed, 2 wrong usage, 130 stopped by Ctrl-C, 143 by SIGTERM.""",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


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
    shown = Display(quiet, verbose)
    shown.configure()
    context.obj = shown


def main() -> None:
    """Run the command; exit 0 done, 1 something failed, 2 wrong usage, 128 + signal interrupted."""
    ending.install()
    try:
        app(prog_name="lensmodel")  # also where `python -m lensmodel` runs it
    except LensModelError as error:
        typer.echo(f"lensmodel: {error}", err=True)
        sys.exit(2 if isinstance(error, UsageError) else 1)
    except ModuleNotFoundError as error:
        remedy = ending.remedy(error)
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
