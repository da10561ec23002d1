"""`lensmodel calibrate`, `correct` and `psf`: without a service, on files."""

from __future__ import annotations

import glob
import json
import sys
from collections.abc import Iterable
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from PIL import Image
from rich.progress import Progress, TaskID

from app.commands import display
from lensmodel import pipeline, quality
from lensmodel.codec import to_json
from lensmodel.errors import InvalidInputError, LensModelError
from lensmodel.geometry import zone_of
from lensmodel.photo import inspect
from lensmodel.psf import rms_width
from lensmodel.regression import LensModel, LensProfile, load_profile, save_profile
from lensmodel.types import CHANNELS, Channel, FieldPosition, LensSettings

_RAW = (".dng", ".nef", ".cr2", ".cr3", ".crw", ".arw", ".raf", ".orf", ".rw2", ".pef", ".srw")
SUFFIXES = frozenset({*_RAW, ".tif", ".tiff", ".png", ".jpg", ".jpeg"})
EXTENSION = {"tiff16": ".tif", "png16": ".png", "png8": ".png", "jpeg": ".jpg", "dng": ".dng"}

Photos = Annotated[
    list[str], typer.Argument(metavar="PHOTO...", help="Files, folders or patterns such as '*.dng'.")
]
Profile = Annotated[Path, typer.Option("--profile", "-p", help="The lens profile file.")]
Aperture = Annotated[
    float | None, typer.Option("--aperture", "-a", help="f-number, where the file does not say.")
]
Json = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]


def expand(names: Iterable[str]) -> list[Path]:
    """Turn files, folders and patterns into a sorted list of photos without repeats.

    Raises
    ------
    InvalidInputError
        If a name matches nothing.
    """
    found: dict[Path, None] = {}
    for name in names:
        path = Path(name)
        if path.is_dir():
            matches = sorted(p for p in path.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
        elif path.is_file():
            matches = [path]
        else:
            matches = sorted(Path(p) for p in glob.glob(name, recursive=True) if Path(p).is_file())  # noqa: PTH207 - absolute patterns too
        if not matches:
            raise InvalidInputError(f"no photo at {name!r}; check the name, or quote the pattern")
        found.update(dict.fromkeys(matches))
    return list(found)


def calibrate(
    photos: Photos,
    profile: Profile,
    aperture: Aperture = None,
    estimator: Annotated[
        str, typer.Option(help="Blind estimator: default, michaeli-irani, whittle.")
    ] = "default",
    workers: Annotated[int | None, typer.Option(help="Processes; default: all cores.", min=1)] = None,
    json_output: Json = False,
) -> None:
    """Learn the blur of one lens from photos, into a profile.

    An existing profile is added to: photos that it has seen already are skipped, and it is saved
    after each photo, so an interrupted run goes on where it stopped.

    Examples:

        lensmodel calibrate holiday/*.dng --profile my-24mm.lensprofile

        lensmodel calibrate scan.tif --aperture 2.8 --profile old-lens.lensprofile
    """
    known = load_profile(profile) if profile.exists() else None
    names = dict(known.photos) if known else {}
    lens = dict(known.lens) if known else {}
    results: list[dict[str, Any]] = []
    paths = expand(photos)
    with display.progress() as bars:
        overall = bars.add_task("photos", total=len(paths))
        for path in paths:
            task = bars.add_task(path.name, total=None)

            def show(event: pipeline.CalibrationEvent, task: Any = task, path: Path = path) -> None:  # noqa: ANN401 - an id of the display
                bars.update(
                    task,
                    description=f"{path.name}: {event.stage}",
                    completed=event.done,
                    total=event.total or None,
                )

            result: dict[str, Any] = {"photo": str(path)}
            try:
                key = pipeline.photo_id(path)
                if key in names:
                    result["state"] = "known"
                else:
                    _same_lens(lens, path)
                    samples = pipeline.samples_of_photo(
                        path,
                        settings=LensSettings(aperture=aperture),
                        estimator=estimator,
                        workers=workers,
                        on_event=show,
                    )
                    model = known.model.added(samples) if known else LensModel.fit(samples)
                    names[key] = path.name
                    known = LensProfile(model, lens, names)
                    save_profile(profile, known)
                    result |= {"state": "counted", "samples": len(samples)}
            except LensModelError as error:
                result |= {"state": "failed", "code": error.code, "reason": str(error)}
                typer.echo(f"lensmodel: {path.name}: {error}", err=True)
            results.append(result)
            bars.remove_task(task)
            bars.advance(overall)
    if known is None:
        raise LensModelError("no photo could be used, so no profile was written")
    summary = {
        "profile": str(profile),
        "photos": len(known.photos),
        "samples": len(known.model.samples),
        "coverage": known.model.coverage(),
        "results": results,
    }
    if json_output:
        typer.echo(json.dumps(to_json(summary), indent=2))
    else:
        cover = ", ".join(f"{zone} {count}" for zone, count in known.model.coverage().items())
        typer.echo(f"{profile}: {summary['photos']} photos, {summary['samples']} samples ({cover})")
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _same_lens(lens: dict[str, str], path: Path) -> None:
    """Refuse a photo of another copy; remember the first one's identity."""
    seen = inspect(path).metadata.lens
    for name in ("maker", "model", "serial"):
        value = getattr(seen, name)
        if value and lens.setdefault(name, value) != value:
            raise InvalidInputError(
                f"it was taken with another lens ({name} {value}, the profile has {lens[name]}); "
                "give it a profile of its own"
            )


def correct(
    photos: Photos,
    profile: Profile,
    output: Annotated[Path, typer.Option("--output", "-o", help="Folder for the corrected photos.")],
    method: Annotated[
        str, typer.Option(help="standard, fast, paper, or another registered name.")
    ] = "standard",
    strength: Annotated[
        float, typer.Option(min=0.0, max=1.0, help="0 nothing, 1 all that the noise allows.")
    ] = 1.0,
    file_format: Annotated[str, typer.Option("--format", help="tiff16, png16, png8, jpeg.")] = "tiff16",
    aperture: Aperture = None,
    workers: Annotated[int, typer.Option(help="Threads.", min=1)] = 2,
    force: Annotated[bool, typer.Option("--force", help="Replace files that are there already.")] = False,
    json_output: Json = False,
) -> None:
    """Remove the blur of the lens from photos.

    Corrected photos are new files, NAME-corrected; what is there already is left alone, so an
    interrupted run goes on where it stopped.

    Examples:

        lensmodel correct holiday/*.dng --profile my-24mm.lensprofile -o corrected

        lensmodel correct one.jpg --profile my-24mm.lensprofile -o . --format jpeg --strength 0.7
    """
    if file_format not in EXTENSION:
        raise InvalidInputError(f"no format {file_format!r}; known: {', '.join(EXTENSION)}")
    model = load_profile(profile).model
    output.mkdir(parents=True, exist_ok=True)
    results: list[dict[str, Any]] = []
    with display.progress() as bars:
        for path in expand(photos):
            target = output / f"{path.stem}-corrected{EXTENSION[file_format]}"
            result: dict[str, Any] = {"photo": str(path), "output": str(target)}
            results.append(result)
            if target.exists() and not force:
                result["state"] = "kept"
                typer.echo(f"lensmodel: {target} is there already; --force replaces it", err=True)
                continue
            task = bars.add_task(path.name, total=None)
            try:
                corrected = pipeline.correct(
                    path,
                    model,
                    target,
                    settings=LensSettings(aperture=aperture),
                    method=method,
                    strength=strength,
                    file_format=file_format,  # type: ignore[arg-type]  # checked above
                    workers=workers,
                    on_step=partial(_advance, bars, task),
                )
                result |= {"state": "corrected", "zones": to_json(corrected.zones)}
                if not json_output:
                    typer.echo(str(target))
            except LensModelError as error:
                result |= {"state": "failed", "code": error.code, "reason": str(error)}
                typer.echo(f"lensmodel: {path.name}: {error}", err=True)
            bars.remove_task(task)
    if json_output:
        typer.echo(json.dumps({"results": results}, indent=2))
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _advance(bars: Progress, task: TaskID, done: int, total: int) -> None:
    bars.update(task, completed=done, total=total)


def psf(
    profile: Annotated[Path, typer.Argument(help="The lens profile file.")],
    r: Annotated[float, typer.Option(min=0.0, max=1.0, help="0 centre, 1 corner.")] = 0.0,
    phi: Annotated[float, typer.Option(help="Radians, counter-clockwise from the right.")] = 0.0,
    aperture: Aperture = None,
    channel: Annotated[str, typer.Option(help="r, g or b.")] = "g",
    size: Annotated[int, typer.Option(min=3, max=255, help="Odd side in pixels.")] = 55,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help=".npy, .json or .png; default: words.")
    ] = None,
    json_output: Json = False,
    force: Annotated[bool, typer.Option("--force", help="Replace the output file.")] = False,
) -> None:
    """Answer what the lens makes of a point at one place.

    Examples:

        lensmodel psf my-24mm.lensprofile --r 0.9 --phi 0.6 --aperture 1.4

        lensmodel psf my-24mm.lensprofile --r 0.9 --output corner.npy
    """
    if channel not in CHANNELS:
        raise InvalidInputError(f"channel must be r, g or b, got {channel!r}")
    named: Channel = channel
    place = FieldPosition(r, phi)
    model = load_profile(profile).model
    answer = model.query(place, LensSettings(aperture=aperture, channel=named), size)
    tangential, sagittal = quality.tangential_sagittal_mtf50(answer.kernel, place.phi)
    document = {
        "query": {"r": r, "phi": place.phi, "aperture": aperture, "channel": channel, "size": size},
        "support": {
            "effective_samples": answer.effective_samples,
            "photos": answer.photos,
            "extrapolated": answer.extrapolated,
            "predicted_error": answer.predicted_error,
        },
        "rms_width_px": rms_width(answer.kernel),
        "mtf50": {"tangential": tangential, "sagittal": sagittal},
        "psf": {"shape": list(answer.kernel.shape), "dtype": "float32", "data": answer.kernel.tolist()},
    }
    if output is not None:
        _write(output, answer.kernel, document, force=force)
    if json_output:
        typer.echo(json.dumps(to_json(document)))
    elif output is None or sys.stdout.isatty():
        beyond = " (beyond what the photos cover)" if answer.extrapolated else ""
        typer.echo(
            f"{zone_of(r)}, r {r:g}: rms width {rms_width(answer.kernel):.2f} px, MTF50 tangential "
            f"{tangential:.3f}, sagittal {sagittal:.3f} cycles/px; {answer.photos} photos, "
            f"{answer.effective_samples:.1f} effective samples, expected error "
            f"{answer.predicted_error:.2f}{beyond}"
        )


def _write(path: Path, kernel: Any, document: dict[str, Any], *, force: bool) -> None:  # noqa: ANN401 - an array
    if path.exists() and not force:
        raise InvalidInputError(f"{path} is there already; --force replaces it")
    if path.suffix == ".npy":
        with path.open("wb") as file:
            np.save(file, kernel.astype(np.float32), allow_pickle=False)
    elif path.suffix == ".json":
        path.write_text(json.dumps(to_json(document)), encoding="utf-8")
    elif path.suffix == ".png":
        levels = np.rint(65535.0 * kernel / kernel.max()).astype(np.uint16)
        Image.fromarray(levels).save(path)
    else:
        raise InvalidInputError(f"no format for {path.suffix!r}; use .npy, .json or .png")
