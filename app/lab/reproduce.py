"""`lensmodel reproduce`."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from app.commands.console import display
from app.commands.console.failure import UsageError
from app.commands.console.files import refuse_existing
from app.commands.console.method_options import Estimator
from app.commands.console.options import Force, Quiet, Verbose

if TYPE_CHECKING:
    from lensmodel.lab.reproduce import Case, DirectRoute, OpenRoute, Size

DATA_VARIABLE = "LENSMODEL_TEST_DATA"
PAGE = ("reproduction.md", "reproduction.html")
"""What is in the folder of a finished reproduction, beside pictures and stored results."""


def reproduce(
    context: typer.Context,
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Folder for the page, its pictures and stored results.")
    ] = Path("reproduction"),
    json_output: Annotated[
        Path | None, typer.Option("--json", help="Also write every figure to this file.")
    ] = None,
    quick: Annotated[
        bool, typer.Option("--quick", help="Two lenses, small photos, n = 1, 2: minutes.")
    ] = False,
    full: Annotated[
        bool, typer.Option("--full", help="Two apertures a lens, n up to 20: takes all night.")
    ] = False,
    small: Annotated[
        bool, typer.Option("--small", help="All lenses, photos of a megapixel, no rivals: some hours.")
    ] = False,
    hard: Annotated[
        bool,
        typer.Option("--hard", help="Add difficult scenes: depth, motion, night, sky, snow, text, foliage."),
    ] = False,
    lenses: Annotated[
        int | None,
        typer.Option(
            "--lenses",
            metavar="N",
            min=1,
            help="Only the first N lenses of each family; a later run adds others.",
        ),
    ] = None,
    grids: Annotated[
        list[Path] | None,
        typer.Option(
            metavar="FILE",
            help="PSFs of a ray-traced lens, made by `python -m lensmodel.lab.traced make`; again for more. "
            "Default: the two of the repository.",
        ),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME", help="Only lenses whose name begins so: 1003, heliar; again for more."),
    ] = None,
    photos: Annotated[
        int | None,
        typer.Option(
            "--photos",
            metavar="N",
            min=1,
            help="Learn from at most N photos: the fewer, the larger the frames that the photographs allow.",
        ),
    ] = None,
    results: Annotated[
        Path | None,
        typer.Option(
            metavar="FOLDER",
            help="Where figures of each lens and number of photos are kept and taken from, so that several "
            "runs on several machines make one page. Default: cache in the output folder.",
        ),
    ] = None,
    paper: Annotated[
        bool | None,
        typer.Option(
            "--paper/--no-paper",
            help="The paper's own way too, which is slow. Default: yes, without --default-only.",
        ),
    ] = None,
    no_target: Annotated[
        bool, typer.Option("--no-target", help="Leave out the lens measured with a target, which is slow.")
    ] = False,
    no_rivals: Annotated[
        bool, typer.Option("--no-rivals", help="Leave out the paper's blind rivals, which are slow.")
    ] = False,
    default_only: Annotated[
        bool,
        typer.Option(
            "--default-only",
            help="Only the default correction, beside the true PSF: what the bars ask for, in less time.",
        ),
    ] = False,
    assert_bars: Annotated[
        bool,
        typer.Option(
            "--assert-bars",
            help="Fail where a bar is missed, and name each: the lens and zone of a fall too.",
        ),
    ] = False,
    no_figures: Annotated[
        bool, typer.Option("--no-figures", help="Leave Figs. 2 and 4 to a later run.")
    ] = False,
    direct: Annotated[
        bool, typer.Option("--direct", help="Use the library in this process, not a service.")
    ] = False,
    scenes: Annotated[
        Path | None,
        typer.Option(
            help="Folder of sharp photographs; its test half is used. Default: the folder sharp of "
            f"${DATA_VARIABLE} where that is set, else the library's five."
        ),
    ] = None,
    benchmark: Annotated[
        Path, typer.Option(help="Output of `lensmodel bench blind`: for Fig. 1, if it exists.")
    ] = Path("bench-output"),
    estimator: Estimator = "default",
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Make the paper's figures and its Table 1 on simulated lenses that nothing was tuned on.

    Each lens learns from Bayer DNG files uploaded to a service started for it; what the service
    answers and corrects is measured against the truth. Finished results are kept: a run that was
    stopped goes on, and a change of code or settings computes anew. A finished page is replaced
    only with --force.

    Examples:

        lensmodel reproduce --quick -o reproduction

        lensmodel reproduce --json reproduction.json

        lensmodel reproduce --only 1003 --results figures-so-far --no-figures -o sitting

    Exit status: 0 the page is written, 1 something failed or an asserted bar is missed, 2 called wrongly.
    """
    shown = display.of(context, quiet=quiet, verbose=verbose)
    if quick + small + full > 1:
        raise UsageError("--quick, --small and --full exclude each other; give one of them")
    if photos is not None and quick + small + full:
        raise UsageError("--photos is for the default size; leave out --quick, --small and --full")
    refuse_existing(json_output, *(output / name for name in PAGE), force=force)
    from app.lab.service_route import CODE, ServiceRoutes  # noqa: PLC0415 - only this command needs them
    from lensmodel.lab.reproduce import (  # noqa: PLC0415 - as above: the simulation is slow to import
        collected,
        missed,
        planned,
        run_reproduction,
        write_json,
        write_page,
    )

    size: Size = "quick" if quick else "small" if small else "full" if full else "default"
    plan = planned(
        size,
        scenes=scenes or _external(),
        estimator=estimator,
        hard=hard,
        lenses=lenses,
        grids=grids or None,
        only=only or (),
        photos=photos,
        paper=paper,
        target=not no_target,
        rivals=not no_rivals,
        default_only=default_only,
    )
    result = run_reproduction(
        plan,
        _direct(estimator) if direct else ServiceRoutes(estimator),
        output,
        route="in the library" if direct else "by the service",
        code=() if direct else CODE,
        with_figures=not no_figures,
        results=results,
        on_work=WorkLines(quiet=shown.quiet),
    )
    result["figures"]["fig1"] = collected(benchmark, output / "pictures")
    written = [*write_page(result, output)]
    if json_output is not None:
        written.append(write_json(result, json_output))
    shown.result(f"Code {result['code']}. Written: " + ", ".join(str(path) for path in written))
    if assert_bars and (lines := missed(result)):
        shown.error("\n".join(["these bars are missed:", *lines]))
        raise typer.Exit(1)


class WorkLines:
    """One line on standard error after each piece of work, with the time left."""

    def __init__(self, *, quiet: bool = False) -> None:
        self._quiet = quiet
        self._began = time.monotonic()
        self._stored = 0.0
        self._last = 0.0

    def __call__(self, words: str, done: float, total: float, *, fresh: bool) -> None:
        """Say what was done; see `OnWork`."""
        if not fresh:
            self._stored += done - self._last
        self._last = done
        if self._quiet:
            return
        spent, computed = time.monotonic() - self._began, done - self._stored
        left = ""
        if computed > 0 and done < total:
            seconds = spent / computed * (total - done)
            left = f", about {_duration(seconds)} left"
        typer.echo(f"[{100 * done / total:3.0f} %] {words}{left}", err=True)


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{seconds:.0f} s"
    minutes = round(seconds / 60)
    return f"{minutes} min" if minutes < 90 else f"{minutes // 60} h {minutes % 60} min"


def _external() -> Path | None:
    named = os.environ.get(DATA_VARIABLE)
    if not named:
        return None
    folder = Path(named) / "sharp"
    return folder if folder.is_dir() else None


def _direct(estimator: str) -> OpenRoute:
    from lensmodel.lab.reproduce import DirectRoute  # noqa: PLC0415 - as above

    @contextmanager
    def opened(case: Case, folder: Path) -> Iterator[DirectRoute]:
        del case
        yield DirectRoute(folder / "models", estimator)

    return opened
