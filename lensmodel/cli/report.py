"""`lensmodel report` and `export`: what a profile says, and its PSFs for other programs."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Final

import typer

from lensmodel.cli import console, files
from lensmodel.cli.console import Display, UsageError
from lensmodel.core.files import to_json, write_atomically
from lensmodel.core.names import camera_name, full_name
from lensmodel.core.types import LensSettings
from lensmodel.report.export import EXPORTERS, psf_grid, to_csv
from lensmodel.report.lens_report import LensReport, compare, lens_report, provenance, widest

Aperture = Annotated[float | None, console.aperture("f-number; default: the widest that a photo had.")]

FORMS: Final = (".pdf", ".png", ".csv", ".json")


def report(
    profile: console.ProfileFile,
    output: Annotated[
        Path | None, console.output(f"A folder for all of {', '.join(FORMS)}, or one such file.")
    ] = None,
    aperture: Aperture = None,
    against: Annotated[Path | None, typer.Option(help="Profile of another copy to compare with.")] = None,
    force: console.Force = False,
) -> None:
    """Say how sharp a lens is, and whether it is centred.

    It also says which photo would help most.

    Examples:

        lensmodel report my-24mm.lensprofile

        lensmodel report my-24mm.lensprofile --aperture 2 -o my-24mm.pdf

        lensmodel report my-24mm.lensprofile --against a-friends-24mm.lensprofile

    Exit status: 0 reported, 1 the profile cannot be used, 2 wrong usage.
    """
    shown, targets = Display(), _targets(output)
    files.refuse_existing(*targets, force=force)
    with shown.progress("computing its PSFs at 200 places"):
        found = measured(profile, aperture)
        compared = [] if against is None else [compare(found, measured(against, aperture))]
    if output is not None:
        with shown.progress("drawing"):
            for target in targets:
                target.parent.mkdir(parents=True, exist_ok=True)
                write_atomically(target, _written(found, target.suffix.lower()))
    at = found.tested[0].at or "unknown aperture"
    lines = [f"{found.name}: {found.facts}; {at}", *(f"- {line}" for line in (*found.summary, *compared))]
    shown.result("\n".join([*lines, *([] if output is None else [f"written: {output}"])]))


def measured(profile: Path, aperture: float | None) -> LensReport:
    """Report on the lens of a profile."""
    known = files.profile_at(profile)
    names, cameras = known.names, [camera_name(camera.maker, camera.model) for camera in known.cameras]
    with files.as_usage():
        LensSettings(aperture=aperture)
        name = names.get("label") or full_name(names.get("maker"), names.get("model")) or profile.stem
        found = lens_report(known.model, name, apertures=None if aperture is None else [aperture])
    return replace(found, details=provenance(names.get("serial"), cameras, list(known.photos.values())))


def _targets(output: Path | None) -> tuple[Path, ...]:
    """The files of a report: the one that is named, or one of each form in a folder."""
    if output is None:
        return ()
    if output.suffix.lower() in FORMS and not output.is_dir():
        return (output,)
    if output.suffix[1:].isalpha() and not output.is_dir():
        raise UsageError(
            f"a report is no {output.suffix}: end {output} in {', '.join(FORMS)}, or give a folder"
        )
    return tuple(output / f"report{form}" for form in FORMS)


def _written(found: LensReport, form: str) -> bytes:
    """A report in one of `FORMS`."""
    if form == ".csv":
        return to_csv(found).encode()
    if form == ".json":
        return json.dumps(to_json(found), indent=1).encode()
    from lensmodel.report.plots import document  # noqa: PLC0415 - matplotlib, an extra

    return document(found, "pdf" if form == ".pdf" else "png")


def export(
    profile: console.ProfileFile,
    output: Annotated[Path, console.output(f"A file that ends in .{', .'.join(EXPORTERS)}.")],
    aperture: Aperture = None,
    channel: console.Channel = "g",
    rows: Annotated[int, typer.Option(min=1, max=100, help="Rows of the grid of places.")] = 5,
    cols: Annotated[int, typer.Option(min=1, max=100, help="Columns of the grid of places.")] = 7,
    size: console.Size = 31,
    force: console.Force = False,
) -> None:
    """Write PSFs for other programs.

    They are a grid over the picture, with --rows 1 --cols 1 that of its middle.

    Examples:

        lensmodel export my-24mm.lensprofile -o my-24mm.npz

        lensmodel export my-24mm.lensprofile --aperture 2 --rows 1 --cols 1 -o for-art.json

    Exit status: 0 written, 1 the profile cannot be used, 2 wrong usage.
    """
    shown, file_format = Display(), output.suffix.lower().removeprefix(".")
    if file_format not in EXPORTERS:
        raise UsageError(f"give a name that ends in .{', .'.join(EXPORTERS)}, got {output.name}")
    files.refuse_existing(output, force=force)
    with shown.progress("computing its PSFs"):
        model = files.profile_at(profile).model
        with files.as_usage():
            settings = widest(model) if aperture is None else LensSettings(aperture=aperture)
        psfs = psf_grid(model, settings.with_channel(channel), rows=rows, cols=cols, size=size)
    output.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(output, EXPORTERS[file_format](psfs))
    shown.result(str(output))
