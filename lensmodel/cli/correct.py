"""`lensmodel correct`: remove the blur of the lens from photos."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, get_args

import typer

from lensmodel.cli import files, folder, options, outputs
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.core.types import LensSettings
from lensmodel.correction import Bounds, deconvolvers
from lensmodel.lens import Lens
from lensmodel.photo import OutputFormat

# Panels of the options that --help-all adds
LEARNING, CORRECTING, WRITING, RUNNING = "Learning (--lens auto)", "Correcting", "Writing", "Running"


def correct(
    context: typer.Context,
    photos: options.Photos,
    profile: Annotated[
        Path | None, typer.Option("--profile", "-p", metavar="FILE", help="The profile of their lens.")
    ] = None,
    lens: Annotated[
        str | None,
        typer.Option(
            metavar="auto|ID",
            help="auto: sort the photos by body, lens and focal length, learn each lens from them, and "
            "correct those that visibly gain.",
        ),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR|FILE",
            help="Where to write: a folder, or for one photo a file such as sharp.tif. Default: a folder "
            "`corrected` beside each photo.",
        ),
    ] = None,
    strength: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            metavar="0..1",
            help="0: correct nothing; 1: all that the noise allows (JPEGs: less where the PSF is unsure).",
        ),
    ] = 1.0,
    file_format: Annotated[
        OutputFormat | None,
        options.choice(
            "--format",
            get_args(OutputFormat),
            "dng: linear, for a raw converter. Default: by the name after -o, else tiff16.",
        ),
    ] = None,
    aperture: options.Aperture = None,
    force: Annotated[
        bool,
        typer.Option(
            "--force", help="Replace existing files; with --profile, correct JPEGs whatever they gain."
        ),
    ] = False,
    profiles: Annotated[
        Path | None,
        options.rare(
            LEARNING,
            metavar="DIR",
            help="Folder of the lens profiles. Default: a folder `lenses` in the output.",
        ),
    ] = None,
    learn_from: Annotated[
        int,
        options.rare(LEARNING, min=1, metavar="N", help="Learn from at most this many photos of each group."),
    ] = folder.LEARN_FROM,
    any_lens: Annotated[bool, options.rare(LEARNING, options.ANY_LENS)] = False,
    method: Annotated[
        str | None,
        options.rare(
            CORRECTING,
            metavar="NAME",
            help=f"{', '.join(deconvolvers)}. Default: standard, or as the lens was learned.",
        ),
    ] = None,
    halo: Annotated[
        float | None,
        options.rare(
            CORRECTING,
            metavar="SHARE",
            help="How far results may go beyond the photo's own range beside edges, as a share of that "
            "range: 0 for not at all, inf for no limit. Default: less, the less certain the profile is.",
        ),
    ] = None,
    texture: Annotated[
        float,
        options.rare(
            CORRECTING, min=0.0, max=1.0, metavar="0..1", help="How much of its faint texture a photo keeps."
        ),
    ] = 1.0,
    denoise: Annotated[
        float,
        options.rare(
            CORRECTING, min=0.0, max=1.0, metavar="0..1", help="How much of the photo's grain to take away."
        ),
    ] = 0.0,
    keep_location: Annotated[
        bool,
        options.rare(
            WRITING, "--keep-location", help="Keep where the photo was taken (GPS). Default: it is left out."
        ),
    ] = False,
    workers: Annotated[int | None, options.rare(RUNNING, options.WORKERS)] = None,
    json_output: Annotated[bool, options.rare(RUNNING, options.JSON)] = False,
    quiet: Annotated[bool, options.rare(RUNNING, options.QUIET)] = False,
    verbose: options.Verbose = 0,
    help_all: options.HelpAll = False,
) -> None:
    """Remove the blur of the lens from photos.

    Corrected photos are new files, NAME-corrected; the photos themselves are never changed. Files that
    are already there are left alone, so a run that was stopped can be started again and goes on from
    there. No file is ever half written. The names of the written files go to standard output; with
    --lens auto it is a table instead, one row per lens, and -v reports on every photo.

    Examples:

        lensmodel correct holiday --lens auto

        lensmodel correct holiday --profile my-24mm.lensprofile -o corrected

        lensmodel correct one.dng --profile my-24mm.lensprofile -o sharp.jpg --strength 0.7

        lensmodel correct one.dng --profile my-24mm.lensprofile -o soft --halo 0.2 --denoise 0.5

        lensmodel correct one.dng --profile my-24mm.lensprofile -o linear --format dng --method fast --json

    Exit status: 0 done, 1 some photos failed, 2 wrong usage.
    """
    del help_all
    shown = Display.of(context, quiet=quiet, verbose=verbose, as_json=json_output)
    if halo is not None and not halo >= 0.0:
        raise UsageError(f"--halo must not be negative, got {halo:g}")
    if (profile is None) == (lens is None):
        raise UsageError(
            "give --profile FILE, or --lens auto to learn the lens from these photos; one of them"
        )
    if profile is None and lens != "auto":
        raise UsageError(f"--lens must be auto, got {lens!r}; for a profile of yours use --profile FILE")
    targets, twice = outputs.targets_of(files.photos(photos), output, file_format)
    if others := files.passed_over(photos):
        shown.note(f"passed over: {others}")
    with files.as_usage():  # before any work
        if method is not None:
            deconvolvers.create(method)
        LensSettings(aperture=aperture)
    clashed = outputs.clashes(twice, shown)
    given = {
        "aperture": aperture,
        "method": method,
        "strength": strength,
        "bounds": Bounds(halo, texture, denoise),
        "file_format": file_format,
        "keep_location": keep_location,
        "workers": workers,
    }
    correction = outputs.Correction(targets, given, profile is None, any_lens, force, shown)
    document: dict[str, Any] = {"profile": str(profile)}
    if profile is None:
        base = next(iter([*targets.values(), *twice])).parent
        document = folder.correct_folder(correction, profiles or base / folder.PROFILES, learn_from)
    else:
        known = Lens(files.profile_at(profile))
        with shown.progress(total=len(targets)) as bar:
            document["results"] = correction.photos(list(targets), known, bar)
    document["results"][:0] = clashed
    shown.document(document)
    if any(result["state"] == "failed" for result in document["results"]):
        raise typer.Exit(1)
