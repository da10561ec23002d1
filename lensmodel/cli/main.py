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

from lensmodel.cli import console
from lensmodel.cli.console import Display, InterruptedByUser, UsageError
from lensmodel.core.errors import LensModelError

console.leave_interrupts_to_the_command()

COMMANDS: Final[Mapping[str | None, Mapping[str, tuple[str, str]]]] = {
    None: {
        "correct": ("lensmodel.cli.correct", "Remove the blur of the lens from photos."),
        "calibrate": ("lensmodel.cli.calibrate", "Learn the blur of a lens from photos."),
        "report": ("lensmodel.cli.report", "Say how sharp a lens is, and whether it is centred."),
        "measure": ("lensmodel.cli.measure", "Measure the blur of a lens from photos made for the purpose."),
        "serve": ("app.commands.service", "Run the whole service: the API and a worker."),
    },
    "Research": {
        "target": ("lensmodel.cli.measure", "Write the page to print for `lensmodel measure`."),
        "export": ("lensmodel.cli.report", "Write PSFs for other programs."),
        "demo": ("lab.demo", "Run the whole process on a simulated lens whose true blur is known."),
        "reproduce": ("lab.commands", "Make the paper's figures and its Table 1 on simulated lenses."),
        "bench": ("lab.commands", "Measure quality and speed."),
    },
    "Administration": {
        "api": ("app.commands.service", "Run only the API process, for installations on many machines."),
        "worker": ("app.commands.service", "Run only a worker process, for installations on many machines."),
        "config": ("app.commands.service", "Print the settings as environment variables."),
        "doctor": ("app.commands.upkeep", "Check an installation, running or not."),
        "backup": ("app.commands.upkeep", "Copy an installation into a folder, even while it runs."),
        "keys": ("app.commands.keys", "Make, list and revoke the keys of a service that others can reach."),
    },
}
"""By panel, the commands in the order of the list: the module of each, which has a function or a
`typer.Typer` of that name, and the first sentence of its help. Panels are of what few people need."""


class OnDemand(TyperGroup):
    """`COMMANDS`, each imported when it is called: neither `--help` nor `config` waits for SciPy."""

    def __init__(self, **given: Any) -> None:  # noqa: ANN401 - what Typer passes
        super().__init__(**given)
        for panel, commands in COMMANDS.items():
            for name, (_, summary) in commands.items():
                self.add_command(TyperCommand(name, help=summary, rich_help_panel=panel))

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:  # noqa: ANN401 - Typer's own
        """Import the command that the words name."""
        name, stand_in, words = super().resolve_command(ctx, args)
        return name, stand_in if name is None else self.imported(name), words

    def imported(self, name: str) -> Any:  # noqa: ANN401 - a command or a group of Typer's
        """Import a command and return it as Typer builds it from its signature."""
        module = next(commands[name][0] for commands in COMMANDS.values() if name in commands)
        value = getattr(import_module(module), name)
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
    version: Annotated[
        bool,
        typer.Option("--version", callback=_show_version, is_eager=True, help="Show the version and exit."),
    ] = False,
) -> None:
    """Learn the blur of one copy of a lens from ordinary photos, and remove it."""
    del version
    Display()


def main() -> None:
    """Run the command; exit 0 done, 1 something failed, 2 wrong usage, 128 + signal interrupted."""
    console.handle_signals()
    try:
        app(prog_name="lensmodel")  # also where `python -m lensmodel` runs it
    except InterruptedByUser as stopped:
        name = "Ctrl-C" if stopped.number == signal.SIGINT else signal.Signals(stopped.number).name
        text, status = (
            f"stopped by {name}; finished files are kept, nothing is half-written",
            128 + stopped.number,
        )
    except (LensModelError, OSError) as error:
        where = f"{error.filename}: " if isinstance(error, OSError) and error.filename else ""
        text, status = where + console.reason(error), 2 if isinstance(error, UsageError) else 1
    except ModuleNotFoundError as error:
        text, status = console.remedy(error) or "", 1
        if not text:
            raise
    else:
        return
    typer.echo(f"lensmodel: {text}", err=True)
    sys.exit(status)


if __name__ == "__main__":
    main()
