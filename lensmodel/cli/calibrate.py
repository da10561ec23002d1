"""`lensmodel calibrate`: learn the blur of one lens from photos, here or on a cluster, into a profile."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from lensmodel.blind import estimators
from lensmodel.cli import files
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import AnyLens, Aperture, Json, Photos, Profile, Quiet, Verbose, Workers, choice
from lensmodel.core import processes
from lensmodel.core.errors import InvalidInputError
from lensmodel.core.types import ZONE_WORDS, LensSettings
from lensmodel.model import LensProfile, save_profile
from lensmodel.patches import selectors
from lensmodel.workflow import calibrating, sampling
from lensmodel.workflow.calibrating import AHEAD
from lensmodel.workflow.lens import Lens
from lensmodel.workflow.sampling import PRESETS, preset_of

Selector = Annotated[
    str, typer.Option(metavar="NAME", help=f"How patches of a photo are chosen: {', '.join(selectors)}.")
]


def calibrate(
    context: typer.Context,
    photos: Photos,
    profile: Profile = None,
    aperture: Aperture = None,
    model: Annotated[
        str | None,
        choice(
            "--model",
            tuple(PRESETS),
            "paper: the paper's method alone, for comparison: kernels by Michaeli and Irani, their "
            "regression, and correction by Richardson-Lucy. A profile keeps its model.",
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help=f"Blind estimator: {', '.join(estimators)}; default: that of the model."
        ),
    ] = None,
    kernel_size: Annotated[
        int | None,
        typer.Option(
            metavar="PIXELS",
            help="Side of the kernels, an odd number from 3 to 55; default: 31, with --model paper 55.",
        ),
    ] = None,
    selector: Selector = "r-map",
    workers: Workers = None,
    scheduler: Annotated[
        str | None,
        typer.Option(metavar="ADDRESS", help="Address of a Dask cluster that estimates the photos."),
    ] = None,
    any_lens: AnyLens = False,
    force: Annotated[
        bool, typer.Option("--force", help="Discard what the profile holds; begin anew.")
    ] = False,
    json_output: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Learn the blur of one lens from photos and write it to a profile.

    An existing profile is added to. Photos that it was learned from are skipped, and it is
    saved after each photo: a run that was stopped goes on where it was. In folders, JPEG, TIFF and PNG files
    beside a RAW file of the same name are passed over, and so are corrected photos. --scheduler lets
    a Dask cluster do the work; give its address, such as tcp://10.0.0.1:8786.

    Examples:

        lensmodel calibrate holiday --profile my-24mm.lensprofile

        lensmodel calibrate 'holiday/*.dng' one-more.dng --profile my-24mm.lensprofile --workers 1

        lensmodel calibrate scan.tif --aperture 2.8 --profile old-lens.lensprofile

    Exit status: 0 all photos counted, 1 some did not, 2 wrong usage.
    """
    shown, target = Display.of(context, quiet=quiet, verbose=verbose), files.named(profile)
    paths = files.photos(photos)
    files.refuse_photo(target, paths)
    with files.as_usage():
        config = sampling.Config(LensSettings(aperture=aperture), model, estimator, kernel_size, selector)
        config.check()
    results: list[dict[str, Any]] = []
    with shown.progress() as bars:
        task = bars.add_task("", total=len(paths))

        def on_event(event: sampling.CalibrationEvent) -> None:
            share = event.done / event.total if event.total else 0.0
            bars.update(
                task, description=f"{event.photo.name}: {event.stage}", completed=len(results) + share
            )

        with executor_of(scheduler) as (executor, ahead), processes.pool(None, workers) as pool:
            store = ProfileFile(target, model, force=force)
            calibration = calibrating.Calibration(store, config, any_lens=any_lens, pool=pool)
            for verdict in calibration.learn(paths, executor, ahead=ahead, on_event=on_event):
                results.append({"photo": str(verdict.photo), **_result(verdict, shown)})
                bars.update(task, completed=len(results))
    lens = calibration.known
    coverage = {} if lens is None else lens.model.coverage()
    photo_count, sample_count = (len(lens.profile.photos), len(lens.samples)) if lens else (0, 0)
    failed = [result for result in results if result["state"] == "failed"]
    if json_output:
        shown.document(
            {
                "profile": str(target) if lens else None,
                "photos": photo_count,
                "samples": sample_count,
                "coverage": coverage,
                "model": preset_of(lens.model).name if lens else None,
                "results": results,
            }
        )
    elif lens is not None and len(failed) < len(results):
        cover = ", ".join(f"{ZONE_WORDS[zone]} {count}" for zone, count in coverage.items())
        shown.result(f"{target}: photos {photo_count}, samples {sample_count} ({cover})")
    if lens is None:
        shown.error(
            "no photo could be used, so there is no profile; the lines above say what each photo needs"
        )
    if failed:
        raise typer.Exit(1)


_ZIP: Final = b"PK"  # First bytes of a profile, damaged or not: the signature of a ZIP file


def _result(verdict: calibrating.PhotoVerdict, display: Display) -> dict[str, Any]:
    """Say what became of a photo, at once and in the document."""
    if verdict.error is not None:
        result = files.failed(verdict.error)
        display.error(f"{verdict.photo}: {result['reason']}")
        return result
    if verdict.samples is None:
        display.note(f"{verdict.photo}: the profile has it already")
        return {"state": "known"}
    return {"state": "counted", "samples": verdict.samples}


class ProfileFile(calibrating.LensStore):
    """The store of a lens in a file.

    Another run may add to the same file meanwhile: the profile is read again whenever the file has
    changed, so that no run drops what another one learned.
    """

    def __init__(self, target: Path, model: str | None = None, *, force: bool = False) -> None:
        super().__init__()
        self._target, self._model = target, model
        self._stamp_read = _stamp(target) if force else None

    def lens(self) -> Lens | None:
        """Return the lens, read anew if another run changed the file."""
        stamp = _stamp(self._target)
        if stamp not in {None, self._stamp_read}:
            profile = _opened(self._target)
            learned = preset_of(profile.model).name
            if self._model not in {None, learned}:  # its kernels are the other model's: both would be mixed
                raise InvalidInputError(
                    f"the lens in {self._target.name} has the model {learned}, not {self._model}: name a new "
                    "file after --profile and give its photos again, or replace the file with --force"
                )
            self._lens, self._stamp_read = Lens(profile), stamp
        return self._lens

    def keep(self, lens: Lens) -> None:
        """Save the lens."""
        self._target.parent.mkdir(parents=True, exist_ok=True)
        save_profile(self._target, lens.profile)
        self._lens, self._stamp_read = lens, _stamp(self._target)


def _opened(target: Path) -> LensProfile:
    try:
        return files.profile_at(target)
    except InvalidInputError as error:
        with target.open("rb") as file:
            damaged = file.read(len(_ZIP)) == _ZIP
        remedy = "--force replaces the file" if damaged else "name a new file after --profile"
        raise InvalidInputError(f"{error}; {remedy}") from error


def _stamp(path: Path) -> tuple[int, int, int] | None:
    """Return inode, size and time of a file, which change when it is replaced; None without file."""
    try:
        status = path.stat()
    except FileNotFoundError:
        return None
    return status.st_ino, status.st_size, status.st_mtime_ns


# Seconds to reach the scheduler of a cluster (chosen): one in the same network answers at once
CONNECT_S = 10.0


@contextmanager
def executor_of(scheduler: str | None) -> Iterator[tuple[Executor | None, int]]:
    """Give the executor of a cluster, and how many photos to send ahead; None without a cluster.

    Only the bytes of photos and the samples travel: the machines need lensmodel, and none of the files.
    """
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
