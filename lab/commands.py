"""The laboratory's commands, `lensmodel bench` and `lensmodel reproduce`, which exist in the source tree.

The benchmarks are imported where they are run: they need half of SciPy, which no other command should
wait for.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

from lensmodel.cli.console import Display, Force, UsageError, clock
from lensmodel.cli.files import as_usage, refuse_existing
from lensmodel.core.types import StepHook

PAGE = ("reproduction.md", "reproduction.html", "reproduction.json")  # beside pictures and stored results
Size = Literal["quick", "default"]
Half = Literal["dev", "test", "all"]
DATA = "LENSMODEL_TEST_DATA"
Output = Annotated[Path, typer.Option("--output", "-o", help="Where to write: a folder.")]
BENCHMARK = Path("bench-output")  # where `lensmodel bench blind` leaves what Fig. 1 is drawn from

bench = typer.Typer(
    help="""Measure quality and speed.

    Example:

        lensmodel bench blind --help

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """,
    no_args_is_help=True,
)


@bench.command()
def gallery(
    data: Annotated[
        Path | None, typer.Option(envvar=DATA, help="Folder of test data with real photos.")
    ] = None,
    output: Output = Path("gallery-output"),
    only: Annotated[list[str] | None, typer.Option(help="Only pictures with this in their names.")] = None,
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Processes and threads.")] = 2,
) -> None:
    """A page to look at: each picture calibrated from itself and corrected, beside its original.

    Results are kept by the content of the photo and the version of the code: the same command again goes on.

    Example:

        lensmodel bench gallery --only simulated/snow --only simulated/sky -o two-pictures

    Exit status: 0 the page is written, 1 something failed, 2 wrong usage.
    """
    from lab.gallery import page, pictures  # noqa: PLC0415 - see the top of the module

    shown, began = Display(), time.monotonic()
    with as_usage():
        known = [] if data is None else pictures.real_pictures(data)
        chosen = pictures.chosen([*known, *pictures.simulated_pictures(output / page.CACHE)], only or [])
    entries = []
    for entry in page.entries_of(chosen, output, workers=workers, on_picture=told(shown, began)):
        entries.append(entry)
        written = page.write_page(entries, output)  # after each: a run that is stopped leaves a page
    shown.result(page.text(entries))
    shown.note(f"written: {written}")


def told(shown: Display, began: float) -> Callable[[str, int, int], None]:
    """Return what tells how much of long work is done."""
    return lambda words, done, total: shown.note(
        f"[{clock(time.monotonic() - began)}] {done} of {total} finished, {words}"
    )


@bench.command()
def blind(
    photos: Annotated[Path | None, typer.Option(help="Folder of sharp photographs.")] = None,
    noise: Annotated[str, typer.Option(help="Standard deviations, comma separated.")] = "0.01,0.003",
    methods: Annotated[
        str, typer.Option(help="Estimators, comma separated; also cho-lee, sun, xu-jia and zhang.")
    ] = "default,michaeli-irani",
    cases: Annotated[int | None, typer.Option(help="Largest number of cases.")] = None,
    scenes: Annotated[
        int | None, typer.Option(min=1, help="Windows, from the photographs in turn; default: one of each.")
    ] = None,
    half: Annotated[Half, typer.Option(help="Of photographs and PSFs.")] = "test",
    workers: Annotated[int, typer.Option(min=1)] = 2,
    output: Output = BENCHMARK,
    force: Force = False,
) -> None:
    """Blind PSF estimators on blurred patches with known truth (paper, section 5.1).

    Finished cases are kept; a run that was stopped goes on. A finished report is replaced only
    with --force.

    Examples:

        lensmodel bench blind --photos sharp --noise 0.01 --methods default -o mine

        lensmodel bench blind --photos sharp --scenes 80 --half all --cases 200

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """
    from lab.blind import benchmark  # noqa: PLC0415 - see the top of the module

    shown = Display()
    refuse_existing(*(output / name for name in benchmark.FILES), force=force)
    levels = tuple(_parts("--noise must be numbers such as 0.01,0.003", noise, float))
    with _bar(shown, "cases") as on_step:
        settings = benchmark.BlindBenchmark(photos, levels, _names(methods), half, cases, scenes=scenes)
        cache = output / "cache"
        report = benchmark.run_blind_benchmark(settings, workers=workers, cache=cache, on_step=on_step)
    written = benchmark.write_report(report, output)
    shown.result(benchmark.markdown_table(report))
    shown.note("written: " + ", ".join(str(path) for path in written))


@bench.command()
def model(
    seeds: Annotated[str, typer.Option(help="Of lenses, first:last, the last excluded.")] = "1000:1004",
    photos: Annotated[str, typer.Option(help="Numbers of photos, comma separated.")] = "1,5",
    methods: Annotated[str | None, typer.Option(help="Names, comma separated; default: all.")] = None,
) -> None:
    """Predictions of the lens model where no sample was, against other regressions.

    Example:

        lensmodel bench model --seeds 1000:1001 --photos 1 --methods eff-linear

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """
    from lab.model_benchmark import run_model_benchmark, table  # noqa: PLC0415 - see the top of the module

    shown, words = Display(), "give --seeds like 1000:1004 and --photos like 1,5"
    lenses, counts = range(*_parts(words, seeds, int, ":", 2)), _parts(words, photos, int)
    with _bar(shown, "fits") as on_step:
        named = None if methods is None else _names(methods)
        rows = run_model_benchmark(seeds=lenses, photos=counts, methods=named, on_step=on_step)
    shown.result(table(rows))


@bench.command()
def correct(
    photo: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A photo of yours; default: one of the library's.")
    ] = None,
    methods: Annotated[str, typer.Option(help="Names, comma separated.")] = "fast,standard,paper",
    workers: Annotated[int, typer.Option(min=1, metavar="N", help="Threads.")] = 1,
    repeats: Annotated[int, typer.Option(min=1, metavar="N", help="Runs; the median counts.")] = 1,
    peers: Annotated[bool, typer.Option("--peers", help="Time G'MIC, RawTherapee, darktable too.")] = False,
    raw: Annotated[bool, typer.Option("--raw", help="Each pixel of a picture keeps one colour.")] = False,
    roi: Annotated[str | None, typer.Option(metavar="T,L,H,W", help="Only this part.")] = None,
) -> None:
    """Time and memory of correcting a photo, and of the Richardson-Lucy step against its peers.

    Examples:

        lensmodel bench correct --methods fast

        lensmodel bench correct --photo mine.dng --methods fast,standard --workers 2

        lensmodel bench correct --photo scan.png --raw --methods fast,standard

    Exit status: 0 measured, 1 something failed, 2 wrong usage.
    """
    from lab.correction import correction_benchmark as timing  # noqa: PLC0415 - see the top of the module
    from lab.peers import PEERS, as_raw  # noqa: PLC0415 - same
    from lensmodel.photo import develop  # noqa: PLC0415 - same
    from lensmodel.simulate import demo_data_path  # noqa: PLC0415 - same

    shown = Display()
    if photo is not None and not photo.is_file():
        raise UsageError(f"no photo called {photo}; check the name and the folder")
    words = "--roi must be four whole numbers T,L,H,W"
    window: Any = None if roi is None else tuple(_parts(words, roi, int, length=4))
    developed = develop(photo or demo_data_path("lake.jpg"))
    if raw and developed.cfa is None:
        developed = as_raw(developed.planes)
    with _bar(shown, "methods") as on_step:
        result = timing.run_correct_benchmark(
            developed.planes, cfa=developed.cfa, methods=_names(methods), workers=workers, repeats=repeats,
            peers=PEERS if peers else (), roi=window, on_step=on_step,
        )  # fmt: skip
    shown.result(timing.correct_table(result))


def reproduce(
    output: Output = Path("reproduction"),
    size: Annotated[
        Size, typer.Option(help="Four lenses on small photos, or ten on 5 megapixels.")
    ] = "default",
    lens: Annotated[
        list[str] | None,
        typer.Option(help="Seed, or a file of `python -m lab.population grid`; again for more lenses."),
    ] = None,
    compare: Annotated[
        bool, typer.Option("--compare", help="Also the paper's own way, a rival, a target: hours.")
    ] = False,
    assert_bars: Annotated[bool, typer.Option("--assert-bars", help="Fail where a bar is missed.")] = False,
    force: Force = False,
) -> None:
    """Make the paper's figures and its Table 1 on simulated lenses.

    Nothing was tuned on them. Finished results are kept: a run that was stopped goes on, and a change of code
    or settings computes anew. A finished page is replaced only with --force.

    Examples:

        lensmodel reproduce --size quick -o reproduction

        lensmodel reproduce --lens 1003 --lens aspheric-f2.7.npz -o two-lenses

    Exit status: 0 the page is written, 1 something failed or an asserted bar is missed, 2 wrong usage.
    """
    shown = Display()
    refuse_existing(*(output / name for name in PAGE), force=force)
    from lab.reproduce.cases import planned  # noqa: PLC0415 - see the top of the module
    from lab.reproduce.job import run_reproduction  # noqa: PLC0415 - same
    from lab.reproduce.page import collected, write_json, write_page  # noqa: PLC0415 - same
    from lab.reproduce.tables import missed  # noqa: PLC0415 - same

    sharp = Path(os.environ.get(DATA, "nowhere")) / "sharp"
    scenes = sharp if sharp.is_dir() else None
    plan = planned(size, scenes=scenes, lenses=lens or (), compare=compare)
    on_work = told(shown, time.monotonic())
    result = run_reproduction(plan, output, on_work=on_work, workers=os.cpu_count() or 1)
    result["figures"]["fig1"] = collected(BENCHMARK, output / "pictures")
    written = [*write_page(result, output), write_json(result, output / PAGE[-1])]
    shown.result(f"Code {result['code']}. Written: " + ", ".join(str(path) for path in written))
    if assert_bars and (lines := missed(result)):
        shown.error("\n".join(["these bars are missed:", *lines]))
        raise typer.Exit(1)


@contextmanager
def _bar(shown: Display, what: str) -> Iterator[StepHook]:
    """Show how many of how many are done; a refused value is wrong usage."""
    with as_usage(), shown.progress(what) as bar:
        yield lambda done, total: bar.show(completed=done, total=total)


def _names(text: str) -> tuple[str, ...]:
    return tuple(part.strip() for part in text.split(","))


def _parts(words: str, text: str, kind: type, separator: str = ",", length: int | None = None) -> list[Any]:
    """Read numbers with separators; a refusal says how they look."""
    parts = text.split(separator)
    try:
        if length in (None, len(parts)):
            return [kind(part) for part in parts]
    except ValueError:
        pass
    raise UsageError(f"{words}, got {text!r}")
