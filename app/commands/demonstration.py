"""`lensmodel demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def demo(
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the pictures and the report.")
    ] = Path("demo-output"),
) -> None:
    """Show the whole way on a real RAW file and on a lens whose truth is known.

    Starts a service of its own, uploads photos, calibrates their lens, corrects a photo, measures,
    and stops the service. Exit status 0 only if the figures show an improvement.

    Example:

        lensmodel demo --output demo-output
    """
    from app.demo.run import run  # noqa: PLC0415 - only this command needs the simulation

    if not run(output, typer.echo):
        typer.echo("lensmodel: the corrected photo did not become better; see the report", err=True)
        raise typer.Exit(1)
    typer.echo((output / "report.md").read_text(encoding="utf-8"))
