"""`lensmodel correct`: remove the blur of the lens from photos."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path
from typing import Annotated, get_args

import typer

from lensmodel.cli import correction, folder
from lensmodel.cli.calibrate import Estimator, Selector
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import AnyLens, Aperture, Force, Json, Photos, Quiet, Verbose, Workers, choice
from lensmodel.correction import Bounds, deconvolvers
from lensmodel.photo import OutputFormat


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
            "correct those that gain from it. With --server, also the id of a lens there.",
        ),
    ] = None,
    server: Annotated[
        str | None,
        typer.Option(
            metavar="URL", help="Have a service elsewhere do the work; its key is read from LENS_API_KEY."
        ),
    ] = None,
    output: Annotated[
        str | None,
        typer.Option(
            "--output",
            "-o",
            metavar="DIR|FILE",
            help="Folder for the corrected photos, or of one photo a file such as sharp.tif; default: "
            "`corrected` beside each photo.",
        ),
    ] = None,
    profiles: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="With --lens auto: folder that keeps the lens profiles; default: `lenses` in the output.",
        ),
    ] = None,
    learn_from: Annotated[
        int,
        typer.Option(
            min=1, metavar="N", help="With --lens auto: learn from at most this many photos of a group."
        ),
    ] = folder.LEARN_FROM,
    estimator: Estimator = "default",
    selector: Selector = "r-map",
    method: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help=f"{', '.join(deconvolvers)}. Default: standard, or as the lens was learned."
        ),
    ] = None,
    strength: Annotated[
        float,
        typer.Option(
            min=0.0,
            max=1.0,
            metavar="0..1",
            help="0: correct nothing; 1: all that the noise allows (of JPEGs: seven tenths of it).",
        ),
    ] = 1.0,
    halo: Annotated[
        float | None,
        typer.Option(
            metavar="SHARE",
            help="How far results may go beyond the photo's own range beside edges, as a share of that "
            "range: 0 for not at all, inf for no limit. Default: less, the less certain the profile is.",
        ),
    ] = None,
    texture: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, metavar="0..1", help="How much of its faint texture a photo keeps."),
    ] = 1.0,
    denoise: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, metavar="0..1", help="How much of the photo's grain to take away."),
    ] = 0.0,
    file_format: Annotated[
        OutputFormat | None,
        choice(
            "--format",
            get_args(OutputFormat),
            "dng: linear, for a raw converter. Default: by the name after -o, else tiff16.",
        ),
    ] = None,
    sidecar: Annotated[
        bool,
        typer.Option(
            "--sidecar",
            help="Write an XMP file beside each corrected photo, NAME.tif.xmp, saying what was done and with "
            "which lens.",
        ),
    ] = False,
    keep_location: Annotated[
        bool, typer.Option("--keep-location", help="Keep where the photo was taken (GPS); default: left out.")
    ] = False,
    aperture: Aperture = None,
    workers: Workers = None,
    any_lens: AnyLens = False,
    force: Force = False,
    json_output: Json = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Remove the blur of the lens from photos.

    Corrected photos are new files, NAME-corrected. Those that are there already are left alone:
    a run that was stopped goes on where it was. Each appears complete or not at all. The names of
    the written files go to standard output; with --lens auto a table is printed instead, one line per lens,
    and -v reports every photo. The photos themselves are never changed.

    Examples:

        lensmodel correct holiday --lens auto

        lensmodel correct holiday --server http://127.0.0.1:8000 -o corrected

        lensmodel correct holiday --profile my-24mm.lensprofile -o corrected

        lensmodel correct one.dng --profile my-24mm.lensprofile -o sharp.jpg --strength 0.7

        lensmodel correct one.dng --profile my-24mm.lensprofile -o soft --halo 0.2 --denoise 0.5

        lensmodel correct one.dng --profile my-24mm.lensprofile -o linear --format dng --method fast --json

    Exit status: 0 all photos are corrected, 1 some are not, 2 called wrongly.
    """
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
        sidecar=sidecar,
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
