"""Options that several commands share, with one wording each."""

from __future__ import annotations

import copy
import difflib
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from lensmodel.cli.ending import UsageError
from lensmodel.core import types


def choice(name: str, kinds: Iterable[str], words: str) -> Any:  # noqa: ANN401 - what `typer.Option` returns
    """Return the option that takes one of some words."""
    known = list(kinds)
    return typer.Option(name, metavar=f"<{'|'.join(known)}>", parser=one_of(name, known), help=words)


def one_of(name: str, kinds: Sequence[str]) -> Callable[[str], str]:
    """Return what takes one of some words; a refusal names the one that was probably meant."""

    def parsed(text: str) -> str:
        if text in kinds:
            return text
        likeness = {word: difflib.SequenceMatcher(None, text, word).ratio() for word in kinds}
        nearest = max(likeness, key=likeness.__getitem__)
        hint = f"; did you mean {nearest}?" if likeness[nearest] > 0.5 else ""
        raise UsageError(f"{name} must be {', '.join(kinds[:-1])} or {kinds[-1]}, got {text!r}{hint}")

    return parsed


def f_number(text: str) -> float:
    """Read an aperture as people write it: 2.8, f/2.8 or F2.8."""
    number = str(text).strip().lower().removeprefix("f").removeprefix("/")
    try:
        return float(number)
    except ValueError as error:
        raise UsageError(f"--aperture must be an f-number such as 2.8 or f/2.8, got {text!r}") from error


def _radians(angle: float | None) -> float | None:
    if angle is not None and abs(angle) > math.tau:
        raise UsageError(f"--phi is in radians; {angle:g} degrees are {math.radians(angle):.3f}")
    return angle


def odd(side: int) -> int:
    """Refuse a kernel without a middle pixel."""
    if side % 2 == 0:
        raise UsageError(f"--size must be odd, got {side}; a PSF has one middle pixel")
    return side


def aperture_option(words: str) -> Any:  # noqa: ANN401 - what `typer.Option` returns
    """Return the option of the f-number."""
    return typer.Option("--aperture", "-a", metavar="N", parser=f_number, help=words)


def rare(panel: str, *option: Any, **given: Any) -> Any:  # noqa: ANN401 - what `typer.Option` takes and returns
    """Return an option that only --help-all shows, in a panel: a shared one, or one of its own."""
    shared = option and not isinstance(option[0], str)
    changed = copy.copy(option[0]) if shared else typer.Option(*option, **given)
    changed.hidden, changed.rich_help_panel = True, panel
    return changed


def _show_all(context: typer.Context, wanted: bool) -> None:
    """Print the help with the options that few people need."""
    if wanted:
        for parameter in context.command.params:
            parameter.hidden = False  # type: ignore[attr-defined]  # options have it
        typer.echo(context.get_help())
        raise typer.Exit


HelpAll = Annotated[
    bool,
    typer.Option(
        "--help-all", callback=_show_all, is_eager=True, help="Show all options: these are the usual ones."
    ),
]
Photos = Annotated[
    list[str], typer.Argument(metavar="PHOTO", help="Files, folders, or quoted patterns such as '*.dng'.")
]
Profile = Annotated[
    Path | None,
    typer.Option(
        "--profile", "-p", metavar="FILE", help="The lens profile to write or add to; always needed."
    ),
]
ProfileFile = Annotated[Path, typer.Argument(metavar="FILE", help="The lens profile.")]
Aperture = Annotated[float | None, aperture_option("f-number, for photos that do not record their own.")]
ANY_LENS = typer.Option("--any-lens", help="Also accept photos that seem to be of a different lens.")
AnyLens = Annotated[bool, ANY_LENS]
Channel = Annotated[types.Channel, choice("--channel", get_args(types.Channel), "Colour channel.")]
RADIUS = typer.Option(
    "--r", min=0.0, max=1.0, metavar="0..1", help="Distance from the centre: 0 centre, 1 corner."
)
ANGLE = typer.Option(
    "--phi", metavar="RADIAN", callback=_radians, help="Angle of the place, counter-clockwise from the right."
)
Size = Annotated[
    int, typer.Option(min=3, max=255, metavar="N", callback=odd, help="Side in pixels, an odd number.")
]
WORKERS = typer.Option(
    "--workers",
    "-j",
    min=1,
    metavar="N",
    help="How many cores to use, as processes or threads. Default: all.",
)
Workers = Annotated[int | None, WORKERS]
Force = Annotated[bool, typer.Option("--force", help="Replace existing files.")]
JSON = typer.Option("--json", help="Print the result as JSON and nothing else.")
Json = Annotated[bool, JSON]
QUIET = typer.Option("--quiet", "-q", help="Only errors: no progress and no notes.")
Quiet = Annotated[bool, QUIET]
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
