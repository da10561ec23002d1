"""`lensmodel demo`."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Final

import typer

from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError

FILES: Final = frozenset({"before-after.png", "corrected.tif", "report.md", "service.log"})
"""What a demo leaves in its folder."""


def demo(
    context: typer.Context,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Where to write: a folder for the pictures and the report."
        ),
    ] = Path("demo-output"),
    force: Annotated[bool, typer.Option("--force", help="Use a folder that holds other files too.")] = False,
) -> None:
    """Run the whole process on a simulated lens whose true blur is known.

    Starts a service of its own, uploads photos, calibrates their lens, corrects a photo, measures,
    and stops the service: some minutes on two cores. What an earlier demo left in the folder
    is renewed; a folder with anything else in it is refused without --force.

    Example:

        lensmodel demo --output demo-output

    Exit status: 0 the figures show an improvement, 1 they do not or something failed, 2 wrong usage.
    """
    shown = Display.of(context)
    _refuse_what_others_wrote(output, force=force)
    from lab.demo.run import run  # noqa: PLC0415 - only this command needs the simulation

    began = time.monotonic()
    improved = run(output, lambda text: shown.progress_line(text, time.monotonic() - began))
    shown.result((output / "report.md").read_text(encoding="utf-8"))
    if not improved:
        shown.error("the corrected photo did not become better; see the report")
        raise typer.Exit(1)


def _refuse_what_others_wrote(folder: Path, *, force: bool) -> None:
    """Make sure that the folder holds nothing but what a demo leaves there."""
    if folder.exists() and not folder.is_dir():
        raise UsageError(f"{folder} is a file; give a folder to -o")
    for path in sorted(folder.glob("*")):
        if not force and path.name not in FILES:
            raise UsageError(f"{path} is not of a demo; give a new folder to -o, or --force")
