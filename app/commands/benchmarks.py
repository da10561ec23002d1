"""`lensmodel bench`: accuracy and speed, on the library's material or one's own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from app.commands import display
from app.commands.failure import UsageError
from app.commands.options import Force
from lensmodel.bench.blind import BlindBenchmark, run_blind_benchmark
from lensmodel.bench.correct import run_correct_benchmark
from lensmodel.bench.model import run_model_benchmark, table
from lensmodel.bench.report import markdown_table, write_report
from lensmodel.codec import to_json
from lensmodel.photo import develop
from lensmodel.simulate import demo_data_path

bench = typer.Typer(help="Measure quality and speed.", invoke_without_command=True)


@bench.callback()
def default(context: typer.Context) -> None:
    """Measure quality and speed; without a name, a short run of each."""
    if context.invoked_subcommand is None:
        blind(cases=12, output=Path("bench-output"))
        model(seeds="1000:1002")
        correct(methods="fast,standard")


@bench.command()
def blind(
    photos: Annotated[Path | None, typer.Option(help="Folder of sharp photographs.")] = None,
    psfs: Annotated[Path | None, typer.Option(help="npz with the key psf, shape (n, k, k).")] = None,
    noise: Annotated[str, typer.Option(help="Standard deviations, comma separated.")] = "0.01,0.003",
    methods: Annotated[
        str, typer.Option(help="Estimators, comma separated.")
    ] = "default,michaeli-irani,whittle",
    patch: Annotated[int, typer.Option(help="Side of a patch.")] = 256,
    cases: Annotated[int | None, typer.Option(help="At most so many.")] = None,
    pool: Annotated[int, typer.Option(help="Patches that share one kernel.")] = 1,
    half: Annotated[str, typer.Option(help="dev, test or all.")] = "test",
    variant: Annotated[str, typer.Option(help="gaussian, bayer or jpeg.")] = "gaussian",
    judge: Annotated[str, typer.Option(help="hyper-laplacian or epll.")] = "hyper-laplacian",
    seed: int = 0,
    workers: Annotated[int, typer.Option(min=1)] = 2,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for tables and curves.")] = Path(
        "bench-output"
    ),
    json_output: Annotated[
        Path | None, typer.Option("--json", help="Also write the figures to this file.")
    ] = None,
    force: Force = False,
) -> None:
    """Blind PSF estimators on blurred patches with known truth (paper, section 5.1).

    Finished cases are kept; a run that was stopped goes on.

    Examples:

        lensmodel bench blind --cases 12

        lensmodel bench blind --photos sharp/ --psfs mine.npz --noise 0.01 --methods default
    """
    _refuse_existing(json_output, force=force)
    try:
        levels = tuple(float(part) for part in noise.split(","))
    except ValueError as error:
        raise UsageError(f"noise must be numbers such as 0.01,0.003, got {noise!r}") from error
    settings = BlindBenchmark(
        photos=photos,
        psfs=psfs,
        noise=levels,
        methods=tuple(part.strip() for part in methods.split(",")),
        half=half,  # type: ignore[arg-type]  # checked by the benchmark
        cases=cases,
        patch=patch,
        pool=pool,
        variant=variant,  # type: ignore[arg-type]  # checked by the benchmark
        judge=judge,
        seed=seed,
    )
    with display.progress() as bars:
        task = bars.add_task("cases", total=None)
        report = run_blind_benchmark(
            settings,
            workers=workers,
            cache=output / "cache",
            on_step=lambda done, total: bars.update(task, completed=done, total=total),
        )
    written = write_report(report, output)
    _write_json(json_output, report.to_json())
    typer.echo(markdown_table(report))
    typer.echo("Written: " + ", ".join(str(path) for path in written))


@bench.command()
def model(
    seeds: Annotated[
        str, typer.Option(metavar="FIRST:LAST", help="Simulated lenses, the last excluded.")
    ] = "1000:1004",
    photos: Annotated[str, typer.Option(help="Numbers of photos, comma separated.")] = "1,5",
    methods: Annotated[str | None, typer.Option(help="Names, comma separated; default: all.")] = None,
    psf_field: Annotated[
        Path | None, typer.Option(metavar="FILE", help="npz of measured PSFs instead of simulated lenses.")
    ] = None,
    json_output: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures to this file.")
    ] = None,
    force: Force = False,
) -> None:
    """Predictions of the lens model where no sample was, against other regressions.

    Examples:

        lensmodel bench model --seeds 1000:1001 --photos 1 --methods eff-linear

        lensmodel bench model --psf-field mine.npz --json model.json
    """
    _refuse_existing(json_output, force=force)
    try:
        first, last = (int(part) for part in seeds.split(":"))
        counts = [int(part) for part in photos.split(",")]
    except ValueError as error:
        raise UsageError(
            f"give --seeds like 1000:1004 and --photos like 1,5, got {seeds} and {photos}"
        ) from error
    result = run_model_benchmark(
        seeds=range(first, last),
        photos=counts,
        methods=None if methods is None else [part.strip() for part in methods.split(",")],
        psf_field=psf_field,
    )
    typer.echo(table(result))
    _write_json(json_output, result)


@bench.command()
def correct(
    photo: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A photo of yours; default: one of the library's.")
    ] = None,
    methods: Annotated[str, typer.Option(help="Names, comma separated.")] = "fast,standard,paper",
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Threads.")] = 1,
    json_output: Annotated[
        Path | None, typer.Option("--json", metavar="FILE", help="Also write the figures to this file.")
    ] = None,
    force: Force = False,
) -> None:
    """Time and memory of correcting a photo, and of the Richardson-Lucy step against its peers.

    Examples:

        lensmodel bench correct --methods fast

        lensmodel bench correct --photo mine.dng --methods fast,standard --workers 2 --json correct.json
    """
    _refuse_existing(json_output, force=force)
    planes = develop(photo or demo_data_path("lake.jpg")).planes
    with display.progress() as bars:
        task = bars.add_task("methods", total=None)
        result = run_correct_benchmark(
            planes,
            methods=[part.strip() for part in methods.split(",")],
            workers=workers,
            on_step=lambda done, total: bars.update(task, completed=done, total=total),
        )
    typer.echo(_speeds(result))
    _write_json(json_output, result)


def _speeds(result: dict[str, Any]) -> str:
    lines = [
        f"{result['megapixels']:.2f} megapixels, workers {result['workers']}; {result['machine']}",
        "| method | wall s | CPU s | CPU s per megapixel and channel | memory so far MiB |",
        "|---|---|---|---|---|",
    ]
    lines += [
        f"| {name} | {row['wall_s']:.2f} | {row['cpu_s']:.2f} | {row['cpu_s_per_mp_channel']:.2f} "
        f"| {row['peak_mib']:.0f} |"
        for name, row in result["methods"].items()
    ]
    return "\n".join(lines)


def _refuse_existing(path: Path | None, *, force: bool) -> None:
    if path is not None and path.exists() and not force:
        raise UsageError(f"{path} is there already; --force replaces it")


def _write_json(path: Path | None, result: object) -> None:
    if path is not None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with display.atomic(path) as part:
            part.write_text(json.dumps(to_json(result), indent=1), encoding="utf-8")
