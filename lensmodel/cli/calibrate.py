"""`lensmodel calibrate`: learn the blur of one lens from photos, here or on a cluster, into a profile."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import import_module
from typing import Annotated, Any, Literal

import typer

from lensmodel.api import AHEAD, Calibration
from lensmodel.blind import estimators
from lensmodel.blind.sampling import CalibrationEvent, configured
from lensmodel.cli import console, files
from lensmodel.cli.console import Display, UsageError
from lensmodel.core import processes
from lensmodel.core.types import LensSettings
from lensmodel.patches import selectors


def calibrate(
    photos: console.Photos,
    profile: console.Profile,
    aperture: console.Aperture = None,
    model: Annotated[
        Literal["default", "paper"] | None,
        typer.Option(help="paper: the paper's method alone, for comparison. A profile keeps its model."),
    ] = None,
    estimator: Annotated[
        str | None, typer.Option(help=f"{', '.join(estimators)}; default: that of the model.")
    ] = None,
    kernel_size: Annotated[
        int | None,
        typer.Option(help="Side of the kernels, odd, 3 to 55; default: 55, of an estimator of one place 31."),
    ] = None,
    selector: Annotated[str, typer.Option(help=f"Of patches: {', '.join(selectors)}.")] = "r-map",
    workers: console.Workers = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a Dask cluster that estimates the photos.")
    ] = None,
    any_lens: console.AnyLens = False,
    force: Annotated[
        bool, typer.Option("--force", help="Discard what the profile holds; begin anew.")
    ] = False,
    json_output: console.Json = False,
    quiet: console.Quiet = False,
    verbose: console.Verbose = 0,
) -> None:
    """Learn the blur of a lens from photos.

    It is written to a profile; an existing one is added to. Photos that it was learned from are skipped,
    and it is saved after each photo: a run that was stopped goes on where it was. In folders, JPEG, TIFF and
    PNG files beside a RAW file of the same name are passed over, and so are corrected photos. --scheduler
    lets a Dask cluster do the work; give its address, such as tcp://10.0.0.1:8786.

    Examples:

        lensmodel calibrate holiday --profile my-24mm.lensprofile

        lensmodel calibrate scan.tif --aperture 2.8 --profile old-lens.lensprofile

    Exit status: 0 all photos counted, 1 some did not, 2 wrong usage.
    """
    shown = Display(quiet=quiet, verbose=verbose, as_json=json_output)
    paths = files.photos(photos, shown.note)
    files.refuse_photo(profile, paths)
    store = files.ProfileFile(profile, model, force=force)
    with files.as_usage():
        given = LensSettings(aperture=aperture)
        config = configured(
            store.model, given, estimator=estimator, kernel_size=kernel_size, selector=selector
        )
    results: list[dict[str, Any]] = []
    with shown.progress(total=len(paths)) as bar:

        def on_event(event: CalibrationEvent) -> None:
            bar.part(len(results), event.done, event.total, f"{event.photo.name}: {event.stage}")

        with executor_of(scheduler) as (executor, ahead), processes.pool(None, workers) as pool:
            calibration = Calibration(store, config, any_lens=any_lens, pool=pool)
            for event in calibration.learn(paths, executor, ahead=ahead, on_event=on_event):
                result: dict[str, Any] = {"state": "counted", "samples": event.total}
                if event.error is not None:
                    result = files.failed(event.error)
                    shown.error(f"{event.photo}: {result['reason']}")
                elif event.stage == "skipped":
                    result = {"state": "known"}
                    shown.note(f"{event.photo}: the profile has it already")
                else:
                    shown.detail(f"{event.photo}: {event.total} samples")
                results.append({"photo": str(event.photo), **result})
                bar.show(len(results))
    lens, failed = calibration.known, sum(result["state"] == "failed" for result in results)
    found: dict[str, Any] = {"profile": None, "photos": 0, "samples": 0, "coverage": {}, "model": None}
    if lens is not None:
        photo_count, coverage = len(lens.photos), lens.model.coverage()
        found = {"profile": str(profile), "photos": photo_count, "samples": len(lens.samples)}
        found |= {"coverage": coverage, "model": lens.model.mode}
        if failed < len(results):
            shown.result(f"{profile}: photos {photo_count}, blur measured at {sum(coverage.values())} places")
    shown.document({**found, "results": results})
    if failed:
        raise typer.Exit(1)


# Seconds to reach the scheduler of a cluster (chosen): one in the same network answers at once
CONNECT_S = 10.0


@contextmanager
def executor_of(scheduler: str | None) -> Iterator[tuple[Executor | None, int]]:
    """Give the executor of a cluster, and how many photos to send ahead, as bytes; None without a cluster."""
    if scheduler is None:
        yield None, AHEAD
        return
    try:
        dask: Any = import_module("distributed")  # an extra, loaded only where it is asked for
    except ImportError as error:
        raise UsageError("--scheduler needs Dask: pip install 'lensmodel[cluster]'") from error
    try:
        client = dask.Client(scheduler, timeout=CONNECT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        raise UsageError(f"--scheduler {scheduler}: no cluster answers there ({error})") from error
    with client, client.get_executor(pure=False) as executor:
        threads = sum(client.nthreads().values())
        if not threads:
            raise UsageError(f"--scheduler {scheduler}: it has no workers; start some by `dask worker`")
        yield executor, 2 * threads
