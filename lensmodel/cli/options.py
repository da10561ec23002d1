"""Options that several commands share, with one wording each."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import typer

from lensmodel.cli.ending import UsageError
from lensmodel.core import types


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


Photos = Annotated[list[Path], typer.Argument(metavar="PHOTO", help="Photos, or folders of them.")]
Profile = Annotated[Path, typer.Option("--profile", "-p", help="The lens profile to write or add to.")]
ProfileFile = Annotated[Path, typer.Argument(metavar="FILE", help="The lens profile.")]
Aperture = Annotated[float | None, aperture("f-number, for photos that do not record their own.")]
AnyLens = Annotated[
    bool, typer.Option("--any-lens", help="Also accept photos that seem to be of a different lens.")
]
Channel = Annotated[types.Channel, typer.Option(help="Colour channel.")]
RADIUS = typer.Option("--r", min=0.0, max=1.0, help="Distance from the centre: 0 centre, 1 corner.")
ANGLE = typer.Option(
    "--phi", min=-math.tau, max=math.tau, help="Angle in radians, counter-clockwise from the right."
)
Size = Annotated[int, typer.Option(min=3, max=255, callback=odd, help="Side in pixels, an odd number.")]
Workers = Annotated[int | None, typer.Option("--workers", "-j", min=1, help="Cores to use; default: all.")]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON and nothing else.")]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Only errors: no progress and no notes.")]
Verbose = Annotated[
    int,
    typer.Option(
        "--verbose",
        "-v",
        count=True,
        metavar="",
        help="Say more; given twice, everything.",
        show_default=False,
    ),
]
