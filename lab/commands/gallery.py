"""`lensmodel bench gallery`: pictures to look at."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Final

import typer

from lensmodel.cli.console import Display
from lensmodel.cli.files import as_usage
from lensmodel.cli.options import Quiet, Verbose

DATA_VARIABLE: Final = "LENSMODEL_TEST_DATA"


def gallery(
    context: typer.Context,
    data: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help=f"Test data with real photos. Default: ${DATA_VARIABLE}; without it only simulated frames.",
        ),
    ] = None,
    output: Annotated[
        Path,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR",
            help="Where to write: a folder for page, crops and stored results.",
        ),
    ] = Path("gallery-output"),
    only: Annotated[
        list[str] | None,
        typer.Option(
            "--only", metavar="NAME", help="Only pictures whose name contains this; may be repeated."
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Processes and threads.")] = 2,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """A page to look at: each picture calibrated from itself and corrected, beside its original.

    Real photos of the test data and simulated frames, with crops at 3:1 and figures. Results are kept by the
    content of the photo and the version of the code: the same command again goes on where it was, and writes
    the page of the pictures it was asked for.

    Examples:

        lensmodel bench gallery --only simulated/text

        lensmodel bench gallery --only simulated/snow --only simulated/sky -o two-pictures

    Exit status: 0 the page is written, 1 something failed, 2 wrong usage.
    """
    from lab.gallery import pictures, run  # noqa: PLC0415 - it needs half of SciPy
    from lab.gallery.page import text, write_page  # noqa: PLC0415 - same

    shown = Display.of(context, quiet=quiet, verbose=verbose)
    named = os.environ.get(DATA_VARIABLE)
    folder = data or (Path(named) if named else None)
    began = time.monotonic()
    with as_usage():
        known = [] if folder is None else pictures.real_pictures(folder)
        chosen = pictures.chosen([*known, *pictures.simulated_pictures(output / run.CACHE)], only or [])

    def progress(words: str, done: int, total: int) -> None:
        shown.progress_line(f"{done} of {total} finished, {words}", time.monotonic() - began)

    entries = []
    for entry in run.entries_of(chosen, output, workers=workers, on_picture=progress):
        entries.append(entry)
        page = write_page(entries, output)  # after each: a run that is stopped leaves a page
    shown.result(text(entries))
    shown.note(f"written: {page}")
