"""`lensmodel bench`: accuracy and speed, on the library's material or one's own.

The benchmarks are imported where they are run: they need half of SciPy, which no other command should
wait for.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Final

import typer

from lab.commands.gallery import gallery
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.files import as_usage, refuse_existing
from lensmodel.cli.options import Force, Quiet, Verbose
from lensmodel.core.codec import to_json
from lensmodel.core.files import write_atomically

NOISE: Final = "0.01,0.003"
ESTIMATORS: Final = "default,michaeli-irani"
BLIND_OUTPUT: Final = Path("bench-output")
STANDARD_OUTPUT: Final = Path("-")
FINISHED: Final = ("blind.json", "blind.md")
"""What a finished report of `bench blind` consists of, beside its curves."""

JsonFile = Annotated[
    Path | None,
    typer.Option(
        "--json",
        metavar="FILE",
        help="Also write the figures to this file; - prints them instead of the table.",
    ),
]

bench = typer.Typer(
    help="""Measure quality and speed.

    Example:

        lensmodel bench blind --help

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """,
    no_args_is_help=True,
)

bench.command()(gallery)


@bench.command()
def blind(
    context: typer.Context,
    photos: Annotated[Path | None, typer.Option(help="Folder of sharp photographs.")] = None,
    psfs: Annotated[Path | None, typer.Option(help="npz with the key psf, shape (n, k, k).")] = None,
    noise: Annotated[str, typer.Option(help="Standard deviations, comma separated.")] = NOISE,
    methods: Annotated[
        str, typer.Option(help="Estimators, comma separated; also cho-lee, sun, xu-jia and zhang.")
    ] = ESTIMATORS,
    cases: Annotated[int | None, typer.Option(help="Largest number of cases.")] = None,
    scenes: Annotated[
        int | None,
        typer.Option(min=1, help="Number of windows, from the photographs in turn. Default: one of each."),
    ] = None,
    half: Annotated[str, typer.Option(help="dev, test or all.")] = "test",
    workers: Annotated[int, typer.Option(min=1)] = 2,
    output: Annotated[
        Path,
        typer.Option("--output", "-o", metavar="DIR", help="Where to write: a folder for tables and curves."),
    ] = BLIND_OUTPUT,
    json_output: JsonFile = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Blind PSF estimators on blurred patches with known truth (paper, section 5.1).

    Finished cases are kept; a run that was stopped goes on. A finished report is replaced only
    with --force.

    Examples:

        lensmodel bench blind --cases 12

        lensmodel bench blind --photos sharp --psfs mine.npz --noise 0.01 --methods default -o mine

        lensmodel bench blind --photos sharp --scenes 80 --half all --cases 200

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """
    from lab.blind.benchmark import (  # noqa: PLC0415 - see the top of the module
        BlindBenchmark,
        markdown_table,
        run_blind_benchmark,
        write_report,
    )

    shown = Display.of(context, quiet=quiet, verbose=verbose, as_json=json_output == STANDARD_OUTPUT)
    refuse_existing(_file(json_output), *(output / name for name in FINISHED), force=force)
    with as_usage():
        settings = BlindBenchmark(
            photos=photos,
            psfs=psfs,
            noise=_levels(noise),
            methods=_names(methods),
            half=half,  # type: ignore[arg-type]  # checked by the benchmark
            cases=cases,
            scenes=scenes,
        )
    with as_usage(), shown.progress() as bars:
        task = bars.add_task("cases", total=None)
        report = run_blind_benchmark(
            settings,
            workers=workers,
            cache=output / "cache",
            on_step=lambda done, total: bars.update(task, completed=done, total=total),
        )
    written = write_report(report, output)
    _tell(shown, json_output, report.to_json(), markdown_table(report))
    shown.note("written: " + ", ".join(str(path) for path in written))


@bench.command()
def model(
    context: typer.Context,
    seeds: Annotated[
        str, typer.Option(metavar="FIRST:LAST", help="Simulated lenses, the last excluded.")
    ] = "1000:1004",
    photos: Annotated[str, typer.Option(help="Numbers of photos, comma separated.")] = "1,5",
    methods: Annotated[str | None, typer.Option(help="Names, comma separated; default: all.")] = None,
    json_output: JsonFile = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Predictions of the lens model where no sample was, against other regressions.

    Examples:

        lensmodel bench model --seeds 1000:1001 --photos 1 --methods eff-linear

        lensmodel bench model --json model.json

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """
    shown = Display.of(context, quiet=quiet, verbose=verbose, as_json=json_output == STANDARD_OUTPUT)
    refuse_existing(_file(json_output), force=force)
    try:
        first, last = (int(part) for part in seeds.split(":"))
        counts = [int(part) for part in photos.split(",")]
    except ValueError as error:
        raise UsageError(
            f"give --seeds like 1000:1004 and --photos like 1,5, got {seeds} and {photos}"
        ) from error
    from lab.model.model_benchmark import run_model_benchmark, table  # noqa: PLC0415 - see the top of the module

    with as_usage(), shown.progress() as bars:
        task = bars.add_task("fits", total=None)
        result = run_model_benchmark(
            seeds=range(first, last),
            photos=counts,
            methods=None if methods is None else _names(methods),
            on_step=lambda done, total: bars.update(task, completed=done, total=total),
        )
    _tell(shown, json_output, result, table(result))


@bench.command()
def correct(
    context: typer.Context,
    photo: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A photo of yours; default: one of the library's.")
    ] = None,
    methods: Annotated[str, typer.Option(help="Names, comma separated.")] = "fast,standard,paper",
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Threads.")] = 1,
    repeats: Annotated[int, typer.Option(min=1, metavar="N", help="Runs; the median counts.")] = 1,
    peers: Annotated[
        bool, typer.Option("--peers", help="Time G'MIC, RawTherapee and darktable too, where installed.")
    ] = False,
    raw: Annotated[
        bool, typer.Option("--raw", help="Make a RAW photo of a picture: each pixel keeps one colour.")
    ] = False,
    roi: Annotated[
        str | None, typer.Option(metavar="T,L,H,W", help="Only this part, in the cells of the whole photo.")
    ] = None,
    beside: Annotated[
        int | None, typer.Option(min=1, metavar="N", help="Compare CPU time with that of N threads.")
    ] = None,
    json_output: JsonFile = None,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Time and memory of correcting a photo, and of the Richardson-Lucy step against its peers.

    Examples:

        lensmodel bench correct --methods fast

        lensmodel bench correct --photo mine.dng --methods fast,standard --workers 2 --json correct.json

        lensmodel bench correct --photo scan.png --raw --methods fast,standard

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """
    from lab.correction.correction_benchmark import (  # noqa: PLC0415 - see the top of the module
        correct_table,
        run_correct_benchmark,
    )
    from lab.peers import PEERS, as_raw  # noqa: PLC0415 - same
    from lensmodel.photo import develop  # noqa: PLC0415 - same
    from lensmodel.simulate import demo_data_path  # noqa: PLC0415 - same

    shown = Display.of(context, quiet=quiet, verbose=verbose, as_json=json_output == STANDARD_OUTPUT)
    refuse_existing(_file(json_output), force=force)
    if photo is not None and not photo.is_file():
        raise UsageError(f"no photo called {photo}; check the name and the folder")
    window = _window(roi)
    developed = develop(photo or demo_data_path("lake.jpg"))
    if raw and developed.cfa is None:
        developed = as_raw(developed.planes)
    with as_usage(), shown.progress() as bars:
        task = bars.add_task("methods", total=None)
        result = run_correct_benchmark(
            developed.planes,
            cfa=developed.cfa,
            methods=_names(methods),
            workers=workers,
            repeats=repeats,
            peers=PEERS if peers else (),
            roi=window,
            beside=beside,
            on_step=lambda done, total: bars.update(task, completed=done, total=total),
        )
    _tell(shown, json_output, result, correct_table(result))


def _window(text: str | None) -> tuple[int, int, int, int] | None:
    if text is None:
        return None
    try:
        top, left, height, width = (int(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"--roi must be four whole numbers T,L,H,W, got {text!r}") from error
    return top, left, height, width


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _levels(text: str) -> tuple[float, ...]:
    try:
        return tuple(float(part) for part in text.split(","))
    except ValueError as error:
        raise UsageError(f"--noise must be numbers such as 0.01,0.003, got {text!r}") from error


def _file(json_output: Path | None) -> Path | None:
    return None if json_output == STANDARD_OUTPUT else json_output


def _tell(shown: Display, json_output: Path | None, result: object, words: str) -> None:
    """Print the table, or the figures where they were asked for; write them where a file was named."""
    if json_output == STANDARD_OUTPUT:
        shown.document(result)
        return
    shown.result(words)
    if json_output is not None:
        json_output.parent.mkdir(parents=True, exist_ok=True)
        write_atomically(json_output, json.dumps(to_json(result), indent=1).encode())
