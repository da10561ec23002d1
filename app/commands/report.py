"""`lensmodel report` and `lensmodel export`: what a profile says, and its PSFs for other programs."""

from __future__ import annotations

import csv
import io
import json
from pathlib import Path
from typing import Annotated, Final

import typer

from app.commands import display, files
from app.commands.failure import UsageError
from app.commands.options import Quiet, Verbose
from lensmodel.codec import to_json
from lensmodel.regression import LensModel
from lensmodel.report import (
    Advice,
    LensReport,
    ReportSettings,
    advice,
    apertures_svg,
    curves_svg,
    export,
    exporters,
    lens_report,
    mtf_map_svg,
    psf_grid,
)
from lensmodel.report.exporters import write_atomically
from lensmodel.report.lens_report import widest
from lensmodel.types import CHANNELS, Channel, FieldPosition, LensSettings

Profile = Annotated[Path, typer.Argument(help="The lens profile file.")]
Aperture = Annotated[
    float | None, typer.Option("--aperture", "-a", help="f-number; default: the widest that a photo had.")
]
ChannelName = Annotated[str, typer.Option("--channel", help="r, g or b.")]
Aspect = Annotated[float, typer.Option(help="Width over height of the picture.")]
Force = Annotated[bool, typer.Option("--force", help="Replace files that are there already.")]

_FILES: Final = ("report.json", "mtf.csv", "mtf-map.svg", "mtf-curves.svg", "apertures.svg")


def report(
    context: typer.Context,
    profile: Profile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder for report.json, mtf.csv and pictures.")
    ] = None,
    aperture: Aperture = None,
    channel: ChannelName = "g",
    aspect: Aspect = 1.5,
    json_output: Annotated[bool, typer.Option("--json", help="Print the report as JSON.")] = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Tell how sharp a lens is, whether it is centred, and which photo would help most.

    Examples:

        lensmodel report my-24mm.lensprofile

        lensmodel report my-24mm.lensprofile --aperture 2 -o my-24mm-report

        lensmodel report my-24mm.lensprofile --json

    Exit status: 0 told, 1 the profile cannot be used, 2 called wrongly.
    """
    shown = display.of(context, quiet=quiet, verbose=verbose)
    if output is not None:
        files.refuse_existing(*(output / name for name in _FILES), force=force)
    with shown.busy("asking the lens at 200 places"):
        model = files.profile_at(profile).model
        found = lens_report(model, _settings(model, aperture, channel), ReportSettings(aspect=aspect))
        wish = advice(model)
    document = json.dumps({"report": to_json(found), "advice": to_json(wish)}, indent=2)
    if output is not None:
        texts = {
            "report.json": document + "\n",
            "mtf.csv": _map_csv(found),
            "mtf-map.svg": mtf_map_svg(found),
            "mtf-curves.svg": curves_svg(found),
        }
        if len(found.apertures) > 1:
            texts["apertures.svg"] = apertures_svg(found)
        output.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_atomically(output / name, text.encode())
    if json_output:
        typer.echo(document)
    else:
        shown.result(_words(found, wish, output))


def export_psfs(
    context: typer.Context,
    profile: Profile,
    output: Annotated[Path, typer.Option("--output", "-o", help="The file to write.")],
    file_format: Annotated[str, typer.Option("--format", help="csv, fits, json, npz, png, tiff.")] = "tiff",
    aperture: Aperture = None,
    channel: ChannelName = "g",
    rows: Annotated[int, typer.Option(min=1, max=100, help="Rows of the grid of places.")] = 5,
    cols: Annotated[int, typer.Option(min=1, max=100, help="Columns of the grid of places.")] = 7,
    r: Annotated[
        float | None, typer.Option(min=0.0, max=1.0, help="A single place: 0 center, 1 corner.")
    ] = None,
    phi: Annotated[
        float, typer.Option(help="Of a single place: radians, counter-clockwise from the right.")
    ] = 0.0,
    size: Annotated[int, typer.Option(min=3, max=255, help="Odd side in pixels.")] = 31,
    aspect: Aspect = 1.5,
    json_output: Annotated[bool, typer.Option("--json", help="Say what was written as JSON.")] = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Write PSFs for other programs: a grid over the picture, or a single place with --r and --phi.

    Examples:

        lensmodel export my-24mm.lensprofile --format tiff -o my-24mm.tif

        lensmodel export my-24mm.lensprofile --format json --r 0.9 --phi 0.6 -o corner-for-art.json

        lensmodel export my-24mm.lensprofile --format csv --aperture 2 -o mtf.csv

    Exit status: 0 written, 1 the profile cannot be used, 2 called wrongly.
    """
    shown = display.of(context, quiet=quiet, verbose=verbose)
    files.refuse_existing(output, force=force)
    with files.as_usage():
        exporters.create(file_format)
    place = None if r is None else FieldPosition(r, phi)
    with shown.busy("asking the lens"):
        model = files.profile_at(profile).model
        psfs = psf_grid(
            model,
            _settings(model, aperture, channel),
            rows=rows,
            cols=cols,
            size=size,
            aspect=aspect,
            at=place,
        )
    export(output, psfs, file_format)
    if json_output:
        shown.document({"output": str(output), "format": file_format, "psfs": len(psfs.positions)})
    else:
        shown.result(str(output))


def _settings(model: LensModel, aperture: float | None, channel: str) -> LensSettings:
    if channel not in CHANNELS:
        raise UsageError(f"channel must be r, g or b, got {channel!r}")
    named: Channel = channel
    chosen = widest(model) if aperture is None else LensSettings(aperture=aperture)
    return chosen.with_channel(named)


def _words(found: LensReport, wish: Advice, output: Path | None) -> str:
    settings = found.settings
    at = "unknown aperture" if settings.aperture is None else f"f/{settings.aperture:g}"
    photos = "1 photo" if found.photos == 1 else f"{found.photos} photos"
    lines = [f"{photos}, {found.samples} samples; {at}, channel {settings.channel}"]
    lines += [f"- {line}" for line in found.summary]
    lines.append(f"- {wish.text}")
    if output is not None:
        lines.append(f"written: {output}")
    return "\n".join(lines)


def _map_csv(found: LensReport) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    writer.writerow(
        ["row", "col", "r", "phi", "mtf50_tangential", "mtf50_sagittal", "predicted_error", "extrapolated"]
    )
    for i, point in enumerate(found.field):
        values = (point.position.r, point.position.phi, point.tangential, point.sagittal)
        numbers = (f"{value:.6f}" for value in (*values, point.predicted_error))
        writer.writerow([*divmod(i, found.cols), *numbers, int(point.extrapolated)])
    return out.getvalue()
