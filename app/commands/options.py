"""Options that several commands share, with one wording each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

Photos = Annotated[
    list[str], typer.Argument(metavar="PHOTO", help="Files, folders, or quoted patterns such as '*.dng'.")
]
Profile = Annotated[Path, typer.Option("--profile", "-p", metavar="FILE", help="The lens profile.")]
Aperture = Annotated[
    float | None,
    typer.Option("--aperture", "-a", metavar="N", help="f-number, where a photo does not say its own."),
]
AnyLens = Annotated[
    bool, typer.Option("--any-lens", help="Also photos that name another lens than the profile.")
]
Workers = Annotated[int | None, typer.Option(min=1, metavar="N", help="In parallel; default: all cores.")]
Force = Annotated[bool, typer.Option("--force", help="Replace what is there already.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON, and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="No progress and no notes, only errors.")]
Verbose = Annotated[
    int,
    typer.Option("--verbose", "-v", count=True, metavar="", help="Say more; twice: all.", show_default=False),
]
