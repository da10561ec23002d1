"""`lensmodel report` and `lensmodel export`: what a profile says, and its PSFs for other programs."""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Final

import typer

from app.commands import lens_test
from app.commands.console import display, files
from app.commands.console.failure import UsageError
from app.commands.console.options import (
    ANGLE,
    RADIUS,
    Channel,
    Force,
    Json,
    ProfileFile,
    Quiet,
    Size,
    Verbose,
    aperture_option,
)
from lensmodel.core.codec import to_json
from lensmodel.core.files import write_atomically
from lensmodel.core.types import FieldPosition, LensSettings
from lensmodel.model import LensModel
from lensmodel.model.provenance import answerers_in_words
from lensmodel.report import (
    Advice,
    LensReport,
    ReportSettings,
    advice,
    apertures_svg,
    curves_svg,
    export,
    exporters,
    format_of,
    lens_report,
    mtf_map_svg,
    psf_grid,
)
from lensmodel.report.lens_report import widest

Aperture = Annotated[float | None, aperture_option("f-number; default: the widest that a photo had.")]
Aspect = Annotated[
    float, typer.Option(min=0.2, max=5.0, metavar="RATIO", help="Width over height of the picture.")
]

_FILES: Final = ("report.json", "mtf.csv", "mtf-map.svg", "mtf-curves.svg", "apertures.svg")


def report(
    context: typer.Context,
    profile: ProfileFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", metavar="DIR", help="Folder for the report, the lens test and pictures."
        ),
    ] = None,
    aperture: Aperture = None,
    channel: Channel = "g",
    aspect: Aspect = 1.5,
    against: Annotated[
        Path | None,
        typer.Option(
            "--against", metavar="PROFILE", help="Profile of another copy to compare with; needs --output."
        ),
    ] = None,
    photo: Annotated[
        list[Path] | None,
        typer.Option(
            "--photo",
            metavar="PHOTO",
            help="A photo of this lens on which lateral colour is measured; may be repeated; needs --output.",
        ),
    ] = None,
    json_output: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Say how sharp a lens is, whether it is centred, and which photo would help most.

    Examples:

        lensmodel report my-24mm.lensprofile

        lensmodel report my-24mm.lensprofile --aperture 2 -o my-24mm-report

        lensmodel report my-24mm.lensprofile --photo one.dng -o with-lateral-colour

        lensmodel report my-24mm.lensprofile --against a-friends-24mm.lensprofile -o both

        lensmodel report my-24mm.lensprofile --json

    Exit status: 0 reported, 1 the profile cannot be used, 2 called wrongly.
    """
    shown = display.of(context, quiet=quiet, verbose=verbose)
    if output is not None:
        names = (*_FILES, *lens_test.FILES, *(lens_test.COMPARED if against else ()))
        files.refuse_existing(*(output / name for name in names), force=force)
    elif against is not None or photo:
        option = "--photo" if against is None else "--against"
        raise UsageError(f"{option} needs --output: what it adds is written to files")
    with shown.busy("asking the lens at 200 places"):
        model = files.profile_at(profile).model
        measured = lens_report(model, _settings(model, aperture, channel), ReportSettings(aspect=aspect))
        recommended = advice(model)
    document = json.dumps({"report": to_json(measured), "advice": to_json(recommended)}, indent=2)
    if output is not None:
        texts = {
            "report.json": document + "\n",
            "mtf.csv": _map_csv(measured),
            "mtf-map.svg": mtf_map_svg(measured),
            "mtf-curves.svg": curves_svg(measured),
        }
        if len(measured.apertures) > 1:
            texts["apertures.svg"] = apertures_svg(measured)
        output.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            write_atomically(output / name, text.encode())
        missing = _tested(shown, profile, against, output, aspect, aperture, photo or [])
        if missing:
            shown.note(f"not written: {', '.join(missing)}; pip install 'lensmodel[report]' brings PDF")
    if json_output:
        typer.echo(document)
    else:
        shown.result(_words(measured, recommended, output))


def _tested(
    shown: display.Display,
    profile: Path,
    against: Path | None,
    output: Path,
    aspect: float,
    aperture: float | None,
    photos: Sequence[Path],
) -> list[str]:
    """Write the lens test; return the files that were left out."""
    with shown.busy("testing the lens"):
        first = lens_test.tested(files.profile_at(profile), profile, aspect, photos)
        missing = lens_test.write(output, first)
        if against is not None:
            second = lens_test.tested(files.profile_at(against), against, aspect, [])
            missing += lens_test.write_comparison(output, first, second, aperture)
    return missing


def export_psfs(
    context: typer.Context,
    profile: ProfileFile,
    output: Annotated[Path, typer.Option("--output", "-o", metavar="FILE", help="The file to write.")],
    file_format: Annotated[
        str | None,
        typer.Option(
            "--format",
            metavar=f"<{'|'.join(exporters)}>",
            help="Default: by the ending of the file name.",
        ),
    ] = None,
    aperture: Aperture = None,
    channel: Channel = "g",
    rows: Annotated[int, typer.Option(min=1, max=100, metavar="N", help="Rows of the grid of places.")] = 5,
    cols: Annotated[
        int, typer.Option(min=1, max=100, metavar="N", help="Columns of the grid of places.")
    ] = 7,
    r: Annotated[float | None, RADIUS] = None,
    phi: Annotated[float | None, ANGLE] = None,
    size: Size = 31,
    aspect: Aspect = 1.5,
    json_output: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Write PSFs for other programs: a grid over the picture, or a single place with --r and --phi.

    Examples:

        lensmodel export my-24mm.lensprofile -o my-24mm.tif

        lensmodel export my-24mm.lensprofile --format json --r 0.9 --phi 0.6 -o corner-for-art.json

        lensmodel export my-24mm.lensprofile --aperture 2 -o mtf.csv

    Exit status: 0 written, 1 the profile cannot be used, 2 called wrongly.
    """
    shown = display.of(context, quiet=quiet, verbose=verbose)
    written = _format(output, file_format)
    files.refuse_existing(output, force=force)
    if phi is not None and r is None:
        raise UsageError("--phi needs --r: together they name a single place")
    with files.as_usage():
        place = None if r is None else FieldPosition(r, phi or 0.0)
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
    export(output, psfs, written)
    # here too: a bare matrix has no room for it
    made = answerers_in_words(zip(psfs.answered_by, psfs.reason, strict=True))
    if json_output:
        number = len(psfs.positions)
        shown.document({"output": str(output), "format": written, "psfs": number, "answered": made})
    else:
        shown.result(str(output))
        shown.note(made)


def _format(output: Path, named: str | None) -> str:
    """Tell the format by the option and by the ending of the file; they must not contradict each other."""
    ending = format_of(output)
    chosen = named or ending
    if chosen is None:
        raise UsageError(
            f"no format for {output.name}; add --format, or give a name that ends in "
            + ", ".join(f".{name}" for name in exporters)
        )
    with files.as_usage():
        exporters.create(chosen)
    if ending not in {None, chosen}:
        raise UsageError(
            f"{output.name} ends as {ending} does, but --format says {chosen}; change one of them"
        )
    return chosen


def _settings(model: LensModel, aperture: float | None, channel: Channel) -> LensSettings:
    with files.as_usage():
        chosen = widest(model) if aperture is None else LensSettings(aperture=aperture)
    return chosen.with_channel(channel)


def _words(measured: LensReport, recommended: Advice, output: Path | None) -> str:
    settings = measured.settings
    at = "unknown aperture" if settings.aperture is None else f"f/{settings.aperture:g}"
    photos = "1 photo" if measured.photos == 1 else f"{measured.photos} photos"
    lines = [f"{photos}, {measured.samples} samples; {at}, channel {settings.channel}"]
    lines += [f"- {line}" for line in measured.summary]
    lines.append(f"- {recommended.text}")
    if output is not None:
        lines.append(f"written: {output}")
    return "\n".join(lines)


def _map_csv(measured: LensReport) -> str:
    out = io.StringIO()
    writer = csv.writer(out, lineterminator="\n")
    mtf50 = ("mtf50_tangential", "mtf50_sagittal")
    known = ("predicted_error", "extrapolated", "answered_by", "reason")
    writer.writerow(["row", "col", "r", "phi", *mtf50, *known])
    for i, point in enumerate(measured.field):
        values = (point.position.r, point.position.phi, point.tangential, point.sagittal)
        numbers = (f"{value:.6f}" for value in (*values, point.predicted_error))
        made = (point.answered_by, point.reason)
        writer.writerow([*divmod(i, measured.cols), *numbers, int(point.extrapolated), *made])
    return out.getvalue()
