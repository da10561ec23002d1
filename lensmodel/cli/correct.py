"""`lensmodel correct`: remove the blur of the lens from photos."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated, get_args

import typer

from lensmodel.blind import estimators
from lensmodel.cli import correction, folder
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import (
    ANY_LENS,
    JSON,
    QUIET,
    WORKERS,
    Aperture,
    Force,
    HelpAll,
    Photos,
    Verbose,
    choice,
    rare,
)
from lensmodel.correction import Bounds, deconvolvers
from lensmodel.patches import selectors
from lensmodel.photo import OutputFormat

LEARNING, CORRECTING, WRITING, RUNNING = "Learning (--lens auto)", "Correcting", "Writing", "Running"
"""Panels of the options that --help-all adds."""


def correct(
    context: typer.Context,
    photos: Photos,
    profile: Annotated[
        Path | None, typer.Option("--profile", "-p", metavar="FILE", help="The profile of their lens.")
    ] = None,
    lens: Annotated[
        str | None,
        typer.Option(
            metavar="auto|ID",
            help="auto: sort the photos by body, lens and focal length, learn each lens from them, and "
            "correct those that visibly gain. With --server, also the id of a lens there.",
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
            help="0: correct nothing; 1: all that the noise allows (for JPEGs, seven tenths of that).",
        ),
    ] = 1.0,
    file_format: Annotated[
        OutputFormat | None,
        choice(
            "--format",
            get_args(OutputFormat),
            "dng: linear, for a raw converter. Default: by the name after -o, else tiff16.",
        ),
    ] = None,
    aperture: Aperture = None,
    force: Force = False,
    profiles: Annotated[
        Path | None,
        rare(
            typer.Option(
                metavar="DIR", help="Folder of the lens profiles. Default: a folder `lenses` in the output."
            ),
            LEARNING,
        ),
    ] = None,
    learn_from: Annotated[
        int,
        rare(
            typer.Option(min=1, metavar="N", help="Learn from at most this many photos of each group."),
            LEARNING,
        ),
    ] = folder.LEARN_FROM,
    estimator: Annotated[
        str, rare(typer.Option(metavar="NAME", help=f"Blind estimator: {', '.join(estimators)}."), LEARNING)
    ] = "default",
    selector: Annotated[
        str,
        rare(
            typer.Option(metavar="NAME", help=f"How patches of a photo are chosen: {', '.join(selectors)}."),
            LEARNING,
        ),
    ] = "r-map",
    any_lens: Annotated[bool, rare(ANY_LENS, LEARNING)] = False,
    method: Annotated[
        str | None,
        rare(
            typer.Option(
                metavar="NAME",
                help=f"{', '.join(deconvolvers)}. Default: standard, or as the lens was learned.",
            ),
            CORRECTING,
        ),
    ] = None,
    halo: Annotated[
        float | None,
        rare(
            typer.Option(
                metavar="SHARE",
                help="How far results may go beyond the photo's own range beside edges, as a share of that "
                "range: 0 for not at all, inf for no limit. Default: less, the less certain the profile is.",
            ),
            CORRECTING,
        ),
    ] = None,
    texture: Annotated[
        float,
        rare(
            typer.Option(
                min=0.0, max=1.0, metavar="0..1", help="How much of its faint texture a photo keeps."
            ),
            CORRECTING,
        ),
    ] = 1.0,
    denoise: Annotated[
        float,
        rare(
            typer.Option(
                min=0.0, max=1.0, metavar="0..1", help="How much of the photo's grain to take away."
            ),
            CORRECTING,
        ),
    ] = 0.0,
    keep_location: Annotated[
        bool,
        rare(
            typer.Option(
                "--keep-location", help="Keep where the photo was taken (GPS). Default: it is left out."
            ),
            WRITING,
        ),
    ] = False,
    server: Annotated[
        str | None,
        rare(
            typer.Option(
                metavar="URL",
                help="Have a service do the work on another machine; its key is read from LENS_API_KEY.",
            ),
            RUNNING,
        ),
    ] = None,
    workers: Annotated[int | None, rare(WORKERS, RUNNING)] = None,
    json_output: Annotated[bool, rare(JSON, RUNNING)] = False,
    quiet: Annotated[bool, rare(QUIET, RUNNING)] = False,
    verbose: Verbose = 0,
    help_all: HelpAll = False,
) -> None:
    """Remove the blur of the lens from photos.

    Corrected photos are new files, NAME-corrected; the photos themselves are never changed. Files that
    are already there are left alone, so a run that was stopped can be started again and goes on from
    there. No file is ever half written. The names of the written files go to standard output; with
    --lens auto it is a table instead, one line per lens, and -v reports on every photo.

    Examples:

        lensmodel correct holiday --lens auto

        lensmodel correct holiday --profile my-24mm.lensprofile -o corrected

        lensmodel correct one.dng --profile my-24mm.lensprofile -o sharp.jpg --strength 0.7

        lensmodel correct one.dng --profile my-24mm.lensprofile -o soft --halo 0.2 --denoise 0.5

        lensmodel correct one.dng --profile my-24mm.lensprofile -o linear --format dng --method fast --json

        lensmodel correct holiday --server http://127.0.0.1:8000 -o corrected

    Exit status: 0 all photos are corrected, 1 some are not, 2 wrong usage.
    """
    del help_all
    shown = Display.of(context, quiet=quiet, verbose=verbose)
    if halo is not None and not halo >= 0.0:
        raise UsageError(f"--halo must not be negative, got {halo:g}")
    options = correction.CorrectionOptions(
        aperture,
        method,
        strength,
        Bounds(halo, texture, denoise),
        file_format,
        workers,
        any_lens=any_lens,
        force=force,
        keep_location=keep_location,
    )
    if server is not None:
        if profile is not None:
            raise UsageError("--server has lenses of its own; leave out --profile, or give --lens ID")
        # the client stands beside the service, above this package
        remote = import_module("app.commands.remote")
        remote.run(photos, server, lens or remote.AUTO, output, options, shown, as_json=json_output)
        return
    if (profile is None) == (lens is None):
        raise UsageError(
            "give --profile FILE, or --lens auto to learn the lens from these photos; one of them"
        )
    if profile is not None:
        correction.run(photos, profile, output, options, shown, as_json=json_output)
        return
    if lens != "auto":
        raise UsageError(f"--lens must be auto, got {lens!r}; for a profile of yours use --profile FILE")
    learning = folder.Learning(profiles, learn_from, estimator, selector)
    folder.run(photos, output, options, learning, shown, as_json=json_output)
