"""`lensmodel measure` and `lensmodel target`."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final, Literal

import typer

from lensmodel import measured as measuring
from lensmodel.api import Admit, Calibration
from lensmodel.blind.sampling import configured
from lensmodel.cli import console, files
from lensmodel.cli.console import Display, UsageError
from lensmodel.core.errors import LensModelError
from lensmodel.core.psf import PsfSample, places_of
from lensmodel.core.types import LensSettings
from lensmodel.photo import develop

_DETAILS: Final = ", ".join(map(str, measuring.DETAILS))
# Default of `target --detail` (chosen): for a page that spans most of a 24-megapixel photo
USUAL_DETAIL: Final = 4000


def measure(
    kind: Annotated[
        Literal["target", "pair", "points", "edges"], typer.Argument(help="What the photos show.")
    ],
    photos: console.Photos,
    profile: console.Profile,
    aperture: console.Aperture = None,
    size: Annotated[
        int, typer.Option(min=9, max=101, callback=console.odd, help="Side of a PSF in pixels, odd.")
    ] = 31,
    any_lens: console.AnyLens = False,
    json_output: console.Json = False,
    quiet: console.Quiet = False,
    verbose: console.Verbose = 0,
) -> None:
    """Measure the blur of a lens from photos made for the purpose.

    An existing profile is added to: measured samples stand beside the blind ones and count for more.

    - target: the page that `lensmodel target` prints, photographed flat, nearly filling the frame.

    - pair: one scene from a tripod, wide open and at about f/8, given in pairs, the open photo first.

    - points: stars, or pinholes in front of a lamp; not saturated.

    - edges: a chart of dark squares or a checkerboard, turned by 5 degrees.

    Examples:

        lensmodel measure target page.dng --profile my-24mm.lensprofile

        lensmodel measure pair open.dng closed.dng --profile my-24mm.lensprofile

    Exit status: 0 all photos were used, 1 some were not, 2 wrong usage.
    """
    shown = Display(quiet=quiet, verbose=verbose, as_json=json_output)
    paths = files.photos(photos, shown.note)
    files.refuse_photo(profile, paths)
    with files.as_usage():
        store = files.ProfileFile(profile)
        config = configured(store.model, LensSettings(aperture=aperture))
        calibration = Calibration(store, config, any_lens=any_lens)
    method, results = measuring.methods.create(kind), list[dict[str, Any]]()
    if len(paths) % method.photos:
        raise UsageError(f"measuring by {kind} takes {method.photos} photos at a time, got {len(paths)}")
    groups = [paths[at : at + method.photos] for at in range(0, len(paths), method.photos)]
    with shown.progress(total=len(groups)) as bar:
        for number, group in enumerate(groups):
            bar.show(description=f"{group[0].name}: measuring")
            sampler = partial(method.measure, size=size, on_step=partial(bar.part, number))
            try:
                result = _added(calibration, group, config.settings, sampler)
            except (LensModelError, OSError) as error:
                result = files.failed(error)
                shown.error(f"{group[0]}: {result['reason']}")
            if result["state"] == "measured":
                said = f"{result['places']} places measured on {group[0].name} ({result['estimator']})"
                shown.result(f"{profile}: {said}, expected error of a PSF {result['error']:.2f}")
            elif result["state"] == "known":
                shown.note(f"{group[0]}: the profile has it already")
            results.append({"photos": [str(path) for path in group], **result})
            bar.show(number + 1)
    shown.document({"profile": str(profile) if profile.exists() else None, "results": results})
    if any(result["state"] == "failed" for result in results):
        raise typer.Exit(1)


def _added(
    calibration: Calibration, group: Sequence[Path], given: LensSettings, sampler: partial[list[PsfSample]]
) -> dict[str, Any]:
    """Measure on the photos of one measurement and add to the lens; say what became of it."""
    samples: list[PsfSample] = []

    def measured(key: str, admit: Admit) -> list[PsfSample]:
        first = develop(group[0], on_info=lambda info: admit(info.metadata))
        settings = first.info.metadata.settings(given)
        samples.extend(sampler([first, *map(develop, group[1:])], settings=settings, photo_id=key))
        return samples

    if calibration.add(group[0], measured) is None:
        return {"state": "known"}
    green = sorted(s.error or 0.0 for s in samples if s.settings.channel == "g") or [1.0]
    return {
        "state": "measured",
        "places": places_of(samples),
        "samples": len(samples),
        "estimator": samples[0].estimator,
        "error": green[len(green) // 2],
    }


def target(
    output: Annotated[Path, typer.Argument(metavar="FILE", help="Name ending in .pdf.")],
    paper: Annotated[
        Literal["a2", "a3", "a4", "letter", "tabloid"],
        typer.Option(help="Size of the paper, in landscape orientation."),
    ] = "a3",
    detail: Annotated[
        int, typer.Option(metavar="N", help=f"Samples along the long side, {_DETAILS}: about as its pixels.")
    ] = USUAL_DETAIL,
    force: console.Force = False,
) -> None:
    """Write the page to print for `lensmodel measure target`.

    Print it at full size on matte paper, in grey, without sharpening; fix it flat.

    Examples:

        lensmodel target target.pdf

        lensmodel target letter.pdf --paper letter --detail 2800

    Exit status: 0 written, 1 failed, 2 wrong usage.
    """
    if detail not in measuring.DETAILS:
        raise UsageError(f"--detail must be one of {_DETAILS}, got {detail}")
    files.refuse_existing(output, force=force)
    with files.as_usage():
        measuring.print_target(output, measuring.TargetPage(detail), paper=paper)
    Display().result(str(output))
