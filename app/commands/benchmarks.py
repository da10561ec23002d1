"""`lensmodel bench`: accuracy and speed, on the library's material or one's own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import typer

from app.commands import display
from lensmodel.bench.blind import BlindBenchmark, run_blind_benchmark
from lensmodel.bench.report import markdown_table, write_report
from lensmodel.errors import InvalidInputError

bench = typer.Typer(help="Measure quality and speed.", invoke_without_command=True)


@bench.callback()
def default(context: typer.Context) -> None:
    """Measure quality and speed; without a name, a short run of each."""
    if context.invoked_subcommand is None:
        blind(cases=12, output=Path("bench-output"))


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
) -> None:
    """Blind PSF estimators on blurred patches with known truth (paper, section 5.1).

    Finished cases are kept; a run that was stopped goes on.

    Examples:

        lensmodel bench blind --cases 12

        lensmodel bench blind --photos sharp/ --psfs mine.npz --noise 0.01 --methods default
    """
    try:
        levels = tuple(float(part) for part in noise.split(","))
    except ValueError as error:
        raise InvalidInputError(f"noise must be numbers such as 0.01,0.003, got {noise!r}") from error
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
    if json_output is not None:
        json_output.write_text(json.dumps(report.to_json(), indent=1), encoding="utf-8")
    typer.echo(markdown_table(report))
    typer.echo("Written: " + ", ".join(str(path) for path in written))
