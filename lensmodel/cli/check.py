"""`lensmodel check`: whether what a program made of a photo is sound."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import typer
from numpy.typing import NDArray
from PIL import Image
from rich.progress import Progress, TaskID

from lensmodel import photo
from lensmodel.cli import files
from lensmodel.cli.console import Display
from lensmodel.cli.ending import UsageError
from lensmodel.cli.options import Aperture, Force, Json, Quiet, Verbose
from lensmodel.core.files import replacing
from lensmodel.core.types import ZONE_WORDS, LensSettings
from lensmodel.correction.audit import AuditReport
from lensmodel.workflow import checking

_GREY: Final = 0.5
"""Brightness of the photo on the map (chosen: bright enough to be recognised, so dark that the red of what
was held back stands out)."""


def check(
    context: typer.Context,
    original: Annotated[Path, typer.Argument(metavar="ORIGINAL", help="The photo.")],
    corrected: Annotated[
        Path, typer.Argument(metavar="CORRECTED", help="The corrected version, of the same size.")
    ],
    profile: Annotated[
        Path | None,
        typer.Option(
            "--profile",
            "-p",
            metavar="FILE",
            help="The lens profile, with which the result is blurred again.",
        ),
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option("--map", metavar="FILE", help="Write a PNG: the photo in grey, faults in red."),
    ] = None,
    aperture: Aperture = None,
    json_output: Json = False,
    force: Force = False,
    quiet: Quiet = False,
    verbose: Verbose = 0,
) -> None:
    """Find where a photo corrected by any program shows what the original cannot have contained.

    Light below zero, colours that are not there, stray pixels, lines, rings and erased texture are
    found by comparing the two files; with a profile, the result is also blurred again and compared with
    the photo. It is the audit that each correction of lensmodel goes through.

    Examples:

        lensmodel check scan.tif scan-sharpened.tif

        lensmodel check scan.tif scan-sharpened.tif --profile my-24mm.lensprofile --map faults.png

        lensmodel check one.dng linear/one-corrected.dng --json

    Exit status: 0 checked, whatever was found, 1 a file cannot be used, 2 wrong usage.
    """
    shown = Display.of(context, quiet=quiet, verbose=verbose)
    for path in (original, corrected):
        if not path.is_file():
            raise UsageError(f"no photo at {path}; check the name and the folder")
    if picture is not None:
        if picture.suffix.lower() != ".png":
            raise UsageError(f"the map is a PNG; give --map a name that ends in .png, got {picture.name}")
        if not picture.parent.is_dir():
            raise UsageError(f"no folder {picture.parent} for the map; check the name or make it")
        files.refuse_existing(picture, force=force)
    with files.as_usage():
        settings = LensSettings(aperture=aperture)
    model = None if profile is None else files.profile_at(profile).model
    with shown.progress() as bars:
        task = bars.add_task(corrected.name, total=None)
        checked = checking.check(
            original, corrected, model=model, settings=settings, on_step=partial(_show, bars, task)
        )
    if picture is not None:
        with replacing(picture) as part:
            Image.fromarray(_map(checked)).save(part)
    if json_output:
        document: dict[str, Any] = {"original": str(original), "corrected": str(corrected)}
        document |= {"held_back": checked.audit.report.held_back, "report": checked.audit.report}
        shown.document(document)
        return
    shown.result("\n".join(_words(checked.audit.report)))
    if picture is not None:
        shown.result(f"written: {picture}")


def _words(report: AuditReport) -> list[str]:
    lines = [f"{'zone':8}{'tiles':>7}{'at fault':>10}{'held back':>11}  why"]
    for name, zone in report.zones.items():
        checks = sorted(zone.checks.items(), key=lambda item: -item[1])
        why = ", ".join(f"{check} {share:.1%}" for check, share in checks if share >= 0.0005)
        lines.append(
            f"{ZONE_WORDS[name]:8}{zone.tiles:7}{zone.tiles_held:10}{zone.held_back:11.1%}  "
            f"{why or 'nothing to say'}"
        )
    if report.worst:
        lines += ["", f"{'row':>6}{'col':>7}  {'held back':>9}  check"]
        lines += [f"{p.row:6}{p.col:7}  {p.held_back:9.1%}  {p.check}" for p in report.worst]
    return lines


def _map(checked: checking.Checked) -> NDArray[np.uint8]:
    """Draw the photo in grey and what is held back of its correction in red, in sensor orientation."""
    light = photo.shown(checked.original.planes, checked.original.encoding).mean(axis=-1) * _GREY
    fault = (1.0 - checked.audit.keep)[..., None]
    red = np.array([255.0, 30.0, 30.0], dtype=np.float32)
    drawn = light[..., None] * (1.0 - fault) + red * fault
    return np.asarray(np.rint(drawn), dtype=np.uint8)


def _show(bars: Progress, task: TaskID, done: int, total: int) -> None:
    bars.update(task, completed=done, total=total)
