"""`lensmodel reproduce`."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Literal, cast, get_args

import typer

from lab.commands.benchmarks import told
from lensmodel.cli.console import Display
from lensmodel.cli.files import refuse_existing
from lensmodel.cli.options import Force, choice

Size = Literal["quick", "default"]
PAGE = ("reproduction.md", "reproduction.html", "reproduction.json")
"""What is in the folder of a finished reproduction, beside pictures and stored results."""

BENCHMARK = Path("bench-output")
"""Where `lensmodel bench blind` leaves what Fig. 1 is drawn from."""


def reproduce(
    context: typer.Context,
    output: Annotated[
        Path,
        typer.Option(
            "--output", "-o", help="Where to write: a folder for the page, its pictures and stored results."
        ),
    ] = Path("reproduction"),
    size: Annotated[
        str,
        choice(
            "--size",
            get_args(Size),
            "quick: four lenses on small photos, minutes. default: ten lenses on frames of five "
            "megapixels, up to ten photos, an hour or two.",
        ),
    ] = "default",
    lens: Annotated[
        list[str] | None,
        typer.Option(
            metavar="LENS",
            help="Seed of a lens of third order, or a file of PSFs of a ray-traced one, made by `python -m "
            "lab.population grid`; again for more. Default: those of the size.",
        ),
    ] = None,
    compare: Annotated[
        bool,
        typer.Option(
            "--compare",
            help="Also the paper's own method, a general profile, a printed target and a blind rival: hours.",
        ),
    ] = False,
    assert_bars: Annotated[
        bool, typer.Option("--assert-bars", help="Fail where a bar is missed, and name each.")
    ] = False,
    force: Force = False,
) -> None:
    """Make the paper's figures and its Table 1 on simulated lenses that nothing was tuned on.

    Each lens learns from Bayer DNG files as a user's does, and from a TIFF and a JPEG; what it answers and
    corrects is measured against the truth. Finished results are kept: a run that was stopped goes on, and
    a change of code or settings computes anew. A finished page is replaced only with --force.

    Examples:

        lensmodel reproduce --size quick -o reproduction

        lensmodel reproduce --lens 1003 --lens aspheric-f2.7.npz -o two-lenses

    Exit status: 0 the page is written, 1 something failed or an asserted bar is missed, 2 wrong usage.
    """
    shown = Display.of(context)
    refuse_existing(*(output / name for name in PAGE), force=force)
    from lab.reproduce.cases import planned  # noqa: PLC0415 - the simulation is slow to import
    from lab.reproduce.job import run_reproduction  # noqa: PLC0415 - same
    from lab.reproduce.page import collected, write_json, write_page  # noqa: PLC0415 - same
    from lab.reproduce.tables import missed  # noqa: PLC0415 - same

    plan = planned(cast("Size", size), scenes=_external(), lenses=lens or (), compare=compare)
    on_work = told(shown, time.monotonic())
    result = run_reproduction(plan, output, on_work=on_work, workers=os.cpu_count() or 1)
    result["figures"]["fig1"] = collected(BENCHMARK, output / "pictures")
    written = [*write_page(result, output), write_json(result, output / PAGE[-1])]
    shown.result(f"Code {result['code']}. Written: " + ", ".join(str(path) for path in written))
    if assert_bars and (lines := missed(result)):
        shown.error("\n".join(["these bars are missed:", *lines]))
        raise typer.Exit(1)


def _external() -> Path | None:
    folder = Path(os.environ.get("LENSMODEL_TEST_DATA", "nowhere")) / "sharp"
    return folder if folder.is_dir() else None
